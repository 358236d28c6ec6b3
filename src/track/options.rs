//! Prior knowledge about a clip, and settings of tracking.

use serde::Serialize;

use crate::data::Clip;
use crate::observe::EstimatedDepth;
use crate::types::{Image, Intrinsics, Pose, Tracks};
use crate::{Error, Result};

/// Which supplied camera parameters are refined to fit the clip.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Refined {
    /// The supplied poses are initial values; the first pose and the scale are kept.
    pub poses: bool,
    /// The given focal length is the initial value; it is kept where the clip does not determine it.
    pub focal: bool,
}

/// Cameras that a network estimated. They are a second starting point beside the cameras found from the video
/// alone.
#[derive(Clone, Debug, Serialize)]
pub struct Guess {
    /// `view_from_world` per frame, in any unit.
    pub poses: Vec<Pose>,
    /// Focal length in pixels of the frames.
    pub focal: f64,
    /// Relative standard deviation of the focal length.
    pub focal_deviation: f64,
    /// The name of their source in notes.
    pub from: String,
}

/// Prior knowledge about a clip, and settings of tracking.
#[derive(Clone, Debug, Serialize)]
pub struct Options {
    /// The camera's intrinsics, if known; they take precedence over `focal`.
    pub intrinsics: Option<Intrinsics>,
    /// Focal length in pixels of the frames, if known.
    pub focal: Option<f64>,
    /// `view_from_world` per frame, in any unit, if known. Poses are kept except for their unit, see
    /// [`Track::unit`](super::Track::unit), unless they are to be refined.
    pub poses: Option<Vec<Pose>>,
    /// Which of these are refined.
    pub refined: Refined,
    /// An initial guess of the cameras, which is adjusted to the clip. The result is kept if it then explains
    /// more of the observations than the cameras found from the video alone. `poses` take precedence over the
    /// guessed poses, and a given `focal` over the guessed focal length.
    pub guess: Option<Guess>,
    /// Motion masks, one channel, 1 where something moves, if known. They are kept, except in frames whose
    /// mask contradicts the masks of neighbouring frames and the measured motion; those frames are listed in
    /// a note.
    pub masks: Option<Vec<Image>>,
    /// Depth maps (z), one channel, if known, up to one scale for the whole clip; 0 or not finite where
    /// unknown. They are kept except for that scale.
    pub depth: Option<Vec<Image>>,
    /// Depth that a network has estimated, if any. Each frame is first scaled to the triangulated depth. The
    /// estimate then fills in what the clip does not determine, and gives the movers' shapes and distances.
    /// It cannot be combined with `depth`.
    pub estimated_depth: Option<EstimatedDepth>,
    /// Supplied point tracks, if any, with positions in pixels at the size of the frames. They are used in
    /// addition to the program's own tracks.
    pub tracks: Option<Tracks>,
    /// The number of rounds in which masks and poses are alternated; at least 1.
    pub rounds: usize,
    /// The index into [`Quality::motions`](super::Quality::motions) of the static world's rigid motion;
    /// chosen automatically if not given. It cannot be combined with poses or masks, which determine the
    /// static world already.
    pub static_motion: Option<usize>,
    /// Whether each track's point is located again in the images. Otherwise tracks keep the positions from
    /// chained flow, which drift.
    pub refine_tracks: bool,
    /// Whether the lens distortion is estimated and removed. Otherwise the frames are taken as those of a
    /// pinhole.
    pub lens: bool,
    /// Whether the exposure of each frame is measured. Frames that differ are then brought to one exposure
    /// before their colours are compared.
    pub exposure: bool,
    /// Whether static depth is measured by multi-view stereo over the whole clip. Otherwise it comes only
    /// from the flow between neighbouring frames.
    pub stereo: bool,
    /// Whether movers are lifted as objects, each with a shape, a path and a distance. Otherwise each mask
    /// region of a frame has one depth.
    pub lift: bool,
    /// The maximum number of static points to return.
    pub max_points: usize,
    /// Seed of the random numbers; the same seed gives the same result.
    pub seed: u64,
}

impl Default for Options {
    fn default() -> Options {
        Options {
            intrinsics: None,
            focal: None,
            poses: None,
            refined: Refined::default(),
            guess: None,
            masks: None,
            depth: None,
            estimated_depth: None,
            tracks: None,
            rounds: 2,
            static_motion: None,
            refine_tracks: true,
            lens: true,
            exposure: true,
            stereo: true,
            lift: true,
            max_points: 60_000,
            seed: 0,
        }
    }
}

impl Options {
    /// The maximum number of rigid motions that are distinguished in a clip.
    pub const MOST_MOTIONS: usize = 5;

    /// Whether depth of the clip is given, either supplied or estimated by a network.
    pub(super) fn has_depth(&self) -> bool {
        self.depth.is_some() || self.estimated_depth.is_some()
    }

    /// Checks that the frames can be tracked and that the supplied data fit them.
    pub(super) fn check(&self, frames: &[Image]) -> Result<()> {
        let n = frames.len();
        let least = Clip::LEAST;
        let Some(first) = frames.first().filter(|_| n >= least) else {
            return Err(Error::Input(format!(
                "{n} frame{} given; cameras are found from a moving camera's video, {least} frames at \
                 least",
                if n == 1 { "" } else { "s" }
            )));
        };
        if first.width < 16 || first.height < 16 {
            return Err(Error::Input(format!(
                "the frames are {}×{}; at least 16 pixels a side are needed",
                first.width, first.height
            )));
        }
        if let Some(i) = frames
            .iter()
            .position(|f| (f.width, f.height, f.channels) != (first.width, first.height, 3))
        {
            let f = &frames[i];
            return Err(Error::Input(format!(
                "frame {i} is {}×{} with {} channels, the first frame is {}×{}; all frames must be RGB \
                 of one size",
                f.width, f.height, f.channels, first.width, first.height
            )));
        }
        if self.static_motion.is_some() && (self.poses.is_some() || self.masks.is_some()) {
            let what = "a rigid motion was asked for as the static world's, but poses or masks say it already";
            return Err(Error::Input(what.into()));
        }
        let nothing = |what: &str| {
            let why = format!("{what} to be refined, but not supplied");
            Err(Error::Input(why))
        };
        if self.refined.poses && self.poses.is_none() {
            return nothing("poses are");
        }
        if self.refined.focal && self.focal.is_none() && self.intrinsics.is_none() {
            return nothing("the focal length is");
        }
        let confidence = self.estimated_depth.as_ref().and_then(|told| told.confidence.as_ref());
        let lists = [
            ("poses", self.poses.as_ref().map(Vec::len)),
            ("guessed poses", self.guess.as_ref().map(|guess| guess.poses.len())),
            ("masks", self.masks.as_ref().map(Vec::len)),
            ("depth maps", self.depth.as_ref().map(Vec::len)),
            ("estimated depth maps", self.estimated_depth.as_ref().map(|told| told.maps.len())),
            ("confidences of estimated depth", confidence.map(Vec::len)),
            (
                "places of each point",
                self.tracks.as_ref().filter(|t| !t.points.is_empty()).map(Tracks::frames),
            ),
        ];
        for (what, length) in lists {
            if let Some(length) = length.filter(|l| *l != n) {
                return Err(Error::Input(format!(
                    "{length} {what} are supplied for {n} frames; give one for each frame"
                )));
            }
        }
        if self.depth.is_some() && self.estimated_depth.is_some() {
            let what = "depth that is kept and depth that a network estimated are supplied; give one of them";
            return Err(Error::Input(what.into()));
        }
        let estimated = self.estimated_depth.as_ref().map(|told| &told.maps);
        for (what, images) in [
            ("mask", self.masks.as_ref()),
            ("depth map", self.depth.as_ref()),
            ("estimated depth map", estimated),
            ("confidence of estimated depth", confidence),
        ] {
            for (i, image) in images.into_iter().flatten().enumerate() {
                if (image.width, image.height, image.channels) != (first.width, first.height, 1) {
                    return Err(Error::Input(format!(
                        "supplied {what} {i} is {}×{} with {} channels, the frames are {}×{}; give one \
                         channel at the size of the frames",
                        image.width, image.height, image.channels, first.width, first.height
                    )));
                }
            }
        }
        let guess = self.guess.as_ref();
        for (i, pose) in guess.iter().flat_map(|guess| &guess.poses).enumerate() {
            pose.check().map_err(|what| Error::Input(format!("guessed pose {i}: {what}")))?;
        }
        for (i, pose) in self.poses.iter().flatten().enumerate() {
            pose.check().map_err(|what| Error::Input(format!("supplied pose {i}: {what}")))?;
        }
        if let Some(focal) = self.focal.or(guess.map(|guess| guess.focal)) {
            let checked = Intrinsics::centred(focal, first.width, first.height).check();
            let refused = |what| format!("a focal length of {focal:?} px makes no sense: {what}");
            checked.map_err(|what| Error::Input(refused(what)))?;
        }
        if let Some(intrinsics) = &self.intrinsics {
            let refused = |what| Error::Input(format!("the supplied intrinsics: {what}"));
            intrinsics.check().map_err(refused)?;
        }
        if let Some(k) =
            self.intrinsics.filter(|k| (k.width, k.height) != (first.width, first.height))
        {
            return Err(Error::Input(format!(
                "the supplied intrinsics are of {}×{} pixels, the frames are {}×{}; resize them",
                k.width, k.height, first.width, first.height
            )));
        }
        Ok(())
    }
}
