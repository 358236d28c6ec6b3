//! The uncertainty of the tracking result, and the notes about it.

use serde::{Deserialize, Serialize};

use super::cameras::{Cameras, Motions, RigidMotion, Standpoint};
use super::landmarks::{self, FrameQuality};
use super::rounds::Guessed;
use super::{FocalSource, share};
use crate::data::Lens;
use crate::observe::PointTrack;
use crate::types::Image;

/// The uncertainty of a track.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Quality {
    /// Whether the camera was found to be fixed; all poses are then identical.
    pub tripod: bool,
    /// Whether the camera was found to rotate in place. The static world is then a sphere of radius 1 around
    /// it, and its poses are pure rotations.
    pub turns: bool,
    /// Share of the static observations that agree with the cameras; for a fixed camera, the share that does
    /// not move.
    pub inlier_share: f64,
    /// Root mean square reprojection error of the agreeing observations, pixels; for a fixed camera, their
    /// deviation from a constant position.
    pub reprojection_rms: f64,
    /// Median over the static points of the widest angle between two of their rays, degrees.
    pub parallax_deg: f64,
    /// The source of the focal length.
    pub focal_source: FocalSource,
    /// Relative standard deviation of the focal length; 0 if given, infinite if unobservable.
    pub focal_std: f64,
    /// Share of the pixels that move, over all frames.
    pub dynamic_share: f64,
    /// Frames whose pose is doubtful because too few static points agreed.
    pub doubtful_frames: Vec<usize>,
    /// The uncertainty of each frame's camera.
    pub per_frame: Vec<FrameQuality>,
    /// Number of point tracks.
    pub tracks: usize,
    /// The rigid motions that the static world was chosen from, if the choice was ambiguous.
    pub motions: Vec<RigidMotion>,
    /// The index into `motions` of the chosen motion.
    pub static_motion: Option<usize>,
    /// Which observations of sources other than flow were used.
    pub told: Told,
    /// Notes for the user, one line each.
    pub notes: Vec<String>,
}

/// Which observations of sources other than flow were used.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Told {
    /// Whether the cameras that start from the guess were kept; `None` if no guess was given.
    pub guess: Option<bool>,
    /// Whether estimated depth was supplied.
    pub estimated_depth: bool,
    /// Number of frames in which a network's mask was accepted; `None` if no network was asked.
    pub masks: Option<usize>,
    /// Number of points that link frames which flow does not link, matched by descriptors.
    pub linked: usize,
}

/// The maximum number of frames that a note lists.
const MOST_NAMED: usize = 12;
/// Parallax in degrees below which a note warns.
const LITTLE_PARALLAX: f64 = 0.5;

/// Assembles the quality of a tracked clip.
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

/// The note that the lens distorts the image.
pub(super) fn lens_note(lens: &Lens) -> String {
    format!(
        "the lens distorts the image (k1 {:+.4}); all that is found is of undistorted frames",
        lens.distortion.radial[0]
    )
}

/// The note on whether cameras that start from a network's guess were kept.
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

/// The note that supplied masks were changed.
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

/// The note on feature points that link frames.
pub(super) fn features_note(found: usize) -> String {
    format!("features: {found} points link frames that flow does not")
}

/// The note on the masks that a network drew.
pub(super) fn masks_note(accepted: usize, frames: usize) -> String {
    format!("masks: the network's accepted in {accepted} of {frames} frames")
}
