//! Cameras that rotate in place: rotations and focal length, with the world at infinity.

use glam::DQuat;
use rayon::prelude::*;

use super::focal::ASSUMED;
use super::{Anchor, Cameras, Focal, Standpoint};
use crate::geometry::ransac::RansacOptions;
use crate::geometry::two_view::turn_ransac;
use crate::observe::PointTrack;
use crate::track::FocalSource;
use crate::track::still::shared;
use crate::types::{Intrinsics, Pose};
use crate::{Error, Result};

/// Initial focal lengths if none is given, as multiples of the longer side. The adjustment converges from
/// half to double the true one.
const STARTS: [f64; 3] = [0.7, 1.2, 2.1];
/// Maximum number of points in an initial adjustment.
const POINTS: usize = 900;

impl Cameras {
    /// Estimates the cameras of a clip whose camera rotates in place, from all weighted tracks: first each
    /// frame's rotation to the next, then all rotations and the focal length together. The focal length is
    /// that of `focal` if it was given, else a measured one if the clip determines it, else the default.
    ///
    /// # Errors
    /// No rotation explains a part of the tracks that two neighbouring frames share; errors of the
    /// adjustment.
    pub fn turning(
        tracks: &[PointTrack],
        weights: &[f64],
        focal: &Focal,
        frames: usize,
        seed: u64,
    ) -> Result<Cameras> {
        let posed = vec![true; frames];
        let start = |focal: &Focal| {
            let new = Cameras::new(focal, frames, tracks.len());
            let mut cameras = Cameras { standpoint: Standpoint::Turns, ..new };
            cameras.poses = chained(tracks, weights, &focal.intrinsics, frames, seed)?;
            cameras.triangulate(tracks, weights, &posed, true);
            cameras.solve(tracks, weights, &posed, focal.mode(), POINTS, 2)?;
            Ok::<_, Error>(cameras)
        };
        let adjusted = |mut cameras: Cameras, focal: &Focal| {
            cameras.adjust(tracks, weights, focal)?;
            Ok::<_, Error>(cameras)
        };
        if focal.source == FocalSource::Given {
            return adjusted(start(focal)?, focal);
        }
        let (w, h) = (focal.intrinsics.width, focal.intrinsics.height);
        let assumed = |ratio: f64| Focal {
            intrinsics: Intrinsics::centred(ratio * f64::from(w.max(h)), w, h),
            source: FocalSource::Assumed,
            deviation: f64::INFINITY,
            held: false,
            prior: None,
        };
        let best = STARTS
            .iter()
            .filter_map(|ratio| Some((start(&assumed(*ratio)).ok()?, assumed(*ratio))))
            .map(|(cameras, focal)| (cameras.explained(tracks, weights), cameras, focal))
            .max_by(|a, b| a.0.total_cmp(&b.0));
        if let Some((_, cameras, focal)) = best {
            let cameras = adjusted(cameras, &focal)?;
            if cameras.focal_source == FocalSource::Measured {
                return Ok(cameras);
            }
        }
        let focal = assumed(ASSUMED);
        adjusted(start(&focal)?, &focal)
    }

    /// Puts all weighted tracks at infinity.
    pub(super) fn put_far(&mut self, tracks: &[PointTrack], weights: &[f64]) {
        let far = |(track, weight): (&PointTrack, &f64)| {
            (*weight > 0.05).then_some(Anchor { frame: track.first(), inverse_depth: 0.0 })
        };
        self.anchors = tracks.iter().zip(weights).map(far).collect();
    }
}

/// `view_from_world` of all frames, chained from the rotations between neighbouring frames.
fn chained(
    tracks: &[PointTrack],
    weights: &[f64],
    k: &Intrinsics,
    frames: usize,
    seed: u64,
) -> Result<Vec<Pose>> {
    let threshold = (f64::from(k.width) / 320.0).max(0.7);
    let options = RansacOptions { threshold, max_iterations: 500, seed, ..Default::default() };
    let turns: Vec<Option<DQuat>> = (1..frames)
        .into_par_iter()
        .map(|f| {
            let pair = shared(tracks, weights, (f - 1, f), 600);
            turn_ransac(&pair.a, &pair.b, &pair.weights, k, &options).map(|found| found.model)
        })
        .collect();
    let mut poses = vec![Pose::IDENTITY];
    for (f, turn) in turns.into_iter().enumerate() {
        let turn = turn.ok_or_else(|| {
            Error::Failed(format!(
                "no turn of the camera explains a part of what frames {f} and {} share",
                f + 1
            ))
        })?;
        let rotation = (turn * poses[f].rotation).normalize();
        poses.push(Pose { rotation, ..Pose::IDENTITY });
    }
    Ok(poses)
}
