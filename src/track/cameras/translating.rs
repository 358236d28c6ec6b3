//! Cameras relative to an object that moves without rotating.
//!
//! If the object keeps its rotation in the world, then the rotation of every camera relative to the object is
//! known, and the directions to the object's points are known in the object's axes. A point p that a camera
//! at c sees in the unit direction d satisfies (I − d dᵀ)(p − c) = 0, which is linear in p and c. The points
//! are eliminated, and one linear system gives all camera centres, with the mean depth fixed at 1. It has no
//! mirrored second solution and needs no initial value, unlike structure from motion with unknown rotations.

use glam::{DMat3, DQuat, DVec3};
use nalgebra::{DMatrix, DVector};

use super::{Cameras, DEVIATION, Focal, Kept, information};
use crate::observe::PointTrack;
use crate::track::quantile;
use crate::types::Pose;
use crate::{Error, Result};

/// Number of linear solutions; each gives the depths and the residuals that weight the next.
const ROUNDS: usize = 5;
/// Width of the robust kernel, in medians of the residuals, and its lower bound in standard deviations of an
/// observation.
const KERNEL: (f64, f64) = (1.5, 6.0);
/// Information about a point's position without observations, relative to that of one observation across its
/// ray: holds points without parallax near the first camera's.
const LOOSE: f64 = 1e-6;
/// Range of an observation's depth, relative to the median, that its weight takes into account.
const DEPTHS: (f64, f64) = (0.1, 10.0);

/// One observation: the track, the frame, the unit direction in the object's axes, and the information.
struct Ray {
    point: usize,
    frame: usize,
    direction: DVec3,
    information: f64,
}

impl Ray {
    /// The projector onto the plane across the direction.
    fn across(&self) -> DMat3 {
        let d = self.direction;
        DMat3::IDENTITY - DMat3::from_cols(d * d.x, d * d.y, d * d.z)
    }
}

/// The cameras relative to an object that does not rotate, `view_from_object`, adjusted to its tracks with
/// all rotations kept. `view_from_world` are the rotations of the cameras in the world; the object has the
/// world's axes.
///
/// # Errors
/// The tracks do not determine the camera centres; errors of the adjustment.
pub(in crate::track) fn translating(
    tracks: &[PointTrack],
    focal: &Focal,
    view_from_world: &[DQuat],
) -> Result<Cameras> {
    let frames = view_from_world.len();
    let rays = rays(tracks, focal, view_from_world);
    let Some(centres) = centres(&rays, tracks.len(), frames, focal.intrinsics.fx) else {
        return Err(Error::Failed(
            "the tracks do not determine where the cameras are relative to an object".into(),
        ));
    };
    let pose = |(rotation, centre): (&DQuat, DVec3)| Pose::new(*rotation, -(*rotation * centre));
    let mut cameras = Cameras {
        poses: view_from_world.iter().zip(centres).map(pose).collect(),
        kept: Kept::Rotations,
        ..Cameras::new(focal, 0, tracks.len())
    };
    cameras.adjust(tracks, &vec![1.0; tracks.len()], focal)?;
    Ok(cameras)
}

impl Cameras {
    /// These cameras adjusted with all rotations free.
    ///
    /// # Errors
    /// Errors of the adjustment.
    pub(in crate::track) fn freed(&self, tracks: &[PointTrack], focal: &Focal) -> Result<Cameras> {
        let mut cameras = Cameras { kept: Kept::Nothing, ..self.clone() };
        cameras.adjust(tracks, &vec![1.0; tracks.len()], focal)?;
        Ok(cameras)
    }
}

fn rays(tracks: &[PointTrack], focal: &Focal, view_from_world: &[DQuat]) -> Vec<Ray> {
    let of_track = |(point, track): (usize, &PointTrack)| {
        let ray = |k: usize| {
            let frame = track.frames[k];
            let ray = view_from_world[frame].conjugate() * focal.intrinsics.ray(track.pixels[k]);
            let information = information(track.deviation_at(k));
            Ray { point, frame, direction: ray.normalize(), information }
        };
        (0..track.frames.len()).map(ray).collect::<Vec<_>>()
    };
    tracks.iter().enumerate().flat_map(of_track).collect()
}

/// The camera centres in a unit in which the median depth is 1, from the first camera; `None` where the rays
/// do not determine them. `focal` is in pixels.
fn centres(rays: &[Ray], points: usize, frames: usize, focal: f64) -> Option<Vec<DVec3>> {
    let mut of_point: Vec<Vec<usize>> = vec![Vec::new(); points];
    rays.iter().enumerate().for_each(|(i, ray)| of_point[ray.point].push(i));
    let mut depths = vec![1.0; rays.len()];
    let mut weights: Vec<f64> = rays.iter().map(|ray| ray.information).collect();
    let mut found = Vec::new();
    for _ in 0..ROUNDS {
        let (centres, positions) = solved(rays, &of_point, frames, &depths, &weights)?;
        let offset = |ray: &Ray| positions[ray.point] - centres[ray.frame];
        depths = rays.iter().map(|ray| offset(ray).dot(ray.direction)).collect();
        let unit = quantile(depths.clone(), 0.5);
        if !(unit.is_finite() && unit > 0.0) {
            return None;
        }
        found = centres.iter().map(|centre| *centre / unit).collect();
        depths.iter_mut().for_each(|z| *z = (*z / unit).clamp(DEPTHS.0, DEPTHS.1));
        let residual = |(ray, depth): (&Ray, &f64)| {
            focal * ((ray.across() * offset(ray)) / (unit * depth)).length()
        };
        let residuals: Vec<f64> = rays.iter().zip(&depths).map(residual).collect();
        let width = (KERNEL.0 * quantile(residuals.clone(), 0.5)).max(KERNEL.1 * DEVIATION);
        for ((weight, ray), residual) in weights.iter_mut().zip(rays).zip(&residuals) {
            *weight = ray.information / (1.0 + (residual / width).powi(2));
        }
    }
    Some(found)
}

/// Minimises Σ w |(I − d dᵀ)(p − c)|² / z² − 2 Σ w d·(p − c) / z over the points p and the centres c, of which
/// the first is 0: the second sum rewards depth, so that the solution is not the one with all of them 0.
fn solved(
    rays: &[Ray],
    of_point: &[Vec<usize>],
    frames: usize,
    depths: &[f64],
    weights: &[f64],
) -> Option<(Vec<DVec3>, Vec<DVec3>)> {
    let size = 3 * (frames - 1);
    let mut matrix = DMatrix::zeros(size, size);
    let mut right = DVector::zeros(size);
    let column = |frame: usize| frame.checked_sub(1).map(|place| 3 * place);
    let mut inverses = Vec::with_capacity(of_point.len());
    for members in of_point {
        // The point's information, its right side, and its coupling with each centre.
        let mut own = DMat3::from_diagonal(DVec3::splat(LOOSE));
        let mut reward = DVec3::ZERO;
        let couplings: Vec<(Option<usize>, DMat3)> = members
            .iter()
            .map(|&i| {
                let (ray, weight, depth) = (&rays[i], weights[i], depths[i]);
                let coupling = ray.across() * (weight / (depth * depth));
                own += coupling;
                reward += ray.direction * (weight / depth);
                (column(ray.frame), coupling)
            })
            .collect();
        let inverse = own.inverse();
        for (&i, (first, coupling)) in members.iter().zip(&couplings) {
            let Some(row) = *first else { continue };
            let direct = -rays[i].direction * (weights[i] / depths[i]);
            let through = *coupling * inverse;
            let sum = direct + through * reward;
            (0..3).for_each(|k| right[row + k] += sum[k]);
            add(&mut matrix, row, row, coupling);
            for (other, coupling) in &couplings {
                let Some(column) = *other else { continue };
                add(&mut matrix, row, column, &(through * *coupling * -1.0));
            }
        }
        inverses.push((inverse, reward));
    }
    let largest = (0..size).map(|k| matrix[(k, k)]).fold(0.0, f64::max);
    (0..size).for_each(|k| matrix[(k, k)] += 1e-12 * largest);
    let solution = matrix.cholesky()?.solve(&right);
    let centre = |frame: usize| {
        let at = |first: usize| DVec3::from_slice(&solution.as_slice()[first..first + 3]);
        column(frame).map_or(DVec3::ZERO, at)
    };
    let centres: Vec<DVec3> = (0..frames).map(centre).collect();
    let position = |(members, (inverse, reward)): (&Vec<usize>, &(DMat3, DVec3))| {
        let sum = members.iter().fold(*reward, |sum, &i| {
            let scale = weights[i] / depths[i].powi(2);
            sum + rays[i].across() * centres[rays[i].frame] * scale
        });
        *inverse * sum
    };
    let positions: Vec<DVec3> = of_point.iter().zip(&inverses).map(position).collect();
    let finite = centres.iter().chain(&positions).all(|v| v.is_finite());
    finite.then_some((centres, positions))
}

/// Adds a 3 × 3 block at a row and a column.
fn add(matrix: &mut DMatrix<f64>, row: usize, column: usize, block: &DMat3) {
    for c in 0..3 {
        for r in 0..3 {
            matrix[(row + r, column + c)] += block.col(c)[r];
        }
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::types::Intrinsics;

    const FRAMES: usize = 20;

    /// A hand-held camera that turns after a box of half the box's distance in length.
    fn camera(t: f64) -> Pose {
        let turned =
            DQuat::from_rotation_y(-0.02 * t) * DQuat::from_rotation_x(0.01 * (1.3 * t).sin());
        let centre = DVec3::new(0.02 * t, 0.01 * (0.9 * t).sin(), 0.02 * (0.7 * t).cos());
        Pose::new(turned, -(turned * centre))
    }

    /// The middle of the box: it drives past and comes nearer.
    fn middle(t: f64) -> DVec3 {
        DVec3::new(0.08 * t - 0.6, 0.2, 3.0 - 0.03 * t)
    }

    fn focal() -> Focal {
        Focal::known(Intrinsics::centred(300.0, 320, 180))
    }

    /// Tracks of eight frames with noise, on a box that rotates by `turn` about the vertical from frame to
    /// frame. Every tenth track is wrong.
    fn tracks(turn: f64) -> Vec<PointTrack> {
        let mut rng = ChaCha8Rng::seed_from_u64(7);
        let mut uniform = || 2.0 * rng.random::<f64>() - 1.0;
        let of_point = |i: usize| {
            let point = DVec3::new(0.7 * uniform(), 0.3 * uniform(), -0.2 + 0.15 * uniform());
            let first = i % (FRAMES - 7);
            let wrong = if i.is_multiple_of(10) { 0.8 } else { 0.0 };
            let at = |k: usize| {
                let t = (first + k) as f64;
                let turned = DQuat::from_rotation_y(turn * (t - 10.0)) * point;
                let pixel = focal().intrinsics.project(camera(t).apply(middle(t) + turned));
                pixel + wrong * k as f64 + 0.2 * DVec3::new(uniform(), uniform(), 0.0).truncate()
            };
            let pixels: Vec<_> = (0..8).map(at).collect();
            PointTrack::followed(first, pixels, vec![0.1; 8])
        };
        (0..400).map(of_point).collect()
    }

    fn rotations() -> Vec<DQuat> {
        (0..FRAMES).map(|t| camera(t as f64).rotation).collect()
    }

    #[test]
    fn the_path_of_an_object_that_does_not_rotate_is_found_up_to_scale() {
        let tracks = tracks(0.0);
        let found = translating(&tracks, &focal(), &rotations()).unwrap();
        // Vectors between camera centres, relative to the box, in the unit that best fits the true ones.
        let centre = |t: usize| found.poses[t].inverse().translation;
        let moved = |t: usize| centre(t) - centre(0);
        let truth = |t: usize| {
            let at = |t: usize| camera(t as f64).inverse().translation - middle(t as f64);
            at(t) - at(0)
        };
        let both: f64 = (1..FRAMES).map(|t| moved(t).dot(truth(t))).sum();
        let unit = both / (1..FRAMES).map(|t| truth(t).length_squared()).sum::<f64>();
        for t in 0..FRAMES {
            let turned = found.poses[t].rotation.angle_between(camera(t as f64).rotation);
            assert!(turned < 1e-7, "frame {t}: {turned}");
            let off = (moved(t) / unit).distance(truth(t));
            assert!(off < 0.02, "frame {t}: {off}");
        }
        // With free rotations, the error is hardly smaller.
        let freed = found.freed(&tracks, &focal()).unwrap();
        assert!(found.rms < 1.1 * freed.rms, "{} {}", found.rms, freed.rms);
    }

    #[test]
    fn an_object_that_rotates_is_not_explained() {
        for turn in [0.03, -0.2] {
            let tracks = tracks(turn);
            let found = translating(&tracks, &focal(), &rotations()).unwrap();
            let freed = found.freed(&tracks, &focal()).unwrap();
            assert!(found.rms > 1.15 * freed.rms, "{turn}: {} {}", found.rms, freed.rms);
        }
    }

    #[test]
    fn nothing_is_found_without_motion_or_without_tracks() {
        assert!(translating(&[], &focal(), &rotations()).is_err());
        // A camera that stands still in front of an object that does.
        let still = |i: usize| {
            let pixel =
                glam::DVec2::new(40.0 + 5.0 * (i % 20) as f64, 40.0 + 8.0 * (i / 20) as f64);
            PointTrack::followed(0, vec![pixel; FRAMES], vec![0.1; FRAMES])
        };
        let tracks: Vec<PointTrack> = (0..200).map(still).collect();
        let found = translating(&tracks, &focal(), &vec![DQuat::IDENTITY; FRAMES]);
        let weights = vec![1.0; tracks.len()];
        let parallax = found.map_or(0.0, |found| found.parallax(&tracks, &weights));
        assert!(parallax < 0.01, "{parallax}");
    }
}
