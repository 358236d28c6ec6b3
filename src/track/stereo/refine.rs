//! Refines inverse depths to fractions of a level.
//!
//! From the level that the sweep has found for a pixel's patch, Gauss-Newton steps find the inverse depth at
//! which the patch matches all views best (multi-baseline stereo: Okutomi and Kanade 1993). The patch is a
//! plane, whose slope is taken from the surrounding inverse depths. The initial value is the prior.

use glam::{DVec2, DVec3};
use rayon::prelude::*;

use super::super::cameras::Cameras;
use super::super::residual::Seen;
use super::patch::{self, neighbours};
use super::views::View;
use crate::observe::luminance::Luminance;
use crate::types::Image;

/// Slopes are measured over up to `SLOPE_REACH` pixels to each side. Pixels are on the same surface if their
/// inverse depths differ by no more than the sum of this share and this number of deviations.
const SLOPE_REACH: usize = 4;
const SAME_SURFACE: (f64, f64) = (0.1, 2.0);
/// Maximum number of Gauss-Newton steps, and the shift in pixels below which they end.
const STEPS: usize = 4;
const SETTLED: f64 = 0.01;
/// Maximum shift of the patch in one step in any frame, pixels.
const LONGEST: f64 = 1.0;
/// Lower bound of the noise of a pixel's luminance.
const NOISE: f64 = 0.01;
/// Factor on the information of a patch, because neighbouring pixels of the smoothed frame are not
/// independent.
const INDEPENDENT: f64 = 0.5;
/// Minimum support of an inverse depth that is refined.
const SUPPORT: f32 = 0.5;

/// The frames and their smoothed luminance.
pub(super) struct Pictures<'a> {
    pub frames: &'a [Image],
    pub smooth: &'a [Luminance],
}

/// Refines the inverse depths of the static pixels of a frame, and their deviations. The support is 0 where
/// no match is found.
pub(super) fn frame(
    pictures: Pictures,
    cameras: &Cameras,
    covered: &[bool],
    seen: &Seen,
    views: &[View],
    frame: usize,
) -> Seen {
    let Pictures { frames, smooth } = pictures;
    let clip = Clip { pictures: smooth, cameras, image: &frames[frame], covered, seen };
    clip.frame(frame, views)
}

/// The inputs of patch matching.
struct Clip<'a> {
    pictures: &'a [Luminance],
    cameras: &'a Cameras,
    image: &'a Image,
    covered: &'a [bool],
    seen: &'a Seen,
}

/// The patch around a pixel.
struct Patch {
    points: Vec<Point>,
    inverse_depth: f64,
    deviation: f64,
}

/// A pixel of a patch.
struct Point {
    ray: DVec3,
    /// Its inverse depth minus that of the centre pixel.
    beyond: f64,
    /// Luminance minus the patch's mean.
    value: f64,
    /// Its share of the patch; the shares of a patch sum to one.
    share: f64,
}

/// The luminance residual of a patch pixel in another frame, its derivative with respect to the inverse
/// depth, and the pixel's share of the patch. The patch's mean is subtracted from the first two.
type Residual = (f64, f64, f64);

impl Clip<'_> {
    fn frame(&self, frame: usize, views: &[View]) -> Seen {
        let refined = |i: usize| {
            let known = self.seen.support[i] >= SUPPORT && !self.covered[i];
            let patch = known.then(|| self.patch(frame, i)).flatten()?;
            self.match_depth(&patch, views)
        };
        let n = self.seen.inverse_depth.len();
        let found: Vec<Option<(f32, f32)>> = (0..n).into_par_iter().map(refined).collect();
        let mut out = self.seen.clone();
        for (i, found) in found.into_iter().enumerate() {
            match found {
                Some((d, deviation)) => (out.inverse_depth[i], out.deviation[i]) = (d, deviation),
                None => out.support[i] = 0.0,
            }
        }
        out
    }

    /// The patch around pixel `i`; `None` if it extends beyond the image.
    fn patch(&self, frame: usize, i: usize) -> Option<Patch> {
        let (seen, width) = (self.seen, self.cameras.intrinsics.width as usize);
        let (column, row) = (i % width, i / width);
        let inverse_depth = f64::from(seen.inverse_depth[i]);
        let deviation = f64::from(seen.deviation[i]);
        let slope = DVec2::new(
            slope(seen, i, 1, column.min(width - 1 - column)),
            slope(seen, i, width, row.min(seen.inverse_depth.len() / width - 1 - row)),
        );
        let middle = DVec2::new(column as f64 + 0.5, row as f64 + 0.5);
        let mut points = Vec::with_capacity(neighbours().len());
        for (dx, dy) in neighbours() {
            let by = DVec2::new(dx as f64, dy as f64);
            // This also returns `None` if the neighbour is outside the image.
            let (value, _) = self.pictures[frame].sample(middle + by)?;
            let neighbour = i.checked_add_signed(dy * width as isize + dx)?;
            let share = f64::from(patch::weight(self.image, i, neighbour));
            let ray = self.cameras.intrinsics.ray(middle + by);
            points.push(Point { ray, beyond: slope.dot(by), value, share });
        }
        let total: f64 = points.iter().map(|p| p.share).sum();
        points.iter_mut().for_each(|p| p.share /= total);
        let mean: f64 = points.iter().map(|p| p.share * p.value).sum();
        points.iter_mut().for_each(|p| p.value -= mean);
        Some(Patch { points, inverse_depth, deviation })
    }

    /// The refined inverse depth and its deviation; `None` if no other frame shows the patch.
    fn match_depth(&self, patch: &Patch, views: &[View]) -> Option<(f32, f32)> {
        let prior = patch.deviation.max(1e-9).powi(-2);
        let (mut d, mut pictures) = (patch.inverse_depth, 0.0f64);
        for _ in 0..STEPS {
            let mut fastest = 0.0f64;
            let compared: Vec<Vec<Residual>> = views
                .iter()
                .filter_map(|view| self.compare(patch, view, d, &mut fastest))
                .collect();
            if compared.is_empty() || fastest <= 0.0 {
                return None;
            }
            let square = |all: &Vec<Residual>| all.iter().map(|r| r.2 * r.0 * r.0).sum::<f64>();
            let squares: Vec<f64> = compared.iter().map(square).collect();
            let mut sorted = squares.clone();
            sorted.sort_by(f64::total_cmp);
            // The third of the frames that match best determine the typical residual. Frames with much larger
            // residuals get little weight, because the patch is hidden there.
            let typical = sorted[(sorted.len() - 1) / 3].max(NOISE * NOISE);
            let (mut h, mut g) = (0.0, 0.0);
            for (residuals, square) in compared.iter().zip(&squares) {
                let trust = (1.0 + square / (4.0 * typical)).powi(-2);
                let count = residuals.len() as f64;
                for (r, j, share) in residuals {
                    h += trust * count * share * j * j;
                    g += trust * count * share * j * r;
                }
            }
            let scale = INDEPENDENT / typical;
            pictures = scale * h;
            let information = pictures + prior;
            let step = -(scale * g + prior * (d - patch.inverse_depth)) / information;
            let limit = LONGEST / fastest;
            d = (d + step.clamp(-limit, limit)).max(0.0);
            if step.abs() * fastest < SETTLED {
                break;
            }
        }
        Some((d as f32, pictures.max(1e-12).sqrt().recip() as f32))
    }

    /// Compares a patch at an inverse depth with a frame; `None` if the frame does not show all of it.
    /// `fastest` is raised to the speed at which a point of the patch moves, in pixels per unit of inverse
    /// depth.
    fn compare(
        &self,
        patch: &Patch,
        view: &View,
        inverse_depth: f64,
        fastest: &mut f64,
    ) -> Option<Vec<Residual>> {
        let (k, t) = (&self.cameras.intrinsics, view.view_from_frame.translation);
        let mut residuals = Vec::with_capacity(patch.points.len());
        for point in &patch.points {
            let p = view.view_from_frame.rotation * point.ray + t * (inverse_depth + point.beyond);
            if p.z < 1e-3 {
                return None;
            }
            let (value, slope) = self.pictures[view.frame].sample(k.project(p))?;
            let by_depth =
                DVec2::new(k.fx * (t.x - p.x / p.z * t.z), k.fy * (t.y - p.y / p.z * t.z));
            let by_depth = by_depth / p.z;
            *fastest = fastest.max(by_depth.length());
            residuals.push((value - point.value, slope.dot(by_depth), point.share));
        }
        let mean = residuals.iter().fold((0.0, 0.0), |s, r| (s.0 + r.2 * r.0, s.1 + r.2 * r.1));
        residuals.iter_mut().for_each(|r| *r = (r.0 - mean.0, r.1 - mean.1, r.2));
        Some(residuals)
    }
}

/// The slope of the inverse depth per pixel along an axis whose pixels are `stride` apart, from pixels of the
/// same surface on both sides; there are `room` pixels on each side.
fn slope(seen: &Seen, i: usize, stride: usize, room: usize) -> f64 {
    let (d, deviation) = (f64::from(seen.inverse_depth[i]), f64::from(seen.deviation[i]));
    let tolerance = SAME_SURFACE.0 * d + SAME_SURFACE.1 * deviation;
    let near = |j: usize| {
        let there = f64::from(seen.inverse_depth[j]);
        (seen.support[j] >= SUPPORT && (there - d).abs() < tolerance).then_some(there)
    };
    let (mut sum, mut total) = (0.0, 0.0);
    for k in 1..=room.min(SLOPE_REACH) {
        let Some((before, after)) = near(i - k * stride).zip(near(i + k * stride)) else { break };
        sum += k as f64 * (after - before);
        total += 2.0 * (k * k) as f64;
    }
    if total > 0.0 { sum / total } else { 0.0 }
}
