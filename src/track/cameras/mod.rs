//! Focal length, poses and sparse points of the static world.

mod adjustment;
mod focal;
mod judgement;
mod lens;
mod motions;
mod posing;
mod turning;

use glam::{DVec2, DVec3};
use serde::{Deserialize, Serialize};

pub(super) use focal::Focal;
pub use motions::RigidMotion;
pub(super) use motions::{Motions, Search};
pub(super) use posing::{pose, reconstruct};

use super::{FocalSource, quantile};
use crate::Result;
use crate::observe::{NeighbourFlow, PointTrack};
use crate::types::{Intrinsics, Pose};

/// Where a track's point lies along the ray of one of its pixels.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub(super) struct Anchor {
    pub frame: usize,
    pub inverse_depth: f64,
}

/// Poses of all frames, and an inverse depth for each track that has one.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct Cameras {
    pub intrinsics: Intrinsics,
    /// Of the lens, while it is looked for; else 0, the pictures being undistorted.
    k1: f64,
    pub focal_source: FocalSource,
    pub focal_std: f64,
    /// What is weighed beside the tracks: see [`Focal::prior`].
    focal_prior: Option<(f64, f64)>,
    /// `view_from_world`.
    pub poses: Vec<Pose>,
    /// Per track: a frame that it lives in, and 1 / z there.
    pub anchors: Vec<Option<Anchor>>,
    /// Frames whose pose is a guess.
    pub doubtful: Vec<usize>,
    pub inlier_share: f64,
    pub rms: f64,
    pub standpoint: Standpoint,
    strictness: Strictness,
    /// Poses were supplied.
    supplied: bool,
    /// Only structure and focal length are adjusted.
    held: bool,
    /// One of the world's units in that of the supplied poses; 1 without.
    pub unit: f64,
    /// Upwards in the world, where the ground that is seen tells. It is found anew in a run that is resumed.
    #[serde(skip)]
    pub up: Option<DVec3>,
}

/// What the camera does.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(in crate::track) enum Standpoint {
    /// It moves through the scene: static points have depths.
    Moves,
    /// It turns in place: the static world is infinitely far away as far as anything tells.
    Turns,
    /// All poses are one.
    Fixed,
}

/// What counts as an outlier.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) enum Strictness {
    /// What is farther off than points of the same rigid motion may be.
    Usual,
    /// What is farther off than most of them are: a compromise between two motions holds no more.
    Strict,
}

impl Strictness {
    /// Thresholds are those of the usual strictness times this.
    pub fn factor(self) -> f64 {
        match self {
            Strictness::Usual => 1.0,
            Strictness::Strict => 0.3,
        }
    }
}

/// A point is seen to so many pixels along each axis, where it is followed without an error.
pub(super) const DEVIATION: f64 = 0.05;

/// How far cameras lie from their middle in the unit in which supplied poses are first looked at: as far as
/// those of a hand-held clip do in units of the median depth.
const USUAL_SPREAD: f64 = 0.1;

/// How far cameras lie from their middle, root mean square.
fn spread(poses: &[Pose]) -> f64 {
    let centres: Vec<DVec3> = poses.iter().map(|pose| pose.inverse().translation).collect();
    let n = centres.len().max(1) as f64;
    let middle = centres.iter().sum::<DVec3>() / n;
    (centres.iter().map(|centre| centre.distance_squared(middle)).sum::<f64>() / n).sqrt()
}

/// How much an observation counts beside one that is followed without an error.
pub(super) fn information(deviation: f32) -> f64 {
    DEVIATION.powi(2) / (DEVIATION.powi(2) + f64::from(deviation).powi(2))
}

impl Cameras {
    /// The camera of a tripod.
    pub fn fixed(focal: &Focal, flow: &NeighbourFlow, tracks: usize) -> Cameras {
        Cameras { standpoint: Standpoint::Fixed, ..Cameras::new(focal, flow.frames, tracks) }
    }

    /// Cameras that a unit test knows.
    #[cfg(test)]
    pub fn known(intrinsics: Intrinsics, poses: Vec<Pose>) -> Cameras {
        let focal = Focal {
            intrinsics,
            source: FocalSource::Given,
            deviation: 0.0,
            held: true,
            prior: None,
        };
        Cameras { poses, ..Cameras::new(&focal, 0, 0) }
    }

    fn new(focal: &Focal, frames: usize, tracks: usize) -> Cameras {
        Cameras {
            intrinsics: focal.intrinsics,
            k1: 0.0,
            focal_source: focal.source,
            focal_std: focal.deviation,
            focal_prior: focal.prior,
            poses: vec![Pose::IDENTITY; frames],
            anchors: vec![None; tracks],
            doubtful: Vec::new(),
            inlier_share: 0.0,
            rms: 0.0,
            standpoint: Standpoint::Moves,
            strictness: Strictness::Usual,
            supplied: false,
            held: false,
            unit: 1.0,
            up: None,
        }
    }

    /// Cameras that the user knows; to `refine` is to adjust them too.
    ///
    /// # Errors
    /// Those of the adjustment.
    pub fn supplied(
        poses: &[Pose],
        refine: bool,
        focal: &Focal,
        tracks: &[PointTrack],
        weights: &[f64],
    ) -> Result<Cameras> {
        let mut cameras = Cameras {
            poses: poses.to_vec(),
            supplied: true,
            held: !refine,
            ..Cameras::new(focal, poses.len(), tracks.len())
        };
        // In whatever unit the poses are, all that follows is done in the world's.
        let spread = spread(poses);
        if spread > 0.0 {
            cameras.rescale(spread / USUAL_SPREAD);
        }
        cameras.adjust(tracks, weights, focal)?;
        if let Some(depth) = cameras.median_depth(tracks, weights) {
            cameras.rescale(depth);
        }
        Ok(cameras)
    }

    /// Cameras that a network tells, adjusted to the static tracks.
    ///
    /// # Errors
    /// Those of the adjustment.
    pub fn begun(
        poses: &[Pose],
        focal: &Focal,
        tracks: &[PointTrack],
        weights: &[f64],
    ) -> Result<Cameras> {
        let first = poses[0].inverse();
        let poses = poses.iter().map(|pose| *pose * first).collect();
        let mut cameras = Cameras { poses, ..Cameras::new(focal, 0, tracks.len()) };
        let spread = spread(&cameras.poses);
        if spread > 0.0 {
            cameras.rescale(spread / USUAL_SPREAD);
        }
        cameras.adjust(tracks, weights, focal)?;
        cameras.doubtful = cameras.frames_in_doubt(tracks, weights);
        Ok(cameras)
    }

    /// Do static points have depths?
    pub fn have_parallax(&self) -> bool {
        self.standpoint == Standpoint::Moves
    }

    /// Inverse depth of all pixels of a frame where there is no parallax: a wall at depth 1 before a fixed
    /// camera, the sphere of radius 1 around one that turns.
    pub fn background(&self) -> Option<Vec<f32>> {
        let (w, h) = (self.intrinsics.width, self.intrinsics.height);
        let pixels =
            (0..h).flat_map(|y| (0..w).map(move |x| DVec2::new(f64::from(x), f64::from(y)) + 0.5));
        match self.standpoint {
            Standpoint::Moves => None,
            Standpoint::Turns => {
                Some(pixels.map(|p| self.intrinsics.ray(p).length() as f32).collect())
            }
            Standpoint::Fixed => Some(pixels.map(|_| 1.0).collect()),
        }
    }

    /// Keeps those tracks that are named by their index, each as it is now.
    pub fn keep(&mut self, kept: &[(usize, PointTrack)]) {
        let lives = |track: &PointTrack, anchor: &Anchor| track.at(anchor.frame).is_some();
        let anchor =
            |(i, track): &(usize, PointTrack)| self.anchors[*i].filter(|a| lives(track, a));
        self.anchors = kept.iter().map(anchor).collect();
    }

    /// The point of a track in the world.
    pub fn point(&self, tracks: &[PointTrack], i: usize) -> Option<DVec3> {
        let Anchor { frame, inverse_depth } = self.anchors[i].filter(|a| a.inverse_depth > 1e-9)?;
        let ray = self.intrinsics.ray(tracks[i].at(frame)?);
        Some(self.poses[frame].inverse().apply(ray / inverse_depth))
    }

    /// Makes the median depth of the static points in the cameras that see them the unit, and the first
    /// camera the world; supplied poses keep their world's place and axes.
    pub fn normalise(
        &mut self,
        tracks: &[PointTrack],
        weights: &[f64],
        seen: &mut [super::residual::Seen],
    ) {
        if !self.supplied {
            let first = self.poses[0].inverse();
            self.poses.iter_mut().for_each(|pose| *pose = *pose * first);
        }
        let Some(unit) = self.median_depth(tracks, weights) else { return };
        self.rescale(unit);
        for frame in seen {
            frame.inverse_depth.iter_mut().for_each(|d| *d *= unit as f32);
            frame.deviation.iter_mut().for_each(|d| *d *= unit as f32);
        }
    }

    /// The median depth of the static points in the cameras that see them.
    fn median_depth(&self, tracks: &[PointTrack], weights: &[f64]) -> Option<f64> {
        let mut depths = Vec::new();
        for i in (0..tracks.len()).filter(|&i| weights[i] > 0.5) {
            let Some(point) = self.point(tracks, i) else { continue };
            for &f in &tracks[i].frames {
                depths.push(self.poses[f].apply(point).z);
            }
        }
        depths.retain(|z| *z > 0.0 && z.is_finite());
        (!depths.is_empty()).then(|| quantile(depths, 0.5))
    }

    /// Makes so much of the world's unit the new one.
    fn rescale(&mut self, unit: f64) {
        self.poses.iter_mut().for_each(|pose| pose.translation /= unit);
        self.anchors.iter_mut().flatten().for_each(|a| a.inverse_depth *= unit);
        if self.supplied {
            self.unit *= unit;
        }
    }

    /// The median over the static tracks of the widest angle between their rays, radians.
    pub fn parallax(&self, tracks: &[PointTrack], weights: &[f64]) -> f64 {
        let angles = (0..tracks.len())
            .filter(|&i| weights[i] > 0.5 && tracks[i].pixels.len() > 2)
            .filter_map(|i| {
                let point = self.point(tracks, i)?;
                let to = |f: usize| (point - self.poses[f].inverse().translation).normalize();
                let (first, last) = (tracks[i].first(), tracks[i].end() - 1);
                let middle = (first + last) / 2;
                let angle = |a: DVec3, b: DVec3| a.angle_between(b);
                Some(
                    angle(to(first), to(last))
                        .max(angle(to(first), to(middle)))
                        .max(angle(to(middle), to(last))),
                )
            })
            .collect();
        quantile(angles, 0.5)
    }
}
