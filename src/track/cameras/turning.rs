//! Cameras that turn in place: rotations and focal length, the world infinitely far away.

use glam::DQuat;
use rayon::prelude::*;

use super::adjustment::MEASURABLE;
use super::focal::ASSUMED;
use super::{Anchor, Cameras, Focal, Standpoint};
use crate::geometry::bundle::FocalMode;
use crate::geometry::ransac::RansacOptions;
use crate::geometry::two_view::turn_ransac;
use crate::observe::PointTrack;
use crate::track::FocalSource;
use crate::track::still::shared;
use crate::types::{Intrinsics, Pose};
use crate::{Error, Result};

/// Focal lengths to start from where none is given, as multiples of the longer side. The adjustment finds
/// its way from half or double of the true one.
const STARTS: [f64; 3] = [0.7, 1.2, 2.1];
/// Most points of a start.
const POINTS: usize = 900;

impl Cameras {
    /// Cameras of a clip whose camera turns in place, by all tracks that count: each frame's rotation to
    /// the next, then all of them and the focal length together. The focal length is that of `focal` if it
    /// was given or the clip does not tell another.
    ///
    /// # Errors
    /// Two neighbouring frames of which no turn explains a part; those of the adjustment.
    pub fn turning(
        tracks: &[PointTrack],
        weights: &[f64],
        focal: &Focal,
        frames: usize,
        seed: u64,
    ) -> Result<Cameras> {
        let posed = vec![true; frames];
        let start = |intrinsics: Intrinsics| {
            let given = focal.source == FocalSource::Given;
            let (source, deviation) = match given {
                true => (FocalSource::Given, 0.0),
                false => (FocalSource::Assumed, f64::INFINITY),
            };
            let focal = Focal { intrinsics, source, deviation };
            let new = Cameras::new(&focal, frames, tracks.len());
            let mut cameras = Cameras { standpoint: Standpoint::Turns, ..new };
            cameras.poses = chained(tracks, weights, &intrinsics, frames, seed)?;
            cameras.put_far(tracks, weights);
            let mode = if given { FocalMode::Fixed } else { FocalMode::Gated(MEASURABLE) };
            cameras.solve(tracks, weights, &posed, mode, POINTS, 2)?;
            Ok::<_, Error>((cameras, focal))
        };
        if focal.source != FocalSource::Given {
            let (w, h) = (focal.intrinsics.width, focal.intrinsics.height);
            let centred = |ratio: f64| Intrinsics::centred(ratio * f64::from(w.max(h)), w, h);
            let best = STARTS
                .iter()
                .filter_map(|ratio| start(centred(*ratio)).ok())
                .map(|(cameras, focal)| (cameras.explained(tracks, weights), cameras, focal))
                .max_by(|a, b| a.0.total_cmp(&b.0));
            if let Some((_, mut cameras, focal)) = best {
                cameras.adjust(tracks, weights, &focal)?;
                if cameras.focal_source == FocalSource::Measured {
                    return Ok(cameras);
                }
            }
            let (mut cameras, focal) = start(centred(ASSUMED))?;
            cameras.adjust(tracks, weights, &focal)?;
            return Ok(cameras);
        }
        let (mut cameras, focal) = start(focal.intrinsics)?;
        cameras.adjust(tracks, weights, &focal)?;
        Ok(cameras)
    }

    /// Puts all tracks that count at infinity.
    pub(super) fn put_far(&mut self, tracks: &[PointTrack], weights: &[f64]) {
        let far = |(track, weight): (&PointTrack, &f64)| {
            (*weight > 0.05).then_some(Anchor { frame: track.first, inverse_depth: 0.0 })
        };
        self.anchors = tracks.iter().zip(weights).map(far).collect();
    }
}

/// `view_from_world` of all frames by the turns from one frame to the next.
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
