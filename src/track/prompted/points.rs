//! Where a source of masks is pointed at: on a region that moves, and beside it.

use super::{Frame, centre, share};
use crate::observe::Prompt;

/// Points of each kind for a region, at most.
const POINTS: usize = 8;
/// They are so far apart, as a share of the picture's width.
const APART: f64 = 0.05;
/// Points beside a region are within so much of its bounds, as a share of the width.
const BESIDE: f64 = 0.15;
/// Log odds of motion of points beside, at most.
const STANDS: f32 = -0.5;

impl Frame<'_> {
    /// Points on a region where it moves most plainly, and beside it where the world plainly stands still.
    pub(super) fn prompts(&self, k: usize) -> Vec<Prompt> {
        let on = self.chosen(self.regions[k].clone(), |i| self.means[i], 0.0);
        let beside = self.beside(k).collect();
        let off = self.chosen(beside, |i| -self.means[i], -STANDS);
        let prompt = |inside| move |i| Prompt { pixel: centre(i, self.width), inside };
        on.into_iter().map(prompt(true)).chain(off.into_iter().map(prompt(false))).collect()
    }

    /// Pixels about a region that are in none.
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

    /// The pixels with the highest scores above a least one, which keep apart: of those that may be pointed at, or of all
    /// where there is none.
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
            // The lower half of the picture is not sure, then all of it.
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
