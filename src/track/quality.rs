//! How well the result of tracking is known, and what is said about it.

use serde::{Deserialize, Serialize};

use super::cameras::{Cameras, Motions, RigidMotion, Standpoint};
use super::landmarks::{self, FrameQuality};
use super::rounds::Guessed;
use super::{FocalSource, share};
use crate::data::Lens;
use crate::observe::PointTrack;
use crate::types::Image;

/// How well a track is known.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Quality {
    /// The camera was found to be fixed; poses are locked to one.
    pub tripod: bool,
    /// The camera was found to turn in place: the static world is a sphere of radius 1 around it, its
    /// poses are rotations.
    pub turns: bool,
    /// Share of the static observations that agree with the cameras (of a fixed one: that stay in
    /// place).
    pub inlier_share: f64,
    /// Root mean square reprojection error of those (of a fixed one: how far they stray), pixels.
    pub reprojection_rms: f64,
    /// Median over the static points of the widest angle between two of their rays, degrees.
    pub parallax_deg: f64,
    /// Where the focal length is from.
    pub focal_source: FocalSource,
    /// Relative standard deviation of the focal length; 0 if given, infinite if unobservable.
    pub focal_std: f64,
    /// Share of the pixels that move, over all frames.
    pub dynamic_share: f64,
    /// Frames whose pose is doubtful: too few static points agreed.
    pub doubtful_frames: Vec<usize>,
    /// How well each frame's camera is known.
    pub per_frame: Vec<FrameQuality>,
    /// Number of point tracks followed.
    pub tracks: usize,
    /// The rigid motions that the static world was chosen from, where that was in doubt.
    pub motions: Vec<RigidMotion>,
    /// Which of them was taken.
    pub static_motion: Option<usize>,
    /// What was taken of that which others told.
    pub told: Told,
    /// Lines to show.
    pub notes: Vec<String>,
}

/// What was taken of that which other sources than the flow told.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Told {
    /// Whether cameras begin with those that were guessed; none where none were.
    pub guess: Option<bool>,
    /// Whether there was estimated depth.
    pub estimated_depth: bool,
    /// Frames in which a drawn mask was accepted; none where none were asked for.
    pub masks: Option<usize>,
    /// Points that descriptors found in frames which flow does not link.
    pub linked: usize,
}

/// A note names no more frames than these.
const MOST_NAMED: usize = 12;
/// Below this parallax (degrees) a note warns.
const LITTLE_PARALLAX: f64 = 0.5;

/// What is known of a clip that was tracked.
pub(super) fn of(
    cameras: &Cameras,
    tracks: &[PointTrack],
    weights: &[f64],
    masks: &[Image],
    motions: Option<Motions>,
) -> Quality {
    let tripod = cameras.standpoint == Standpoint::Fixed;
    let turns = cameras.standpoint == Standpoint::Turns;
    let dynamic_share = share(masks);
    let mut notes = Vec::new();
    if tripod {
        notes.push("the camera is fixed (tripod): poses are locked to one".to_string());
    }
    if turns {
        notes.push(
            "the camera turns in place as far as the video tells: no depth is seen, what stands still is a \
             sphere around it, what moves stands before that; film while walking or moving the camera \
             sideways to see depth"
                .to_string(),
        );
    }
    if cameras.focal_source == FocalSource::Assumed {
        notes.push(format!(
            "the clip does not show its focal length; {:.0} px is assumed (a known one can be given)",
            cameras.intrinsics.fx
        ));
    }
    if !cameras.doubtful.is_empty() {
        notes.push(format!(
            "{} of {} poses are doubtful: too few static points agree with them",
            cameras.doubtful.len(),
            cameras.poses.len()
        ));
    }
    if let Some(motions) = &motions {
        notes.push(motions.note());
    }
    if dynamic_share > 0.7 {
        notes.push(format!(
            "{:.0} % of the pixels move; cameras from the little that stands still are less certain",
            100.0 * dynamic_share
        ));
    }
    let parallax = cameras.have_parallax();
    let parallax_deg = if parallax { cameras.parallax(tracks, weights).to_degrees() } else { 0.0 };
    if parallax && parallax_deg < LITTLE_PARALLAX {
        notes.push(format!(
            "little parallax ({parallax_deg:.2}° at the middle point): the camera hardly leaves its \
             place, depth and focal length are uncertain; film with more sideways motion"
        ));
    }
    Quality {
        tripod,
        turns,
        inlier_share: cameras.inlier_share,
        reprojection_rms: cameras.rms,
        parallax_deg,
        focal_source: cameras.focal_source,
        focal_std: cameras.focal_std,
        dynamic_share,
        doubtful_frames: cameras.doubtful.clone(),
        per_frame: landmarks::by_frame(cameras, tracks, weights),
        tracks: tracks.len(),
        static_motion: motions.as_ref().map(|motions| motions.chosen),
        motions: motions.map_or(Vec::new(), |motions| motions.found),
        told: Told::default(),
        notes,
    }
}

/// That the lens is no pinhole.
pub(super) fn lens_note(lens: &Lens) -> String {
    format!(
        "the lens distorts the picture (k1 {:+.4}); all that is found is of undistorted frames",
        lens.distortion.radial[0]
    )
}

/// What became of cameras that a network tells.
pub(super) fn guess_note(from: &str, guessed: Option<Guessed>) -> String {
    match guessed {
        Some(shares) if shares.is_kept() => format!(
            "cameras begin with {from}, adjusted to the video: they explain {:.0} % of what is seen, cameras from \
             the video alone {:.0} %",
            100.0 * shares.begun,
            100.0 * shares.alone
        ),
        Some(shares) => format!(
            "cameras are from the video alone and explain {:.0} % of what is seen; those that begin with {from} \
             explain {:.0} % and are not taken",
            100.0 * shares.alone,
            100.0 * shares.begun
        ),
        None => format!(
            "cameras are not those that begin with {from}: the video alone tells them better, or they are given"
        ),
    }
}

/// That supplied masks were not kept.
pub(super) fn mended_note(frames: &[usize]) -> String {
    let named: Vec<String> = frames.iter().take(MOST_NAMED).map(usize::to_string).collect();
    let more = if frames.len() > MOST_NAMED { ", …" } else { "" };
    format!(
        "the supplied masks of {} frames ({}{more}) are contradicted by those of the frames around them \
         and by what moves, and were mended",
        frames.len(),
        named.join(", ")
    )
}

/// Whose masks were taken, where a network was asked.
pub(super) fn features_note(found: usize) -> String {
    format!("features: {found} points link frames that flow does not")
}

pub(super) fn masks_note(accepted: usize, frames: usize) -> String {
    format!("masks: the network's accepted in {accepted} of {frames} frames")
}
