//! Whether a structure from motion of an object can be believed, and how deep it is.

use std::ops::Range;

use glam::{DVec2, DVec3};

use super::super::cameras::Cameras;
use super::super::quantile;
use super::joined::Piece;
use super::{Frame, UPRIGHT_DRIFT};
use crate::observe::PointTrack;

/// Thresholds for accepting a structure from motion of an object: minimum share of inliers, maximum
/// reprojection error (pixels at a width of 320) and minimum parallax (degrees).
const RIGID: (f64, f64, f64) = (0.6, 0.8, 4.0);
/// A point whose residual is more than this many times the median does not move with its object.
const ODD: f64 = 3.0;
/// Maximum distance of a point from the object's middle along the line of sight, relative to the depth.
const MOST_BEYOND: f64 = 0.7;
/// Maximum depth of an object along the line of sight, relative to its narrower side in the image. If the
/// structure is deeper in some frame, its depths are compressed: a swinging limb shifts against the body as
/// if it were nearer or farther.
const DEEP: f64 = 1.2;
/// Quantile over the frames that gives the object's narrower side: in some frames an object is seen narrower
/// than it is.
const WHOLE: f64 = 0.9;
/// Visible surfaces bulge towards the camera. A structure is rejected as mirrored or wrong if the mean over
/// its frames of the signed share of depth variance that a bulge explains (negative for a hollow) is not
/// above this value.
const HOLLOW: f64 = -0.03;
/// Factor by which a structure from motion drifts faster than independent errors of its tracks would give:
/// the errors of neighbouring tracks are correlated.
const TOGETHER: f64 = 40.0;

/// Checks a structure from motion of an object's `tracks`, and converts it to a piece if it is accepted. Also
/// returns the object's apparent depth in each frame relative to its narrower side. `places` are the tracks'
/// indices among the object's `all` tracks.
pub(super) fn believed(
    solved: &Cameras,
    tracks: &[PointTrack],
    places: &[usize],
    all: usize,
    run: Range<usize>,
    cameras: &Cameras,
) -> Option<(Piece, Vec<f64>)> {
    let weights = vec![1.0; tracks.len()];
    let size = (f64::from(cameras.intrinsics.width) / 320.0).max(1.0);
    let parallax = solved.parallax(tracks, &weights).to_degrees();
    if solved.inlier_share < RIGID.0 || solved.rms > RIGID.1 * size || parallax < RIGID.2 {
        return None;
    }
    let points: Vec<Option<DVec3>> = (0..tracks.len()).map(|i| solved.point(tracks, i)).collect();
    let certainty: Vec<_> = (0..tracks.len()).map(|i| solved.certainty(tracks, i)).collect();
    let usual = quantile(certainty.iter().flatten().map(|c| c.residual).collect(), 0.5);
    // Variance of a point's depth relative to the depth; `None` for points that do not move with the object.
    let variance = |i: usize| {
        let known = certainty[i].filter(|c| c.residual <= ODD * usual)?;
        Some((usual.max(1.0) * known.deviation).powi(2))
    };
    let coordinate = |k: usize| quantile(points.iter().flatten().map(|p| p[k]).collect(), 0.5);
    let middle = DVec3::new(coordinate(0), coordinate(1), coordinate(2));
    // Half of the size in the image, pixels.
    let half = |f: usize| {
        let seen = || tracks.iter().filter_map(|track| track.at(f));
        half_width(seen().map(|p| p.x)).max(half_width(seen().map(|p| p.y)))
    };
    let drift = {
        let halves = quantile((0..run.len()).map(half).collect(), 0.5);
        let seen = tracks.iter().map(|track| track.pixels.len()).sum::<usize>() as f64;
        let (life, points) = (seen / tracks.len() as f64, seen / run.len() as f64);
        (TOGETHER * solved.rms / (halves * points.sqrt() * life)).min(UPRIGHT_DRIFT)
    };
    let mut frames: Vec<Frame> = (0..run.len())
        .map(|f| {
            let centre = solved.poses[f].apply(middle);
            // The prior puts each point at the depth of the middle, with a standard deviation of half of the
            // object's size.
            let half = half(f) / cameras.intrinsics.fx;
            let mut relative = vec![None; all];
            for (i, place) in places.iter().enumerate() {
                let alive = points[i].filter(|_| tracks[i].at(f).is_some());
                relative[*place] = alive.zip(variance(i)).map(|(point, variance)| {
                    let beyond = solved.poses[f].apply(point).z / centre.z - 1.0;
                    let share = half * half / (half * half + variance);
                    1.0 + (share * beyond).clamp(-MOST_BEYOND, MOST_BEYOND)
                });
            }
            Frame {
                depth: centre.z,
                middle: cameras.intrinsics.project(centre),
                relative,
                view_from_object: Some(solved.poses[f]),
            }
        })
        .collect();
    let sound = drift.is_finite() && frames.iter().all(|f| f.depth > 0.0 && f.depth.is_finite());
    // Half of the narrower side. It appears smaller in frames that show the object only in part.
    let narrow = |(f, frame): (usize, &Frame)| {
        let pixels = narrow_half(tracks.iter().filter_map(|track| track.at(f)));
        frame.depth * pixels / cameras.intrinsics.fx
    };
    let narrow = quantile(frames.iter().enumerate().map(narrow).collect(), WHOLE);
    if !(sound && narrow > 0.0) {
        return None;
    }
    let deepness =
        |frame: &Frame| half_width(frame.relative.iter().flatten().copied()) * frame.depth / narrow;
    let deepness: Vec<f64> = frames.iter().map(deepness).collect();
    for (frame, deepness) in frames.iter_mut().zip(&deepness) {
        let share = (DEEP / deepness).powi(2).min(1.0);
        let most = DEEP * narrow / frame.depth;
        for relative in frame.relative.iter_mut().flatten() {
            *relative = 1.0 + (share * (*relative - 1.0)).clamp(-most, most);
        }
    }
    // Under weak perspective near and far are ambiguous: the mirrored solution rotates in the opposite
    // direction.
    let bulge = |(f, frame): (usize, &Frame)| {
        let seen = places.iter().enumerate();
        bulge(seen.filter_map(|(i, place)| Some((tracks[i].at(f)?, frame.relative[*place]?))))
    };
    let explained = |bulge: f64| bulge * bulge.abs();
    let bulge = frames.iter().enumerate().map(bulge).map(explained).sum::<f64>() / run.len() as f64;
    let mut known = vec![None; all];
    places.iter().zip(&points).for_each(|(place, point)| known[*place] = *point);
    (bulge > HOLLOW).then_some((Piece { run, middle, points: known, frames, drift }, deepness))
}

/// Half of the range of the values between their 5 % and 95 % quantiles.
fn half_width(values: impl Iterator<Item = f64>) -> f64 {
    let values: Vec<f64> = values.collect();
    0.5 * (quantile(values.clone(), 0.95) - quantile(values, 0.05))
}

/// Half of the range of the points, between the 5 % and 95 % quantiles, across the direction of their largest
/// spread.
fn narrow_half(points: impl Iterator<Item = DVec2>) -> f64 {
    let points: Vec<DVec2> = points.collect();
    let mean = points.iter().sum::<DVec2>() / points.len() as f64;
    let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
    for off in points.iter().map(|p| *p - mean) {
        (xx, xy, yy) = (xx + off.x * off.x, xy + off.x * off.y, yy + off.y * off.y);
    }
    let along = 0.5 * f64::atan2(2.0 * xy, xx - yy);
    half_width(points.iter().map(|p| p.dot(DVec2::from_angle(along).perp())))
}

/// How far an object bulges towards the camera, from the pixels and depths of its points: the correlation of
/// the depth with the squared distance from the middle, in units of the spread in each direction. A positive
/// value is a bulge towards the camera.
fn bulge(points: impl Iterator<Item = (DVec2, f64)>) -> f64 {
    let points: Vec<(DVec2, f64)> = points.collect();
    let count = points.len() as f64;
    let middle = points.iter().map(|(p, _)| *p).sum::<DVec2>() / count;
    let off: Vec<DVec2> = points.iter().map(|(p, _)| *p - middle).collect();
    let spread = |of: fn(&DVec2) -> f64| off.iter().map(of).sum::<f64>() / count;
    let (xx, xy, yy) = (spread(|o| o.x * o.x), spread(|o| o.x * o.y), spread(|o| o.y * o.y));
    let far = |o: &DVec2| yy * o.x * o.x - 2.0 * xy * o.x * o.y + xx * o.y * o.y;
    let far: Vec<f64> = off.iter().map(far).collect();
    let (mean_far, mean_depth) =
        (far.iter().sum::<f64>() / count, points.iter().map(|(_, z)| z).sum::<f64>() / count);
    let (mut ff, mut fz, mut zz) = (0.0, 0.0, 0.0);
    for (far, (_, depth)) in far.iter().zip(&points) {
        let (f, z) = (far - mean_far, depth - mean_depth);
        (ff, fz, zz) = (ff + f * f, fz + f * z, zz + z * z);
    }
    let scale = (ff * zz).sqrt();
    if scale > 0.0 { fz / scale } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ball_bulges_towards_the_camera_and_its_mirrored_solution_away() {
        // Points on the visible half of an ellipsoid, rotated about the line of sight.
        let half = |i: usize| {
            let (a, b) = ((i % 20) as f64 / 9.5 - 1.0, (i / 20) as f64 / 9.5 - 1.0);
            let height = (1.0 - a * a - b * b).sqrt();
            let pixel = DVec2::from_angle(0.5).rotate(DVec2::new(40.0 * a, 15.0 * b));
            (height > 0.1).then_some((DVec2::new(120.0, 80.0) + pixel, height))
        };
        let solved = |sign: f64| bulge((0..400).filter_map(half).map(|(p, h)| (p, 3.0 + sign * h)));
        assert!(solved(-0.1) > 0.9 && solved(0.1) < -0.9, "{} {}", solved(-0.1), solved(0.1));
        assert_eq!(solved(0.0), 0.0);
        // A slanted plane has neither a bulge nor a hollow.
        let plane = (0..400).filter_map(half).map(|(p, _)| (p, 0.01 * p.x));
        assert!(bulge(plane).abs() < 0.05);
    }

    #[test]
    fn the_narrow_side_is_across_the_long_one() {
        // Points on a slanted strip, 10 by 2.
        let along = DVec2::from_angle(0.7);
        let strip = (0..400).map(|i| {
            let (a, b) = (f64::from(i % 20) - 9.5, f64::from(i / 20) - 9.5);
            along * (0.5 * a) + along.perp() * (0.1 * b)
        });
        assert!((narrow_half(strip) - 0.9).abs() < 0.06);
    }
}
