//! Photometric evidence that a pixel moved.
//!
//! Dense flow is smooth even where the true motion is not. Beside a mover, and beside near objects that pass
//! in front of far ones, flow carries a band of the background along with them, and against a static world
//! this band seems to move. The images show the truth: if a static depth from the surroundings explains the
//! neighbouring frames as well as the flow does, the pixel has not moved.

use glam::DVec2;
use rayon::prelude::*;

use super::cameras::Cameras;
use super::residual::Seen;
use crate::observe::NeighbourFlow;
use crate::types::{Image, Pose};

/// Distances in frames, to both sides, of the frames that are compared.
const OFFSETS: [usize; 2] = [1, 3];
/// Maximum distance, in pixels, of the static pixels whose depths are tried.
const REACH: isize = 28;
/// Radius of the patches, pixels.
const RADIUS: isize = 2;
/// Colour differences below this are noise (mean over the patch and channels).
const NOISE: f32 = 0.01;
/// A static pixel whose depth is tried has a residual below the first number (in deviations) and a support
/// above the second.
const RELIABLE: (f32, f32) = (2.5, 1.5);

/// Log odds of motion of those pixels of a frame whose geometric odds are above 0: the photometric evidence
/// if the texture is sufficient, else a part of the geometric odds. The odds of the other pixels are
/// unchanged.
pub(super) fn judge(
    frames: &[Image],
    cameras: &Cameras,
    flow: &NeighbourFlow,
    seen: &Seen,
    frame: usize,
    odds: &[f32],
) -> Vec<f32> {
    let (w, h) = (flow.width, flow.height);
    let inverse = cameras.poses[frame].inverse();
    let relative: Vec<Pose> = cameras.poses.iter().map(|pose| *pose * inverse).collect();
    (0..w * h)
        .into_par_iter()
        .map(|i| {
            if odds[i] <= 0.0 {
                return odds[i];
            }
            let pixel = DVec2::new((i % w) as f64 + 0.5, (i / w) as f64 + 0.5);
            let mut places: Vec<(usize, DVec2)> = Vec::with_capacity(4);
            flow.follow(frame, pixel, OFFSETS[1], |other, chain| {
                if OFFSETS.contains(&other.abs_diff(frame)) {
                    places.push((other, chain.pixel));
                }
            });
            if places.is_empty() {
                return 0.0;
            }
            let by_flow = sides(frames, frame, pixel, &places);
            let mut by_rest = f32::INFINITY;
            let mut apart = 0.0f32;
            for d in candidates(seen, i, w, h) {
                let ray = cameras.intrinsics.ray(pixel);
                let mut rest = Vec::with_capacity(places.len() + 2);
                // All frames are used, also those in which the flow has lost the pixel: a static point may be
                // visible there.
                for offset in OFFSETS {
                    for other in [frame.checked_sub(offset), Some(frame + offset)] {
                        let Some(pose) = other.and_then(|o| relative.get(o)) else { continue };
                        let p = pose.rotation * ray + pose.translation * d;
                        if p.z > 1e-3 {
                            rest.push((other.unwrap_or(0), cameras.intrinsics.project(p)));
                        }
                    }
                }
                let cost = sides(frames, frame, pixel, &rest);
                if cost < by_rest {
                    by_rest = cost;
                    let shared = |o: usize| rest.iter().find(|r| r.0 == o);
                    apart = places
                        .iter()
                        .filter_map(|(o, q)| shared(*o).map(|r| (r.1 - *q).length() as f32))
                        .fold(0.0, f32::max);
                }
            }
            if !by_rest.is_finite() {
                return 0.0;
            }
            // The colour change that a displacement as long as the disagreement would cause in this patch.
            let contrast = texture(&frames[frame], i, w, h) * apart.min(2.0);
            let telling = contrast / (contrast + 3.0 * NOISE);
            let picture =
                (3.0 * ((by_rest + NOISE) / (by_flow + NOISE)).ln() - 0.8).clamp(-2.0, 4.0);
            telling * picture + (1.0 - telling) * 0.4 * odds[i]
        })
        .collect()
}

/// Inverse depths to try: the pixel's own, and the nearest reliable one in each of eight directions.
fn candidates(seen: &Seen, i: usize, w: usize, h: usize) -> impl Iterator<Item = f64> {
    let (x, y) = ((i % w) as isize, (i / w) as isize);
    let reliable = move |j: usize| seen.score[j] < RELIABLE.0 && seen.support[j] > RELIABLE.1;
    const DIRECTIONS: [(isize, isize); 8] =
        [(1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, 1), (1, -1), (-1, -1)];
    let around = DIRECTIONS.into_iter().filter_map(move |(dx, dy)| {
        (1..=REACH / 2).map(|k| 2 * k).find_map(|k| {
            let (x, y) = (x + k * dx, y + k * dy);
            let inside = x >= 0 && y >= 0 && x < w as isize && y < h as isize;
            let j = (y * w as isize + x) as usize;
            (inside && reliable(j)).then(|| f64::from(seen.inverse_depth[j]))
        })
    });
    std::iter::once(f64::from(seen.inverse_depth[i])).chain(around)
}

/// The difference between the patch and those at `places`: the mean over earlier frames or over later ones,
/// whichever is less, because a point that is hidden on one side is mostly visible on the other.
fn sides(frames: &[Image], frame: usize, pixel: DVec2, places: &[(usize, DVec2)]) -> f32 {
    let mut best = f32::INFINITY;
    for later in [false, true] {
        let (mut sum, mut count) = (0.0, 0.0);
        for (other, place) in places.iter().filter(|p| (p.0 > frame) == later) {
            if let Some(cost) = difference(&frames[frame], pixel, &frames[*other], *place) {
                sum += cost;
                count += 1.0;
            }
        }
        if count > 0.0 {
            best = best.min(sum / count);
        }
    }
    best
}

/// Mean absolute difference of two patches; `None` if the second is not inside its image.
fn difference(a: &Image, p: DVec2, b: &Image, q: DVec2) -> Option<f32> {
    let (w, h) = (a.width as isize, a.height as isize);
    let margin = RADIUS as f64 + 1.0;
    if !(q.x > margin && q.y > margin && q.x < w as f64 - margin && q.y < h as f64 - margin) {
        return None;
    }
    let (px, py) = (p.x as isize, p.y as isize);
    let (x, y) = (q.x - 0.5, q.y - 0.5);
    let (x0, y0) = (x.floor() as isize, y.floor() as isize);
    let (fx, fy) = ((x - x0 as f64) as f32, (y - y0 as f64) as f32);
    let (mut sum, mut count) = (0.0, 0.0);
    for dy in -RADIUS..=RADIUS {
        for dx in -RADIUS..=RADIUS {
            if px + dx < 0 || py + dy < 0 || px + dx >= w || py + dy >= h {
                continue;
            }
            let here = a.at((px + dx) as u32, (py + dy) as u32);
            let at = |i: isize, j: isize| b.at((x0 + dx + i) as u32, (y0 + dy + j) as u32);
            let (c00, c10, c01, c11) = (at(0, 0), at(1, 0), at(0, 1), at(1, 1));
            for c in 0..3 {
                let top = c00[c] + (c10[c] - c00[c]) * fx;
                let bottom = c01[c] + (c11[c] - c01[c]) * fx;
                sum += (here[c] - top - (bottom - top) * fy).abs();
                count += 1.0;
            }
        }
    }
    (count > 0.0).then(|| sum / count)
}

/// Mean absolute colour difference between neighbours in the patch around a pixel.
fn texture(image: &Image, i: usize, w: usize, h: usize) -> f32 {
    let (x, y) = ((i % w) as isize, (i / w) as isize);
    let (mut sum, mut count) = (0.0, 0.0);
    for dy in -RADIUS..RADIUS {
        for dx in -RADIUS..RADIUS {
            let (x, y) = (x + dx, y + dy);
            if x < 0 || y < 0 || x + 1 >= w as isize || y + 1 >= h as isize {
                continue;
            }
            let here = image.at(x as u32, y as u32);
            let (right, below) =
                (image.at(x as u32 + 1, y as u32), image.at(x as u32, y as u32 + 1));
            for c in 0..3 {
                sum += 0.5 * ((here[c] - right[c]).abs() + (here[c] - below[c]).abs());
                count += 1.0;
            }
        }
    }
    if count > 0.0 { sum / count } else { 0.0 }
}
