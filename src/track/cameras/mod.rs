//! Estimates the focal length, the poses and the sparse points of the static world.

mod adjustment;
mod focal;
mod judgement;
mod lens;
mod motions;
mod posing;
mod translating;
mod turning;

use glam::{DVec2, DVec3};
use serde::{Deserialize, Serialize};

pub(super) use focal::Focal;
pub use motions::RigidMotion;
pub(super) use motions::{Motions, Search};
pub(super) use posing::{Posing, pose, reconstruct};
pub(super) use translating::translating;

use super::stereo::Ground;
use super::{FocalSource, quantile};
use crate::Result;
use crate::observe::{NeighbourFlow, PointTrack};
use crate::types::{Intrinsics, Pose};

/// Position of a track's point along the ray of one of its pixels.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub(super) struct Anchor {
    pub frame: usize,
    pub inverse_depth: f64,
}

/// Poses of all frames, and an inverse depth for each track that has one.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct Cameras {
    pub intrinsics: Intrinsics,
    /// First radial distortion coefficient, used while the lens is estimated. Otherwise 0, because the frames
    /// are undistorted.
    k1: f64,
    pub focal_source: FocalSource,
    pub focal_std: f64,
    /// Prior of the focal length in the adjustment; see [`Focal::prior`].
    focal_prior: Option<(f64, f64)>,
    /// `view_from_world` of all frames.
    pub poses: Vec<Pose>,
    /// Per track: a frame of the track, and the inverse depth 1 / z in that frame.
    pub anchors: Vec<Option<Anchor>>,
    /// Frames whose pose is doubtful.
    pub doubtful: Vec<usize>,
    pub inlier_share: f64,
    pub rms: f64,
    pub standpoint: Standpoint,
    strictness: Strictness,
    /// Whether the poses were supplied.
    supplied: bool,
    /// The part of the poses that the adjustment keeps.
    kept: Kept,
    /// The length of one world unit in the unit of the supplied poses; 1 without supplied poses.
    pub unit: f64,
    /// The ground, if it was found. It is not saved; a resumed run determines it again.
    #[serde(skip)]
    pub ground: Option<Ground>,
}

/// The kind of camera motion.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(in crate::track) enum Standpoint {
    /// The camera moves through the scene, so static points have depths.
    Moves,
    /// The camera rotates in place. The static world is treated as infinitely far away.
    Turns,
    /// All poses are identical.
    Fixed,
}

/// The part of the poses that the adjustment keeps.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
enum Kept {
    /// Poses, structure and focal length are adjusted.
    Nothing,
    /// The rotations are kept.
    Rotations,
    /// Only structure and focal length are adjusted.
    Poses,
}

/// The threshold of outliers.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) enum Strictness {
    /// Outliers have a larger error than points of the same rigid motion can have.
    Usual,
    /// Outliers have a larger error than most points of the same rigid motion have. No compromise between two
    /// motions passes this threshold in all frames.
    Strict,
}

impl Strictness {
    /// Factor on the thresholds of the usual strictness.
    pub fn factor(self) -> f64 {
        match self {
            Strictness::Usual => 1.0,
            Strictness::Strict => 0.3,
        }
    }
}

/// Standard deviation of an observation along each axis, in pixels, apart from the error of tracking.
pub(super) const DEVIATION: f64 = 0.05;

/// Root mean square distance of the cameras from their mean in the initial unit of supplied poses. It is that
/// of a typical hand-held clip in units of the median depth.
const USUAL_SPREAD: f64 = 0.1;

/// Root mean square distance of the cameras from their mean.
fn spread(poses: &[Pose]) -> f64 {
    let centres: Vec<DVec3> = poses.iter().map(|pose| pose.inverse().translation).collect();
    let n = centres.len().max(1) as f64;
    let middle = centres.iter().sum::<DVec3>() / n;
    (centres.iter().map(|centre| centre.distance_squared(middle)).sum::<f64>() / n).sqrt()
}

/// The weight of an observation relative to one that is tracked without an error.
pub(super) fn information(deviation: f32) -> f64 {
    DEVIATION.powi(2) / (DEVIATION.powi(2) + f64::from(deviation).powi(2))
}

impl Cameras {
    /// A fixed camera.
    pub fn fixed(focal: &Focal, flow: &NeighbourFlow, tracks: usize) -> Cameras {
        Cameras { standpoint: Standpoint::Fixed, ..Cameras::new(focal, flow.frames, tracks) }
    }

    /// Known cameras, for unit tests.
    #[cfg(test)]
    pub fn known(intrinsics: Intrinsics, poses: Vec<Pose>) -> Cameras {
        Cameras { poses, ..Cameras::new(&Focal::known(intrinsics), 0, 0) }
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
            kept: Kept::Nothing,
            unit: 1.0,
            ground: None,
        }
    }

    /// Cameras with supplied poses; `refine` also adjusts the poses.
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
            kept: if refine { Kept::Nothing } else { Kept::Poses },
            ..Cameras::new(focal, poses.len(), tracks.len())
        };
        // The poses are in an arbitrary unit. They are first scaled to approximately the world's unit, and to
        // exactly that unit after the adjustment.
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

    /// Cameras that start from poses that a network estimated, adjusted to the static tracks.
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

    /// The upward direction in the world, if the ground was found.
    pub fn up(&self) -> Option<DVec3> {
        self.ground.map(|ground| ground.normal())
    }

    /// Whether static points have depths.
    pub fn have_parallax(&self) -> bool {
        self.standpoint == Standpoint::Moves
    }

    /// Inverse depth of all pixels of a frame without parallax: a wall at depth 1 in front of a fixed camera,
    /// or the sphere of radius 1 around a camera that rotates in place. `None` if there is parallax.
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

    /// Keeps only the tracks with the given indices, each in its given new form.
    pub fn keep(&mut self, kept: &[(usize, PointTrack)]) {
        let lives = |track: &PointTrack, anchor: &Anchor| track.at(anchor.frame).is_some();
        let anchor =
            |(i, track): &(usize, PointTrack)| self.anchors[*i].filter(|a| lives(track, a));
        self.anchors = kept.iter().map(anchor).collect();
    }

    /// The position in the world of a track's point.
    pub fn point(&self, tracks: &[PointTrack], i: usize) -> Option<DVec3> {
        let Anchor { frame, inverse_depth } = self.anchors[i].filter(|a| a.inverse_depth > 1e-9)?;
        let ray = self.intrinsics.ray(tracks[i].at(frame)?);
        Some(self.poses[frame].inverse().apply(ray / inverse_depth))
    }

    /// Rescales the world so that the median depth of the static points in the cameras that see them is 1,
    /// and makes the first camera's frame the world. With supplied poses the world's origin and axes are
    /// kept.
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

    /// Makes `unit` world units the new unit.
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
