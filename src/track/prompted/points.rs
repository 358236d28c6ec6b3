//! The prompts for a source of masks: points on a moving region, and beside it.

use super::{Frame, centre, share};
use crate::observe::Prompt;

/// Maximum number of points of each kind per region.
const POINTS: usize = 8;
/// Minimum distance between them, as a share of the image width.
const APART: f64 = 0.05;
/// Maximum distance of points beside a region from its bounding box, as a share of the image width.
const BESIDE: f64 = 0.15;
/// Maximum log odds of motion of points beside a region.
const STANDS: f32 = -0.5;

impl Frame<'_> {
    /// Points on a region where its motion is most certain, and beside it where the world is most certainly
    /// static.
    pub(super) fn prompts(&self, k: usize) -> Vec<Prompt> {
        let on = self.chosen(self.regions[k].clone(), |i| self.means[i], 0.0);
        let beside = self.beside(k).collect();
        let off = self.chosen(beside, |i| -self.means[i], -STANDS);
        let prompt = |inside| move |i| Prompt { pixel: centre(i, self.width), inside };
        on.into_iter().map(prompt(true)).chain(off.into_iter().map(prompt(false))).collect()
    }

    /// Pixels around a region that are in no region.
    fn beside(&self, k: usize) -> impl Iterator<Item = usize> {
        let reach = share(BESIDE, self.width);
        let (width, height) = (self.width, self.odds.len() / self.width);
        let bounds = |of: fn(usize, usize) -> usize| {
            let along = self.regions[k].iter().map(move |i| of(*i, width));
            let low = along.clone().min().unwrap_or(0).saturating_sub(reach);
            (low, along.max().unwrap_or(0) + reach)
        };
        let (left, right) = bounds(|i, width| i % width);
        let (top, bottom) = bounds(|i, width| i / width);
        let row = move |y| (left..=right.min(width - 1)).map(move |x| y * width + x);
        (top..=bottom.min(height - 1)).flat_map(row).filter(|i| self.region[*i] == 0)
    }

    /// The pixels with the highest scores above `least`, at a minimum distance from each other. They are
    /// chosen from the pixels that may be used as prompts, or from all pixels if there are none of those.
    fn chosen(
        &self,
        mut pixels: Vec<usize>,
        score: impl Fn(usize) -> f32,
        least: f32,
    ) -> Vec<usize> {
        pixels.retain(|i| score(*i) > least);
        if let Some(sure) = &self.sure
            && pixels.iter().any(|i| sure[*i])
        {
            pixels.retain(|i| sure[*i]);
        }
        pixels.sort_by(|a, b| score(*b).total_cmp(&score(*a)).then(a.cmp(b)));
        let apart = APART * self.width as f64;
        let mut out: Vec<usize> = Vec::new();
        for i in pixels {
            let near = |j: &usize| centre(*j, self.width).distance(centre(i, self.width)) < apart;
            if !out.iter().any(near) {
                out.push(i);
            }
            if out.len() == POINTS {
                break;
            }
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::{square, with_square};
    use super::*;
    use crate::track::sliding::{WIDTH, within};

    #[test]
    fn points_are_where_motion_and_rest_are_plainest_and_keep_apart() {
        let prompts = with_square(|frame| frame.prompts(0));
        let kind = |inside| prompts.iter().filter(move |p| p.inside == inside).map(|p| p.pixel);
        assert_eq!((kind(true).count(), kind(false).count()), (POINTS, POINTS));
        for p in kind(true) {
            assert!(within(p, (20.0, 10.0), (30.0, 30.0)), "{p}");
        }
        for p in kind(false) {
            let about = within(p, (10.0, 0.0), (50.0, 40.0));
            assert!(about && !square(p) && !(40.0..46.0).contains(&p.x), "{p}");
        }
        for inside in [true, false] {
            for (i, p) in kind(inside).enumerate() {
                let nearest = kind(inside).skip(i + 1).map(|q| p.distance(q));
                assert!(nearest.fold(f64::MAX, f64::min) >= 0.05 * f64::from(WIDTH));
            }
        }
    }

    #[test]
    fn what_is_not_sure_is_not_pointed_at() {
        with_square(|frame| {
            // First the lower half of the image is not sure, then all of it.
            let sure = |lower: f64| {
                let pixels = 0..frame.odds.len();
                let sure = pixels.map(|i| super::centre(i, frame.width).y < lower).collect();
                let frame = Frame { sure: Some(sure), ..frame.clone() };
                frame.prompts(0)
            };
            let upper = sure(20.0);
            assert!(upper.len() > 4 && upper.iter().any(|p| p.inside), "{upper:?}");
            assert!(upper.iter().all(|p| p.pixel.y < 20.0), "{upper:?}");
            assert_eq!(sure(0.0), frame.prompts(0), "without any all are taken");
        });
    }
}
