//! The centre of an object that rotates, from its structure from motion and its outlines.
//!
//! The middle of an object's tracked points lies on the side that is seen. If the object has a centre of symmetry,
//! as a ball and a box have, its outline's middle is where that centre is, from whichever side it is seen. So the
//! centre is the point of the object that stays in the middle of the outlines. The more the object rotates with
//! respect to the line of sight, the better its position along it is known.

use glam::{DMat3, DVec2, DVec3};

use super::super::outline::Outlines;
use super::super::{pixel_gradients, quantile};
use super::joined::Piece;
use crate::geometry::se3::matrix3;
use crate::types::{Intrinsics, Pose};

/// Minimum number of outlines.
const LEAST: usize = 6;
/// Standard deviation of the offset between the centre and the middle of the points, as a multiple of the radius.
const OFFSET: f64 = 0.5;
/// Width of the robust kernel in the first rounds and in the others, pixels.
const WIDTH: (f64, f64) = (10.0, 2.0);
/// Number of rounds, and of the first ones.
const ROUNDS: (usize, usize) = (20, 5);
/// Maximum median distance of the centre from the outlines' middles, pixels. An object without a centre of
/// symmetry has no point that stays there.
const STAYS: f64 = 2.5;
/// Minimum standard deviation of an outline's middle, pixels: the mask limits it.
const NOISE: f64 = 0.3;
/// Maximum standard deviation of the centre along its worst axis, as a multiple of the radius.
const CERTAIN: f64 = 0.25;

/// An outline of the object, in a frame in which its structure holds.
struct Sight {
    view_from_object: Pose,
    /// Pixel of the outline's middle.
    middle: DVec2,
}

/// The centre in the coordinate frame of an object's structures from motion, which they share. `None` if its
/// outlines are visible in too few frames, if no point stays in their middle, or if too small a rotation leaves it
/// uncertain.
pub(super) fn centre(
    pieces: &[Piece],
    outlines: &Outlines,
    intrinsics: &Intrinsics,
) -> Option<DVec3> {
    let frames = || pieces.iter().flat_map(|piece| piece.run.clone().zip(&piece.frames));
    let seen = frames().filter_map(|(k, frame)| {
        let (view_from_object, outline) = frame.view_from_object.zip(outlines.frames[k])?;
        // The outline's depth is in units of the square root of its area at unit distance.
        let radius = frame.depth / (outline.depth * std::f64::consts::PI.sqrt());
        Some((Sight { view_from_object, middle: outline.middle }, radius))
    });
    let (sights, radii): (Vec<Sight>, Vec<f64>) = seen.unzip();
    if sights.len() < LEAST {
        return None;
    }
    let radius = quantile(radii, 0.5);
    let prior = (OFFSET * radius).powi(-2);
    let middle = pieces[0].middle;
    let mut centre = middle;
    for round in 0..ROUNDS.0 {
        let width = if round < ROUNDS.1 { WIDTH.0 } else { WIDTH.1 };
        let weight = |off: f64| (1.0 + (off / width).powi(2)).recip();
        let (information, right) = equations(&sights, centre, intrinsics, weight);
        let information = information + DMat3::from_diagonal(DVec3::splat(prior));
        centre += information.inverse() * (right + (middle - centre) * prior);
    }
    if !centre.is_finite() {
        return None;
    }
    let off = |sight: &Sight| {
        intrinsics.project(sight.view_from_object.apply(centre)).distance(sight.middle)
    };
    let usual = quantile(sights.iter().map(off).collect(), 0.5);
    let (information, _) = equations(&sights, centre, intrinsics, |_| 1.0);
    let least = matrix3(&information).symmetric_eigenvalues().min();
    let deviation = usual.max(NOISE) / least.max(0.0).sqrt();
    let is_before = |pose: Pose| pose.apply(centre).z > 0.0;
    let is_seen = frames().filter_map(|(_, frame)| frame.view_from_object).all(is_before);
    (is_seen && usual < STAYS && deviation < CERTAIN * radius).then_some(centre)
}

/// The normal equations of a step of the centre, from the distances between its image and the outlines' middles:
/// the information matrix and the right side. `weight` is that of an outline at a distance in pixels.
fn equations(
    sights: &[Sight],
    centre: DVec3,
    intrinsics: &Intrinsics,
    weight: impl Fn(f64) -> f64,
) -> (DMat3, DVec3) {
    let (mut information, mut right) = (DMat3::ZERO, DVec3::ZERO);
    for Sight { view_from_object, middle } in sights {
        let at = view_from_object.apply(centre);
        let off = *middle - intrinsics.project(at);
        let weight = weight(off.length());
        let object_from_view = DMat3::from_quat(view_from_object.rotation).transpose();
        let gradients = pixel_gradients(intrinsics, at);
        for (gradient, off) in gradients.into_iter().zip([off.x, off.y]) {
            let gradient = object_from_view * gradient;
            let weighted = gradient * weight;
            information += DMat3::from_cols(
                weighted * gradient.x,
                weighted * gradient.y,
                weighted * gradient.z,
            );
            right += weighted * off;
        }
    }
    (information, right)
}

#[cfg(test)]
mod tests {
    use glam::DQuat;

    use super::super::super::outline::Outline;
    use super::super::Frame;
    use super::*;

    /// A ball straight ahead that rotates by `turn` per frame, with the middle of its points on the side that is
    /// seen first. Some outlines are wrong if `wrong`.
    fn seen(turn: f64, wrong: bool) -> (Piece, Outlines, Intrinsics) {
        let intrinsics = Intrinsics::centred(300.0, 320, 180);
        let (radius, truth) = (0.3, DVec3::new(0.02, -0.03, 0.25));
        let pose = |k: usize| {
            let rotation = DQuat::from_rotation_y(turn * k as f64) * DQuat::from_rotation_x(0.2);
            Pose::new(rotation, DVec3::new(0.0, 0.0, 2.5) - rotation * truth)
        };
        let frame = |k: usize| Frame {
            depth: pose(k).apply(DVec3::ZERO).z,
            middle: intrinsics.project(pose(k).apply(DVec3::ZERO)),
            relative: vec![Some(1.0)],
            view_from_object: Some(pose(k)),
        };
        let outline = |k: usize| {
            let tremble = 0.3 * DVec2::new((2.1 * k as f64).sin(), (3.7 * k as f64).cos());
            let astray = if wrong && k % 4 == 1 { DVec2::new(9.0, 4.0) } else { DVec2::ZERO };
            let at = pose(k).apply(truth);
            let depth = at.z / (std::f64::consts::PI.sqrt() * radius);
            let middle = intrinsics.project(at) + tremble + astray;
            Some(Outline { middle, depth, slenderness: 0.0 })
        };
        let piece = Piece {
            run: 0..12,
            middle: DVec3::ZERO,
            points: Vec::new(),
            frames: (0..12).map(frame).collect(),
            drift: 0.01,
        };
        let frames = (0..12).map(outline).collect();
        let outlines = Outlines { frames, deviation: 0.015, discs: vec![None; 12] };
        (piece, outlines, intrinsics)
    }

    #[test]
    fn the_centre_stays_in_the_middle_of_the_outlines() {
        let truth = DVec3::new(0.02, -0.03, 0.25);
        for wrong in [false, true] {
            let (piece, outlines, intrinsics) = seen(0.1, wrong);
            let found = centre(&[piece], &outlines, &intrinsics).unwrap();
            assert!(found.distance(truth) < 0.02, "{found}");
        }
    }

    #[test]
    fn without_rotation_or_without_symmetry_there_is_none() {
        let (piece, outlines, intrinsics) = seen(0.0, false);
        assert!(centre(&[piece], &outlines, &intrinsics).is_none());
        let (piece, mut outlines, intrinsics) = seen(0.1, false);
        for (k, outline) in outlines.frames.iter_mut().flatten().enumerate() {
            outline.middle += DVec2::from_angle(2.4 * k as f64) * 8.0;
        }
        assert!(centre(&[piece], &outlines, &intrinsics).is_none());
        let (piece, mut outlines, intrinsics) = seen(0.1, false);
        outlines.frames[5..].fill(None);
        assert!(centre(&[piece], &outlines, &intrinsics).is_none());
    }
}
