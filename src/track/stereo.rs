//! Static depth, refined against the pictures.
//!
//! What was triangulated from flow is as exact as flow is. Once cameras are known, the patch about a
//! pixel can be looked for in the other frames along one line, and all frames around say together at
//! which inverse depth it matches best (multi-baseline stereo: Okutomi and Kanade 1993). The patch is
//! taken as a plane, whose slope the depth around it shows. What flow said is the start and the prior.

use glam::{DVec2, DVec3};
use rayon::prelude::*;

use super::Stage;
use super::cameras::Cameras;
use super::observer::Work;
use super::residual::Seen;
use crate::Result;
use crate::observe::luminance::Luminance;
use crate::types::{Image, Pose};

/// Frames at these distances are compared, each way.
const OFFSETS: [usize; 4] = [1, 3, 6, 10];
/// A patch reaches so many pixels to each side; every second one is compared.
const RADIUS: i32 = 2;
/// Slopes are taken over so many pixels to each side, among pixels whose inverse depth differs by no
/// more than this share and so many deviations.
const SLOPE_REACH: usize = 4;
const SAME_SURFACE: (f64, f64) = (0.1, 2.0);
/// Gauss–Newton steps, at most, and the shift in pixels that ends them.
const STEPS: usize = 4;
const SETTLED: f64 = 0.01;
/// A step shifts the patch by no more pixels than this in any frame.
const LONGEST: f64 = 1.0;
/// Noise of a pixel's luminance is not taken to be less.
const NOISE: f64 = 0.01;
/// Neighbouring pixels of the smoothed picture hold so much less than if they were independent.
const INDEPENDENT: f64 = 0.5;
/// Inverse depths that rest on less support are left alone.
const SUPPORT: f32 = 0.5;

/// Refines the inverse depths of what stands still, and their deviations, in all frames. `part` is the
/// name under which finished frames are kept.
///
/// # Errors
/// What the observer of `work` returns.
pub(super) fn refine(
    frames: &[Image],
    cameras: &Cameras,
    masks: &[Image],
    seen: &mut [Seen],
    work: &mut Work,
    part: &str,
    shares: std::ops::Range<f64>,
) -> Result<()> {
    let pictures: Vec<Luminance> = frames.par_iter().map(Luminance::of).collect();
    let clip = Clip { pictures: &pictures, cameras, masks, seen };
    let made =
        |range: std::ops::Range<usize>| range.map(|frame| clip.frame(frame)).collect::<Vec<_>>();
    let found = work.frames(&format!("{part}/stereo"), frames.len(), made, Stage::Depth, shares)?;
    for (seen, found) in seen.iter_mut().zip(found) {
        (seen.inverse_depth, seen.deviation) = found.into_iter().unzip();
    }
    Ok(())
}

/// What patches are compared by.
struct Clip<'a> {
    pictures: &'a [Luminance],
    cameras: &'a Cameras,
    masks: &'a [Image],
    seen: &'a [Seen],
}

/// A frame that a patch is looked for in.
struct View {
    frame: usize,
    view_from_patch: Pose,
}

/// What surrounds a pixel.
struct Patch {
    points: Vec<Point>,
    inverse_depth: f64,
    deviation: f64,
}

/// A pixel of a patch.
struct Point {
    ray: DVec3,
    /// Its inverse depth beyond the middle one's.
    beyond: f64,
    /// Luminance beyond the patch's mean.
    value: f64,
}

/// What a pixel of a patch leaves in another frame, and its derivative with respect to the inverse
/// depth, both beyond the patch's means.
type Residual = (f64, f64);

impl Clip<'_> {
    /// Inverse depths and deviations of a frame.
    fn frame(&self, frame: usize) -> Vec<(f32, f32)> {
        let seen = &self.seen[frame];
        let views = self.views(frame);
        let refined = |i: usize| {
            let known = seen.support[i] >= SUPPORT && seen.deviation[i].is_finite();
            let still = self.masks[frame].pixels[i] <= 0.5;
            let patch = (known && still).then(|| self.patch(frame, i)).flatten()?;
            self.match_depth(&patch, &views)
        };
        (0..seen.inverse_depth.len())
            .into_par_iter()
            .map(|i| refined(i).unwrap_or((seen.inverse_depth[i], seen.deviation[i])))
            .collect()
    }

    /// The frames around.
    fn views(&self, frame: usize) -> Vec<View> {
        let patch_from_world = self.cameras.poses[frame].inverse();
        let around = OFFSETS.iter().flat_map(|o| [frame.checked_sub(*o), Some(frame + o)]);
        around
            .flatten()
            .filter_map(|frame| {
                let view_from_world = *self.cameras.poses.get(frame)?;
                Some(View { frame, view_from_patch: view_from_world * patch_from_world })
            })
            .collect()
    }

    /// None where it leaves the picture.
    fn patch(&self, frame: usize, i: usize) -> Option<Patch> {
        let (seen, width) = (&self.seen[frame], self.masks[frame].width as usize);
        let (column, row) = (i % width, i / width);
        let inverse_depth = f64::from(seen.inverse_depth[i]);
        let deviation = f64::from(seen.deviation[i]);
        let slope = DVec2::new(
            slope(seen, i, 1, column.min(width - 1 - column)),
            slope(seen, i, width, row.min(seen.inverse_depth.len() / width - 1 - row)),
        );
        let middle = DVec2::new(column as f64 + 0.5, row as f64 + 0.5);
        let mut points = Vec::with_capacity(13);
        for dy in -RADIUS..=RADIUS {
            for dx in (-RADIUS..=RADIUS).filter(|dx| (dx + dy) % 2 == 0) {
                let by = DVec2::new(f64::from(dx), f64::from(dy));
                let (value, _) = self.pictures[frame].sample(middle + by)?;
                let ray = self.cameras.intrinsics.ray(middle + by);
                points.push(Point { ray, beyond: slope.dot(by), value });
            }
        }
        let mean = points.iter().map(|p| p.value).sum::<f64>() / points.len() as f64;
        points.iter_mut().for_each(|p| p.value -= mean);
        Some(Patch { points, inverse_depth, deviation })
    }

    /// Inverse depth and deviation; none where no other frame shows the patch.
    fn match_depth(&self, patch: &Patch, views: &[View]) -> Option<(f32, f32)> {
        let prior = patch.deviation.max(1e-9).powi(-2);
        let (mut d, mut information) = (patch.inverse_depth, prior);
        for _ in 0..STEPS {
            let mut fastest = 0.0f64;
            let compared: Vec<Vec<Residual>> = views
                .iter()
                .filter_map(|view| self.compare(patch, view, d, &mut fastest))
                .collect();
            if compared.is_empty() || fastest <= 0.0 {
                return None;
            }
            let square =
                |all: &Vec<Residual>| all.iter().map(|r| r.0 * r.0).sum::<f64>() / all.len() as f64;
            let squares: Vec<f64> = compared.iter().map(square).collect();
            let mut sorted = squares.clone();
            sorted.sort_by(f64::total_cmp);
            // What most frames show is the patch; what differs more is hidden there.
            let typical = sorted[(sorted.len() - 1) / 3].max(NOISE * NOISE);
            let (mut h, mut g) = (0.0, 0.0);
            for (residuals, square) in compared.iter().zip(&squares) {
                let trust = (1.0 + square / (4.0 * typical)).powi(-2);
                for (r, j) in residuals {
                    h += trust * j * j;
                    g += trust * j * r;
                }
            }
            let scale = INDEPENDENT / typical;
            information = scale * h + prior;
            let step = -(scale * g + prior * (d - patch.inverse_depth)) / information;
            let limit = LONGEST / fastest;
            d = (d + step.clamp(-limit, limit)).max(0.0);
            if step.abs() * fastest < SETTLED {
                break;
            }
        }
        Some((d as f32, information.sqrt().recip() as f32))
    }

    /// A patch at an inverse depth against a frame; none where that does not show all of it. `fastest`
    /// becomes the pixels per unit of inverse depth by which a point moves, where that is more.
    fn compare(
        &self,
        patch: &Patch,
        view: &View,
        inverse_depth: f64,
        fastest: &mut f64,
    ) -> Option<Vec<Residual>> {
        let (k, t) = (&self.cameras.intrinsics, view.view_from_patch.translation);
        let mut residuals = Vec::with_capacity(patch.points.len());
        for point in &patch.points {
            let p = view.view_from_patch.rotation * point.ray + t * (inverse_depth + point.beyond);
            if p.z < 1e-3 {
                return None;
            }
            let (value, slope) = self.pictures[view.frame].sample(k.project(p))?;
            let by_depth =
                DVec2::new(k.fx * (t.x - p.x / p.z * t.z), k.fy * (t.y - p.y / p.z * t.z));
            let by_depth = by_depth / p.z;
            *fastest = fastest.max(by_depth.length());
            residuals.push((value - point.value, slope.dot(by_depth)));
        }
        let n = residuals.len() as f64;
        let sum = residuals.iter().fold((0.0, 0.0), |s, r| (s.0 + r.0, s.1 + r.1));
        residuals.iter_mut().for_each(|r| *r = (r.0 - sum.0 / n, r.1 - sum.1 / n));
        Some(residuals)
    }
}

/// The change of the inverse depth from pixel to pixel along an axis, whose pixels are `stride` apart,
/// by what lies on the same surface on both sides; `room` pixels are there on each.
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

#[cfg(test)]
mod tests {
    use super::super::sliding::*;
    use super::*;

    /// What the sliding camera sees of a painted wall.
    fn painted() -> Vec<Image> {
        (0..FRAMES)
            .map(|frame| {
                let mut image = Image::new(WIDTH, HEIGHT, 3);
                let seen = map(|p| {
                    let at = p - wall() * frame as f64;
                    let wave = (0.8 * at.x + 0.2 * at.y).sin() * (0.6 * at.y).cos();
                    (0.5 + 0.3 * wave) as f32
                });
                for (out, value) in image.pixels.chunks_exact_mut(3).zip(&seen.pixels) {
                    out.fill(*value);
                }
                image
            })
            .collect()
    }

    /// A wall that is taken to be at a tenth more than its inverse depth.
    fn wrong() -> Vec<Seen> {
        let n = (WIDTH * HEIGHT) as usize;
        let seen = Seen {
            inverse_depth: vec![(1.1 / WALL) as f32; n],
            deviation: vec![(0.1 / WALL) as f32; n],
            score: vec![1.0; n],
            support: vec![2.0; n],
        };
        vec![seen; FRAMES]
    }

    fn refined(frames: &[Image], masks: &[Image]) -> Seen {
        let mut seen = wrong();
        let cameras = cameras(STEP);
        working(|work| refine(frames, &cameras, masks, &mut seen, work, "test", 0.0..1.0)).unwrap();
        seen.swap_remove(2)
    }

    #[test]
    fn a_painted_wall_is_found_at_its_distance() {
        let still: Vec<Image> = (0..FRAMES).map(|_| map(|_| 0.0)).collect();
        let seen = refined(&painted(), &still);
        let mut inner = 0;
        for i in 0..seen.inverse_depth.len() {
            if within(centre(i), (16.0, 6.0), (48.0, 34.0)) {
                inner += 1;
                let d = f64::from(seen.inverse_depth[i]) * WALL;
                assert!((d - 1.0).abs() < 0.02, "{}: {d}", centre(i));
                assert!(f64::from(seen.deviation[i]) * WALL < 0.03, "{}", seen.deviation[i]);
            }
        }
        assert_eq!(inner, 32 * 28);
    }

    #[test]
    fn movers_and_blank_walls_keep_what_flow_said() {
        let moving: Vec<Image> = (0..FRAMES).map(|_| map(|_| 1.0)).collect();
        let still: Vec<Image> = (0..FRAMES).map(|_| map(|_| 0.0)).collect();
        for seen in [refined(&painted(), &moving), refined(&frames(), &still)] {
            let start = &wrong()[0];
            for i in 0..seen.inverse_depth.len() {
                let off = (seen.inverse_depth[i] / start.inverse_depth[i] - 1.0).abs();
                assert!(off < 1e-5, "{}: {off}", centre(i));
                assert!((seen.deviation[i] / start.deviation[i] - 1.0).abs() < 1e-4);
            }
        }
    }
}
