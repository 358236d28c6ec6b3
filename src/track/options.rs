//! What is known of a clip beforehand, and how hard to try.

use serde::Serialize;

use crate::data::Clip;
use crate::observe::EstimatedDepth;
use crate::types::{Image, Intrinsics, Pose, Tracks};
use crate::{Error, Result};

/// What is supplied and yet adjusted to what the clip shows.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Refined {
    /// Poses begin as they are supplied; the first one and the scale are kept.
    pub poses: bool,
    /// The focal length begins as it is given, and stays so where the clip does not show it.
    pub focal: bool,
}

/// Cameras that a network tells. They are where the search begins, beside what the video alone tells.
#[derive(Clone, Debug, Serialize)]
pub struct Guess {
    /// `view_from_world` per frame, in any unit.
    pub poses: Vec<Pose>,
    /// Focal length in pixels of the frames.
    pub focal: f64,
    /// Its relative standard deviation.
    pub focal_deviation: f64,
    /// What they are called in notes.
    pub from: String,
}

/// What is known beforehand, and how hard to try.
#[derive(Clone, Debug, Serialize)]
pub struct Options {
    /// The camera's inner geometry, where it is known; wins over `focal`.
    pub intrinsics: Option<Intrinsics>,
    /// Focal length in pixels of the frames, where it is known.
    pub focal: Option<f64>,
    /// `view_from_world` per frame, where it is known, in any unit: kept but for that, see
    /// [`Track::unit`](super::Track::unit), unless it is to be refined.
    pub poses: Option<Vec<Pose>>,
    /// Which of these are adjusted.
    pub refined: Refined,
    /// Where cameras may begin that are adjusted to what the clip shows. They are kept if they then explain more of
    /// it than those from the video alone; `poses` win over them, and so does a `focal` that is given.
    pub guess: Option<Guess>,
    /// Motion masks, one channel, 1 where something moves, where they are known: kept, but for frames
    /// whose mask is contradicted by those of the frames around and by what moves, which are noted.
    pub masks: Option<Vec<Image>>,
    /// Depth (z), one channel, up to one scale for the whole clip, 0 or not finite where unknown,
    /// where it is known: kept but for that scale.
    pub depth: Option<Vec<Image>>,
    /// Depth that a network has estimated, where there is some: it fills in what the clip does not show, and tells
    /// the movers' shapes and distances, once each frame is brought to the scale of what was
    /// triangulated. Does not go with `depth`.
    pub estimated_depth: Option<EstimatedDepth>,
    /// Points that are followed already, places at the size of the frames, where there are any: they are
    /// taken in besides the program's own.
    pub tracks: Option<Tracks>,
    /// How many times masks and poses are alternated; at least 1.
    pub rounds: usize,
    /// Which of the rigid motions that the clip shows is the static world's, as
    /// [`Quality::motions`](super::Quality::motions) counts them; found if not given. Does not go with
    /// poses or masks, which say it already.
    pub static_motion: Option<usize>,
    /// Whether each track's point is found again in the pictures; else it keeps the places that chained
    /// flow gives, which drift.
    pub refine_tracks: bool,
    /// Whether the lens's distortion is looked for and taken off; else the frames are a pinhole's.
    pub lens: bool,
    /// Whether the exposure of each frame is measured, and frames that differ are made equal before
    /// their colours are compared.
    pub exposure: bool,
    /// Whether static depth is measured in the pictures of the whole clip by multi-view stereo; else it is
    /// that of the flow between neighbouring frames alone.
    pub stereo: bool,
    /// Whether movers are lifted as objects, each with a shape, a path and a distance; else each has one
    /// depth per region of the mask and frame.
    pub lift: bool,
    /// Most static points to return.
    pub max_points: usize,
    /// The same seed gives the same result.
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
    /// At most so many rigid motions of a clip are told apart.
    pub const MOST_MOTIONS: usize = 5;

    /// Whether depth of the clip is known beforehand, be it from a network.
    pub(super) fn has_depth(&self) -> bool {
        self.depth.is_some() || self.estimated_depth.is_some()
    }

    /// That frames can be tracked, and that what is supplied fits them.
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
