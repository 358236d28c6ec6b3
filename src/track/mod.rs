//! Motion-aware bundle adjustment: from frames and flow to cameras, motion masks and depth.
//!
//! | module | what it does |
//! |---|---|
//! | `still` | is the camera fixed, does it only zoom? |
//! | `cameras` | focal length, two-view start, PnP frame by frame, bundle adjustment; cameras that only turn |
//! | `rounds` | cameras and masks by turns |
//! | `undistorted` | the clip without the distortion of its lens |
//! | `residual` | per pixel: the inverse depth that a static world would need, and what it leaves unexplained |
//! | `photometric` | does the picture itself say that a pixel moved? |
//! | `plate` | what each frame would show if nothing moved |
//! | `masks` | from what is unexplained to a dense motion mask that keeps to the picture's edges |
//! | `prompted` | masks that a network draws of what moves, asked for by points |
//! | `mended` | supplied masks that flicker or slip, by those around and by what moves |
//! | `stereo` | static depth from the pictures of the whole clip |
//! | `depth` | depth of all pixels, measured where it can be, inferred and marked so where not |
//! | `objects` | what moves, as objects: points on it that belong together |
//! | `relief` | the depth of an object's pixels relative to its middle's |
//! | `shape` | each object's shape and path up to scale |
//! | `movers` | depth of movers' pixels, from shapes and distances |
//! | `estimated` | depth that a network has estimated, brought to the world's unit frame by frame |
//! | `distance` | how far an object is: contact with the ground, its size, a smooth path |
//! | `lower_end` | what an object stands on, or goes before |
//! | `unfollowed` | parts of movers on which no point could be followed |
//! | `contour` | an object's pixels in a frame, and what its contour borders on |
//! | `outline` | what an object's outline tells of its place and size |
//! | `shade` | the shadows of movers, and the nodes that carry them |
//! | [`scaffold`] | nodes on what moves, each carried through the whole clip |
//! | `smooth` | the scale of a path, from how smoothly things move |
//! | `options` | what is known beforehand, and how hard to try |
//! | `observer` | who looks on: progress, and finished parts put away |
//! | `places` | where a point of the scene is in every frame |
//! | `points` | static points to seed Gaussians with |
//! | `quality` | how well all this is known, and what is said about it |
//! | `landmarks` | what the frames saw of static points, and how far that agrees with the cameras |
//!
//! Cameras and masks need each other: points on movers spoil poses, and what moves can be told only
//! against known cameras. They are alternated ([`Options::rounds`]): robust estimation starts with
//! hardly any mask, then each round weighs the tracks by the masks of the one before. Where movers fill
//! most of the picture, the static world is first chosen from several rigid motions
//! ([`Quality::motions`]).

mod cameras;
mod contour;
mod depth;
mod distance;
mod estimated;
mod landmarks;
mod lower_end;
mod masks;
mod mended;
mod movers;
mod objects;
mod observer;
mod options;
mod outline;
mod photometric;
mod places;
mod plate;
mod points;
mod prompted;
mod quality;
mod relief;
mod residual;
mod rounds;
pub mod scaffold;
mod shade;
mod shape;
#[cfg(test)]
mod sliding;
mod smooth;
mod stereo;
mod still;
mod undistorted;
mod unfollowed;

use std::borrow::Cow;

use glam::{DVec2, DVec3};
use serde::{Deserialize, Serialize};

use crate::data::Lens;
use crate::geometry::sim3::Sim3;
use crate::observe::{
    Exposure, FeatureSource, Features, FlowSource, MaskSource, NeighbourFlow, PointTrack, Sift,
    TrackOptions, features, follow, refine, supplied_tracks,
};
use crate::types::{Image, Intrinsics, Pose};
use crate::{Error, Result};
use cameras::Standpoint;
use observer::{Progress, Work, numbered};
use rounds::{Known, SoFar};
use undistorted::Undistorted;

pub use cameras::RigidMotion;
pub use landmarks::{FrameQuality, Landmark};
pub use observer::Observer;
pub use options::{Guess, Options, Refined};
pub use quality::{Quality, Told};
pub use scaffold::Scaffold;

/// What is being worked on, for progress.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stage {
    /// Optical flow between neighbouring frames.
    Flow,
    /// Focal length, start, poses, bundle adjustment.
    Cameras,
    /// Motion masks.
    Masks,
    /// Depth and points.
    Depth,
}

/// Cameras, motion and depth of a clip. The world's unit is the median depth of the static points in the
/// cameras that see them, whatever that of supplied poses is; see `unit`. The world's place and axes are
/// the first camera's, or those of the supplied poses.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Track {
    /// Of all frames.
    pub intrinsics: Intrinsics,
    /// World to camera, per frame.
    pub view_from_world: Vec<Pose>,
    /// Per frame, one channel: the probability that the pixel shows something that moves.
    pub masks: Vec<Image>,
    /// Per frame, one channel: z in the camera, positive everywhere; see `depth_confidence`.
    pub depth: Vec<Image>,
    /// Per frame, one channel, in [0, 1]: how far the depth is measured. Above 0.5 it was
    /// triangulated or supplied, at or below it was filled in from the surroundings or, on movers,
    /// solved for object by object: up to 0.4 where the object's scale is known, 0.2 where only a
    /// bound is.
    pub depth_confidence: Vec<Image>,
    /// What moves, object by object.
    pub movers: Vec<Mover>,
    /// Per frame, one channel: one more than the number in `movers` of the object that the pixel
    /// shows; 0 where none is known.
    pub owners: Vec<Image>,
    /// Per frame, two channels: the share of the light that the shadow of a mover takes away from what
    /// stands still, 0 where there is none; and the number by which the nodes of `scaffold` that carry
    /// this shadow name their owner, larger than those of all objects.
    pub shadows: Vec<Image>,
    /// Nodes on what moves, shadows too.
    pub scaffold: Scaffold,
    /// How bright each frame is; colours in `points` are at the exposure of the clip as a whole.
    pub exposure: Exposure,
    /// Static points.
    pub points: Vec<StaticPoint>,
    /// Points followed through the pictures, static and moving ones.
    pub tracks: Vec<PointTrack>,
    /// The lens that the clip was found to be filmed with, where that is no pinhole. All else is of the
    /// pictures that a pinhole of `intrinsics` would have taken: see [`undistorted`](Track::undistorted).
    pub lens: Option<Lens>,
    /// One of the world's units in that of the supplied poses; 1 where none were supplied.
    pub unit: f64,
    /// How well all this is known.
    pub quality: Quality,
}

impl Track {
    /// The clip's frames as a scene is trained on them: undistorted, and of one exposure.
    pub fn prepared<'a>(&self, frames: &'a [Image]) -> Cow<'a, [Image]> {
        match self.exposure.even_all(frames) {
            Cow::Borrowed(frames) => self.undistorted(frames),
            Cow::Owned(even) => Cow::Owned(self.undistorted(&even).into_owned()),
        }
    }

    /// The frames as all that was found speaks of them: without the lens's distortion.
    pub fn undistorted<'a>(&self, frames: &'a [Image]) -> Cow<'a, [Image]> {
        match &self.lens {
            None => Cow::Borrowed(frames),
            Some(lens) => {
                let undistorted = |frame| lens.undistort(frame, &self.intrinsics).0;
                Cow::Owned(frames.iter().map(undistorted).collect())
            }
        }
    }
}

/// An object that moves.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Mover {
    /// The frame in which it is first seen.
    pub first: usize,
    /// From that frame to the last in which it is seen: from a frame of its own, in which a rigid
    /// object stands still.
    pub world_from_object: Vec<Sim3>,
}

impl Mover {
    /// Where it is in any frame; before it is first seen and after it is last seen it stays.
    pub fn world_from_object(&self, frame: usize) -> Sim3 {
        let last = self.world_from_object.len().saturating_sub(1);
        let k = frame.saturating_sub(self.first).min(last);
        self.world_from_object.get(k).copied().unwrap_or(Sim3::IDENTITY)
    }
}

/// A point of the static world.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct StaticPoint {
    /// In the world.
    pub position: DVec3,
    /// RGB, encoded values in [0, 1].
    pub colour: [f32; 3],
    /// The frame it was taken from.
    pub frame: usize,
    /// Relative standard deviation of its depth.
    pub deviation: f32,
}

/// How the focal length was come by.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum FocalSource {
    /// Given.
    Given,
    /// Measured in the clip.
    Measured,
    /// A common value: the clip does not show it.
    Assumed,
}

/// Finds cameras, motion masks and depth of a clip.
///
/// `progress` is told the stage and the share of it that is done; an error from it ends the work.
///
/// # Errors
/// Fewer than [`Clip::LEAST`](crate::data::Clip::LEAST) frames, frames or supplied images of differing
/// sizes, supplied lists of the wrong length, masks that leave nothing static, a clip without parallax
/// ([`Error::Input`] says what to do), flow that follows nothing.
pub fn track(
    frames: &[Image],
    options: &Options,
    source: &mut dyn FlowSource,
    progress: &mut dyn FnMut(Stage, f64) -> Result<()>,
) -> Result<Track> {
    let sources = Sources { flow: source, masks: None, features: None };
    track_observed(frames, options, sources, &mut Progress(progress))
}

/// What is asked about the frames while they are tracked.
pub struct Sources<'a> {
    /// The flow between neighbouring frames.
    pub flow: &'a mut dyn FlowSource,
    /// Masks of what moves, where something draws them; it is not asked where masks are supplied.
    pub masks: Option<&'a mut dyn MaskSource>,
    /// Points told apart by descriptors, which link frames that flow does not; [`Sift`] where there is no other source.
    /// It is not asked where flow links all.
    pub features: Option<&'a mut dyn FeatureSource>,
}

/// [`track`] with more sources than that of flow, and an observer that may keep finished parts, and give those that an earlier run on the
/// same frames, options and sources has kept: then the result has the same bits as that of a run that
/// was never interrupted.
///
/// # Errors
/// As for [`track`]; whatever `observer` returns.
pub fn track_observed(
    frames: &[Image],
    options: &Options,
    sources: Sources<'_>,
    observer: &mut dyn Observer,
) -> Result<Track> {
    options.check(frames)?;
    let mut work = Work::new(observer);
    let flow = observe(frames, sources.flow, &mut work)?;
    let mut tracks = follow(&flow, &TrackOptions::for_size(flow.width, flow.height));
    let size = DVec2::new(flow.width as f64, flow.height as f64);
    tracks.extend(options.tracks.iter().flat_map(|tracks| supplied_tracks(tracks, size)));
    if options.refine_tracks {
        refine(frames, &flow, &mut tracks);
    }
    let exposure = match options.exposure {
        true => Exposure::measure(frames, &tracks),
        false => Exposure::default(),
    };
    let even = exposure.even_all(frames);
    let frames = &*even;
    work.progress(Stage::Cameras, 0.0)?;
    let mut notes = Vec::new();
    let mut own = Sift;
    let source = sources.features.unwrap_or(&mut own);
    let found =
        work.part("features", |work| found_again(frames, options, source, &tracks, work))?;
    notes.extend((!found.is_empty()).then(|| quality::features_note(found.len())));
    let mut told = Told {
        estimated_depth: options.estimated_depth.is_some(),
        linked: found.len(),
        ..Told::default()
    };
    tracks.extend(found);
    if tracks.len() < 50 {
        return Err(Error::Failed(format!(
            "the flow follows only {} points from frame to frame; the frames may be blank, too \
             blurred, or not from one shot",
            tracks.len()
        )));
    }
    let supplied = options.masks.as_ref().map(|m| m.iter().map(binary).collect::<Vec<_>>());
    let mut known =
        Known { frames, options, flow: &flow, tracks: &tracks, supplied: supplied.as_deref() };
    let mut so_far = work.part("cameras", |work| known.first_cameras(work))?;
    work.progress(Stage::Cameras, 1.0)?;

    let tripod = so_far.cameras.standpoint == Standpoint::Fixed;
    let mut mended = Vec::new();
    if let Some(given) = known.supplied.filter(|_| !tripod) {
        let cameras = &so_far.cameras;
        (so_far.masks, mended) = work.part("mended", |work| known.mend(given, cameras, work))?;
        so_far.weights = masks::static_weights(&tracks, &so_far.masks);
    }
    let supplied = (!so_far.masks.is_empty()).then(|| so_far.masks.clone());
    known.supplied = supplied.as_deref();
    // A fixed camera's masks change nothing that they depend on.
    let rounds = if tripod { 1 } else { options.rounds.max(1) };
    let once = |known: Known, so_far: SoFar, round: usize, work: &mut Work| {
        let part = format!("round-{round}");
        let shares = [round, round + 1].map(|r| r as f64 / rounds as f64);
        work.part(&part, |work| known.round(so_far, work, &part, shares[0]..shares[1]))
    };
    so_far = once(known, so_far, 0, &mut work)?;
    // The lens is looked for once it is roughly known what moves, and taken off for good.
    let found = work.part("lens", |_| known.lens(&so_far))?;
    let lens = found.as_ref().map(|(lens, _)| *lens);
    let undistorted;
    if let Some((lens, cameras)) = found {
        (undistorted, so_far) = Undistorted::new(known, &lens, cameras, so_far);
        known = undistorted.known();
    }
    for round in 1..rounds {
        so_far = once(known, so_far, round, &mut work)?;
    }
    let Known { frames, options, flow, tracks, supplied } = known;
    let SoFar { mut cameras, mut masks, mut weights, motions, guess, .. } = so_far;
    if tripod && !options.has_depth() && share(&masks) < NOTHING_MOVES {
        return Err(still::no_parallax("neither the camera nor anything before it moves"));
    }
    let part = "last";
    let mut seen = residual::triangulate_frames(&cameras, flow, &mut work, part, 0.0..0.5)?;
    if tripod {
        weights = masks::static_weights(tracks, &masks);
        cameras.measure_fixed(tracks, &weights);
    }
    let mut drawn = None;
    if supplied.is_none() && (!tripod || sources.masks.is_some()) {
        let observed = masks::Observed { frames, cameras: &cameras, flow, seen: &seen };
        let judged = masks::Judged::new(observed, None, &mut work, part, 0.5..0.75)?;
        if !tripod {
            masks = judged.segment(None, &mut work, part, 0.75..1.0)?;
        }
        // Before the plates, which are the better the better it is known what moves.
        if let Some(source) = sources.masks {
            let found = prompted::ask(
                &judged,
                &masks,
                options.estimated_depth.as_ref(),
                source,
                &mut work,
                part,
            )?;
            masks = judged.segment(Some(&found.odds), &mut work, "last/fused", 1.0..1.0)?;
            notes.push(quality::masks_note(found.accepted, frames.len()));
            told.masks = Some(found.accepted);
            drawn = Some(found.odds);
        }
    } else if sources.masks.is_some() {
        notes.push("masks: the supplied ones; the network was not asked".to_owned());
    }
    if cameras.have_parallax() {
        cameras.normalise(tracks, &weights, &mut seen);
    }
    work.progress(Stage::Depth, 0.0)?;
    let layers =
        |seen: &[residual::Seen], masks: &[Image], plates, work: &mut Work, part, shares| {
            depth::layers(frames, &cameras, masks, seen, plates, options, work, (part, shares))
        };
    let plates = |layers: &[depth::Layer], masks: &[Image], work: &mut Work, part, shares| {
        plate::evidence(frames, &cameras, layers, masks, work, part, shares)
    };
    if supplied.is_none() {
        let static_world = layers(&seen, &masks, None, &mut work, "last/layers", 0.0..0.1)?;
        let plates = plates(&static_world, &masks, &mut work, "last/plates", 0.1..0.2)?;
        let observed = masks::Observed { frames, cameras: &cameras, flow, seen: &seen };
        let part = "last/masks";
        let judged = masks::Judged::new(observed, Some(&plates), &mut work, part, 0.2..0.25)?;
        masks = judged.segment(drawn.as_deref(), &mut work, part, 0.25..0.3)?;
    }
    let mut up = None;
    if cameras.have_parallax() && options.stereo && options.depth.is_none() {
        let shares = 0.3..0.7;
        let measured =
            stereo::measure(frames, &cameras, &masks, &seen, &mut work, "depth", shares)?;
        (seen, up) = (measured.seen, measured.up);
    }
    let static_world = layers(&seen, &masks, None, &mut work, "depth/layers", 0.7..0.75)?;
    let plates = plates(&static_world, &masks, &mut work, "depth/plates", 0.75..0.85)?;
    let layers = layers(&seen, &masks, Some(&plates), &mut work, "depth", 0.85..0.9)?;
    cameras.up = up;
    let depth::Dense { depth, confidence: depth_confidence, movers, owners } =
        depth::dense(frames, &cameras, flow, &masks, layers, &plates, options, &mut work)?;
    work.progress(Stage::Depth, 0.96)?;
    let points =
        points::gather(frames, &cameras, &depth, &depth_confidence, &masks, options.max_points);
    let surfaces = scaffold::Surfaces {
        intrinsics: cameras.intrinsics,
        view_from_world: &cameras.poses,
        flow,
        masks: &masks,
        depth: &depth,
        owners: &owners,
        movers: &movers,
    };
    let mut scaffold = scaffold::build(&surfaces);
    let shadows = shade::shadows(&surfaces, frames, &plates, &mut scaffold);
    let mut quality = quality::of(&cameras, tracks, &weights, &masks, motions);
    quality.notes.extend(lens.as_ref().map(quality::lens_note));
    if let Some(guessed) = &options.guess {
        quality.notes.push(quality::guess_note(&guessed.from, guess));
        told.guess = Some(guess.is_some_and(|shares| shares.is_kept()));
    }
    if !mended.is_empty() {
        quality.notes.push(quality::mended_note(&mended));
    }
    quality.notes.extend(notes);
    quality.told = told;
    work.progress(Stage::Depth, 1.0)?;
    Ok(Track {
        intrinsics: cameras.intrinsics,
        unit: cameras.unit,
        view_from_world: cameras.poses,
        masks,
        depth,
        depth_confidence,
        movers,
        owners,
        shadows,
        scaffold,
        exposure,
        points,
        tracks: tracks.to_vec(),
        lens,
        quality,
    })
}

/// The flow of all pairs, each put away where computing it again would take long.
fn observe(
    frames: &[Image],
    source: &mut dyn FlowSource,
    work: &mut Work,
) -> Result<NeighbourFlow> {
    let mut flow = NeighbourFlow::begin(frames)?;
    let pairs = frames.len() - 1;
    for first in 0..pairs {
        let part = numbered("flow", first);
        let kept = if source.is_costly() { work.kept(&part)? } else { None };
        let pair = match kept {
            Some(pair) => {
                source.known(first, &pair);
                pair
            }
            None => {
                let pair = source.pair(first)?;
                if source.is_costly() {
                    work.keep(&part, &pair)?;
                }
                pair
            }
        };
        flow.push(&pair)?;
        work.progress(Stage::Flow, (first + 1) as f64 / pairs as f64)?;
    }
    Ok(flow)
}

/// A fixed camera that sees less than this share of the pixels move shows one picture, not a scene.
const NOTHING_MOVES: f64 = 1e-3;

/// Share of the pixels that move.
fn share(masks: &[Image]) -> f64 {
    let moving: usize = masks.iter().flat_map(|m| &m.pixels).filter(|p| **p > 0.5).count();
    let pixels: usize = masks.iter().map(|m| m.pixels.len()).sum();
    moving as f64 / pixels.max(1) as f64
}

/// Tracks of points that link frames which `tracks` do not.
fn found_again(
    frames: &[Image],
    options: &Options,
    source: &mut dyn FeatureSource,
    tracks: &[PointTrack],
    work: &mut Work,
) -> Result<Vec<PointTrack>> {
    let pairs = features::unlinked(tracks, frames.len());
    let mut found = vec![Features::default(); frames.len()];
    for (number, frame) in frames.iter().enumerate() {
        if pairs.iter().any(|(a, b)| *a == number || *b == number) {
            found[number] = source.features(number, frame)?;
            work.progress(Stage::Cameras, 0.0)?;
        }
    }
    Ok(features::linked(&found, &pairs, options.seed))
}

fn binary(mask: &Image) -> Image {
    let pixels = mask.pixels.iter().map(|v| if *v > 0.5 { 1.0 } else { 0.0 }).collect();
    Image { pixels, ..*mask }
}

/// The value that `share` of the values lie below; 0 of none.
fn quantile(mut values: Vec<f64>, share: f64) -> f64 {
    if values.is_empty() {
        return 0.0;
    }
    let place = ((values.len() - 1) as f64 * share).round() as usize;
    *values.select_nth_unstable_by(place, f64::total_cmp).1
}

/// Pixels and dimensions that a flow speaks of.
fn intrinsics_size(flow: &NeighbourFlow) -> (u32, u32) {
    (flow.width as u32, flow.height as u32)
}
