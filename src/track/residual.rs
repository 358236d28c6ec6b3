//! The fit of each pixel to a static world: the inverse depth that best explains the pixel's motion in
//! neighbouring frames, and the residual that it leaves.
//!
//! A pixel that no depth explains has moved. A pixel that a depth explains may still have moved, along its
//! epipolar lines and at a matching speed; the geometry of one camera cannot detect this.

use glam::DVec2;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::Stage;
use super::cameras::Cameras;
use super::observer::Work;
use crate::Result;
use crate::observe::NeighbourFlow;
use crate::types::Pose;

/// The fit of one frame's pixels to a static world; all lists hold one value per pixel.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct Seen {
    /// 1 / z of the static hypothesis, 0 at infinity.
    pub inverse_depth: Vec<f32>,
    /// Its standard deviation for the pixel noise measured in the clip; infinite without parallax.
    pub deviation: Vec<f32>,
    /// Residual of the hypothesis, in standard deviations of static pixels.
    pub score: Vec<f32>,
    /// Number of views that the fit uses, weighted by their confidence; 0 where nothing was seen.
    pub support: Vec<f32>,
}

/// Distances in frames, to both sides, of the views that are used. Near frames see almost everything; far
/// frames reveal slow motion and have parallax.
const OFFSETS: [usize; 5] = [1, 2, 4, 6, 9];
/// Noise of flow that is chained over `distance` steps, relative to that of one step: it grows with the
/// square root.
fn drift(distance: usize) -> f64 {
    (distance as f64).sqrt()
}
/// Lower bound of the noise of flow, pixels.
const NOISE_FLOOR: f64 = 0.08;

/// One view of a pixel: the frame, the pixel where it was seen there, and its weight.
struct View {
    place: usize,
    pixel: DVec2,
    weight: f64,
}

/// Triangulates every pixel of every frame.
pub(super) fn triangulate_frames(
    cameras: &Cameras,
    flow: &NeighbourFlow,
    work: &mut Work,
    part: &str,
    shares: std::ops::Range<f64>,
) -> Result<Vec<Seen>> {
    let noise = noise(cameras, flow);
    let frames = |range: std::ops::Range<usize>| {
        range.map(|frame| triangulate_frame(cameras, flow, frame, noise)).collect()
    };
    work.frames(&format!("{part}/seen"), flow.frames, frames, Stage::Masks, shares)
}

/// The spread of one step's residuals at static pixels, in pixels per coordinate. The lowest tenth is free of
/// movers even if they cover most of the image.
fn noise(cameras: &Cameras, flow: &NeighbourFlow) -> f64 {
    let step = ((flow.width * flow.height) as f64 / 800.0).sqrt().max(1.0) as usize;
    let residuals: Vec<f64> = (0..flow.frames)
        .into_par_iter()
        .flat_map_iter(|frame| {
            let relative = relatives(cameras, frame);
            let mut out = Vec::new();
            for y in (step / 2..flow.height).step_by(step) {
                for x in (step / 2..flow.width).step_by(step) {
                    let pixel = DVec2::new(x as f64 + 0.5, y as f64 + 0.5);
                    if let Some(found) = fit(cameras, flow, &relative, frame, pixel, 0.3) {
                        out.push(found.spread);
                    }
                }
            }
            out
        })
        .collect();
    // On clips with little motion, this quantile was measured to be half of the standard deviation.
    (2.0 * super::quantile(residuals, 0.1)).max(NOISE_FLOOR)
}

fn triangulate_frame(cameras: &Cameras, flow: &NeighbourFlow, frame: usize, noise: f64) -> Seen {
    let relative = relatives(cameras, frame);
    let rows: Vec<[f32; 4]> = (0..flow.width * flow.height)
        .into_par_iter()
        .map(|i| {
            let pixel = DVec2::new((i % flow.width) as f64 + 0.5, (i / flow.width) as f64 + 0.5);
            match fit(cameras, flow, &relative, frame, pixel, noise) {
                Some(f) => [
                    f.inverse_depth as f32,
                    (f.deviation * noise) as f32,
                    (f.spread / noise) as f32,
                    f.support as f32,
                ],
                None => [0.0, f32::INFINITY, 0.0, 0.0],
            }
        })
        .collect();
    let column = |k: usize| rows.iter().map(|r| r[k]).collect();
    Seen { inverse_depth: column(0), deviation: column(1), score: column(2), support: column(3) }
}

/// `other_from_frame` for all others.
fn relatives(cameras: &Cameras, frame: usize) -> Vec<Pose> {
    let inverse = cameras.poses[frame].inverse();
    cameras.poses.iter().map(|pose| *pose * inverse).collect()
}

struct Fit {
    inverse_depth: f64,
    /// Standard deviation of the inverse depth for noise of one pixel per step.
    deviation: f64,
    /// Root mean square of the residuals, each divided by its drift, pixels.
    spread: f64,
    support: f64,
}

fn fit(
    cameras: &Cameras,
    flow: &NeighbourFlow,
    relative: &[Pose],
    frame: usize,
    pixel: DVec2,
    noise: f64,
) -> Option<Fit> {
    let mut views: Vec<View> = Vec::with_capacity(2 * OFFSETS.len());
    flow.follow(frame, pixel, OFFSETS[OFFSETS.len() - 1], |other, chain| {
        let distance = other.abs_diff(frame);
        if OFFSETS.contains(&distance) {
            let weight = f64::from(chain.confidence) / drift(distance).powi(2);
            views.push(View { place: other, pixel: chain.pixel, weight });
        }
    });
    if views.is_empty() {
        return None;
    }
    let k = &cameras.intrinsics;
    let ray = k.ray(pixel);
    // x = A + d B per view, with A the rotated ray, B the translation and d the inverse depth.
    let lines: Vec<_> = views
        .iter()
        .map(|v| {
            let pose = &relative[v.place];
            (pose.rotation * ray, pose.translation)
        })
        .collect();
    let residual = |i: usize, d: f64| {
        let p = lines[i].0 + lines[i].1 * d;
        (p.z > 1e-3).then(|| {
            let at = k.project(p);
            let slope = DVec2::new(
                k.fx * (lines[i].1.x - p.x / p.z * lines[i].1.z) / p.z,
                k.fy * (lines[i].1.y - p.y / p.z * lines[i].1.z) / p.z,
            );
            (at - views[i].pixel, slope)
        })
    };
    // A linear initial value, then Gauss-Newton steps under a robust kernel, so that one wrong chain does not
    // decide.
    let (mut upper, mut lower) = (0.0, 0.0);
    for (view, (turned, shift)) in views.iter().zip(&lines) {
        let seen = k.ray(view.pixel);
        let (a, b) = (seen.cross(*turned), seen.cross(*shift));
        upper -= view.weight * a.dot(b);
        lower += view.weight * b.length_squared();
    }
    let mut d = if lower > 0.0 { (upper / lower).max(0.0) } else { 0.0 };
    let width = (3.0 * noise).powi(2);
    let mut information = 0.0;
    for _ in 0..5 {
        let (mut h, mut g) = (0.0, 0.0);
        information = 0.0;
        for i in 0..views.len() {
            let Some((r, j)) = residual(i, d) else { continue };
            let scaled = r.length_squared() / drift(views[i].place.abs_diff(frame)).powi(2);
            let w = views[i].weight / (1.0 + scaled / width);
            h += w * j.length_squared();
            g += w * j.dot(r);
            information += views[i].weight * j.length_squared();
        }
        if h <= 0.0 {
            break;
        }
        d = (d - g / h).max(0.0);
    }
    let (mut sum, mut support) = (0.0, 0.0);
    for i in 0..views.len() {
        let distance = views[i].place.abs_diff(frame);
        let confidence = views[i].weight * drift(distance).powi(2);
        // A static point that is visible in another camera cannot lie behind it.
        let squared = residual(i, d).map_or(1e4, |r| r.0.length_squared().min(1e4));
        sum += confidence * squared / drift(distance).powi(2);
        support += confidence;
    }
    // Fitting the depth removes one degree of freedom.
    let free = (2.0 * support - 1.0).max(0.5 * support);
    Some(Fit {
        inverse_depth: d,
        deviation: if information > 0.0 { information.sqrt().recip() } else { f64::INFINITY },
        spread: (2.0 * sum / free).sqrt(),
        support,
    })
}

#[cfg(test)]
mod tests {
    use super::super::sliding::*;
    use super::*;

    fn seen(flow: &NeighbourFlow) -> Seen {
        let frames = working(|work| {
            triangulate_frames(&cameras(STEP), flow, work, "test", 0.0..1.0).unwrap()
        });
        assert_eq!(frames.len(), FRAMES);
        frames.into_iter().nth(2).unwrap()
    }

    /// Pixels that no chain of flow loses.
    fn inner() -> impl Iterator<Item = usize> {
        (0..(WIDTH * HEIGHT) as usize).filter(|i| within(centre(*i), (12.0, 4.0), (52.0, 36.0)))
    }

    #[test]
    fn a_wall_has_its_distance_and_leaves_nothing_unexplained() {
        let seen = seen(&flow(|_, _| wall()));
        for i in inner() {
            let d = f64::from(seen.inverse_depth[i]);
            assert!((d * WALL - 1.0).abs() < 1e-4, "{}: 1/{}", centre(i), 1.0 / d);
            assert!(seen.score[i] < 0.01, "{}", seen.score[i]);
            // Frames 0, 1, 3 and 4 are at distances that are used, with full confidence.
            assert!((seen.support[i] - 4.0).abs() < 1e-3, "{}", seen.support[i]);
        }
        // A pixel of noise gives a deviation of 1 / (focal · baseline). The four views have baselines of one
        // and two steps, the latter with half the weight. The noise is at its lower bound.
        let information = 2.0 * (1.0 + 4.0 / 2.0) * (FOCAL * STEP).powi(2);
        let expected = NOISE_FLOOR / information.sqrt();
        let deviation = f64::from(seen.deviation[inner().next().unwrap()]);
        assert!((deviation / expected - 1.0).abs() < 0.01, "{deviation} {expected}");
    }

    #[test]
    fn what_leaves_its_epipolar_line_moved_and_what_keeps_to_it_seems_nearer() {
        let (low, high) = ((24.0, 12.0), (40.0, 28.0));
        let moving =
            |by: DVec2| seen(&flow(|_, p| if within(p, low, high) { wall() + by } else { wall() }));
        let middle = (20 * WIDTH + 32) as usize;
        let corner = (6 * WIDTH + 14) as usize;
        // Epipolar lines are rows: motion of 1.5 px per frame downwards fits no depth.
        let across = moving(DVec2::new(0.0, 1.5));
        assert!(across.score[middle] > 8.0, "{}", across.score[middle]);
        assert!(across.score[corner] < 0.5, "{}", across.score[corner]);
        // A pixel that moves along the rows at twice the wall's speed appears at half the distance.
        let along = moving(wall());
        assert!(along.score[middle] < 0.5, "{}", along.score[middle]);
        let d = f64::from(along.inverse_depth[middle]);
        assert!((d * WALL / 2.0 - 1.0).abs() < 1e-3, "{d}");
        // A pixel that moves against the wall's direction is beyond infinity and fits no depth.
        let ahead = moving(-2.0 * wall());
        assert!(ahead.score[middle] > 8.0, "{}", ahead.score[middle]);
        assert_eq!(ahead.inverse_depth[middle], 0.0);
    }

    #[test]
    fn a_fixed_camera_sees_no_depth() {
        let still = flow(|_, _| DVec2::ZERO);
        let frames = working(|work| {
            triangulate_frames(&cameras(0.0), &still, work, "test", 0.0..1.0).unwrap()
        });
        assert!(frames[2].deviation.iter().all(|d| d.is_infinite()));
        assert!(frames[2].score.iter().all(|s| *s < 0.01));
    }
}
