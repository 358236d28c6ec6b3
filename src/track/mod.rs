//! Motion-aware bundle adjustment: estimates cameras, motion masks and depth from frames and optical flow.
//!
//! | module | what it does |
//! |---|---|
//! | `still` | detects a camera that is fixed or that only zooms |
//! | `cameras` | focal length, two-view start, PnP per frame, bundle adjustment; rotating cameras |
//! | `rounds` | alternates between estimating cameras and masks |
//! | `undistorted` | the clip with the lens distortion removed |
//! | `residual` | per pixel: the inverse depth of a static world, and the residual that it leaves |
//! | `photometric` | photometric evidence that a pixel moved |
//! | `plate` | the background plate: what each frame would show if nothing moved |
//! | `masks` | dense motion masks that follow image edges, from the residuals |
//! | `carried` | masks carried between frames along the movers' own motion |
//! | `prompted` | masks of movers that a segmentation network draws at prompted points |
//! | `mended` | repairs supplied masks that flicker or slip, from neighbouring frames and measured motion |
//! | `stereo` | static depth from the frames of the whole clip |
//! | `depth` | depth of all pixels: measured where possible, otherwise inferred and marked as such |
//! | `objects` | groups moving points that belong together into objects |
//! | `relief` | the depth of an object's pixels relative to the depth of its middle |
//! | `shape` | each object's shape and path up to scale |
//! | `movers` | depth of movers' pixels, from shapes and distances |
//! | `estimated` | depth that a network has estimated, scaled frame by frame to the world's unit |
//! | `distance` | the distance of an object, from ground contact, its size, its flight or a smooth path |
//! | `ballistic` | the distance of objects that fly, from their parabolas |
//! | `contact` | the distance of an object that touches the ground |
//! | `path` | an object's path, bent towards estimates of its depth |
//! | `lower_end` | what an object stands on or passes in front of |
//! | `unfollowed` | parts of movers on which no point could be tracked |
//! | `contour` | an object's pixels in a frame, and what its contour borders on |
//! | `outline` | an object's position and size, from its outline |
//! | `disc` | the position of a ball, from its contour |
//! | `shade` | the shadows of movers, and the control points that carry them |
//! | [`scaffold`] | control points on movers, each tracked through the whole clip |
//! | `smooth` | the scale of a path, from the assumption that objects move smoothly |
//! | `options` | prior knowledge and settings |
//! | `observer` | progress reports, and saving of finished parts |
//! | `places` | where a point of the scene is in every frame |
//! | `points` | static points to seed Gaussians with |
//! | `quality` | the uncertainty of the result, and the notes about it |
//! | `landmarks` | observations of static points, and how well they agree with the cameras |
//!
//! Cameras and masks depend on each other: points on movers bias the poses, and movers can be detected only
//! against known cameras. The two are alternated ([`Options::rounds`]): robust estimation starts with an
//! almost empty mask, then each round weights the tracks by the masks of the previous round. Where movers
//! fill most of the image, the static world is first chosen from several rigid motions
//! ([`Quality::motions`]).

mod ballistic;
mod cameras;
mod carried;
mod contact;
mod contour;
mod depth;
mod disc;
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
mod path;
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

/// The stage of tracking that a progress report refers to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stage {
    /// Optical flow between neighbouring frames.
    Flow,
    /// Focal length, two-view start, poses, bundle adjustment.
    Cameras,
    /// Motion masks.
    Masks,
    /// Depth and points.
    Depth,
}

/// Cameras, motion and depth of a clip. The world's unit is the median depth of the static points in the
/// cameras that see them, regardless of the unit of supplied poses; see `unit`. The world's origin and axes
/// are the first camera's, or those of the supplied poses.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Track {
    /// Intrinsics of all frames.
    pub intrinsics: Intrinsics,
    /// Transforms from the world to the camera, one per frame.
    pub view_from_world: Vec<Pose>,
    /// Motion masks, one per frame, one channel: the probability that the pixel shows something that moves.
    pub masks: Vec<Image>,
    /// Depth maps, one per frame, one channel: z in the camera frame, in the world's unit, positive
    /// everywhere; see `depth_confidence`.
    pub depth: Vec<Image>,
    /// Confidence of the depth, one map per frame, one channel, in [0, 1]. Above 0.5 the depth was
    /// triangulated or supplied. At or below 0.5 it was filled in from the surroundings or, on movers, solved
    /// for object by object: up to 0.4 where the object's scale is known, 0.2 where only a bound on it is
    /// known.
    pub depth_confidence: Vec<Image>,
    /// The moving objects.
    pub movers: Vec<Mover>,
    /// Object maps, one per frame, one channel: the index into `movers` of the object that the pixel shows,
    /// plus one; 0 where no object is known.
    pub owners: Vec<Image>,
    /// Shadow maps, one per frame, two channels. The first is the share of the light that the shadow of a
    /// mover removes from the static scene, 0 without a shadow. The second is the owner number of the control
    /// points of `scaffold` that carry this shadow; it is larger than the numbers of all objects.
    pub shadows: Vec<Image>,
    /// Control points on the movers and on their shadows.
    pub scaffold: Scaffold,
    /// The exposure of each frame. The colours in `points` are at the exposure of the whole clip.
    pub exposure: Exposure,
    /// Static points.
    pub points: Vec<StaticPoint>,
    /// Tracks of static and moving points through the frames.
    pub tracks: Vec<PointTrack>,
    /// The estimated lens of the clip; none if it is a pinhole. Everything else here refers to the images
    /// that a pinhole with `intrinsics` would have taken: see [`undistorted`](Track::undistorted).
    pub lens: Option<Lens>,
    /// The length of one world unit in the unit of the supplied poses; 1 if none were supplied.
    pub unit: f64,
    /// The uncertainty of the result.
    pub quality: Quality,
}

impl Track {
    /// The training frames: undistorted, and at one common exposure.
    pub fn prepared<'a>(&self, frames: &'a [Image]) -> Cow<'a, [Image]> {
        match self.exposure.even_all(frames) {
            Cow::Borrowed(frames) => self.undistorted(frames),
            Cow::Owned(even) => Cow::Owned(self.undistorted(&even).into_owned()),
        }
    }

    /// The frames without the lens distortion; all other fields of the track refer to these.
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
    /// The frame in which the object is first seen.
    pub first: usize,
    /// Transforms from the object's own coordinate frame to the world, one per frame from `first` to the last
    /// frame in which the object is seen. A rigid object is at rest in its own coordinate frame.
    pub world_from_object: Vec<Sim3>,
}

impl Mover {
    /// The object's transform in any frame of the clip. Before the object is first seen and after it is last
    /// seen, this is the nearest known transform.
    pub fn world_from_object(&self, frame: usize) -> Sim3 {
        let last = self.world_from_object.len().saturating_sub(1);
        let k = frame.saturating_sub(self.first).min(last);
        self.world_from_object.get(k).copied().unwrap_or(Sim3::IDENTITY)
    }
}

/// A point of the static world.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct StaticPoint {
    /// Position in the world.
    pub position: DVec3,
    /// RGB, encoded values in [0, 1].
    pub colour: [f32; 3],
    /// The frame that the point was taken from.
    pub frame: usize,
    /// Relative standard deviation of the point's depth.
    pub deviation: f32,
}

/// The source of the focal length.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum FocalSource {
    /// The caller supplied it.
    Given,
    /// It was estimated from the clip.
    Measured,
    /// A common default value is used because the clip does not determine it.
    Assumed,
}

/// Estimates cameras, motion masks and depth of a clip.
///
/// `progress` receives the stage and the completed share of that stage; an error from it ends the work.
///
/// # Errors
/// Returns an error for fewer than [`Clip::LEAST`](crate::data::Clip::LEAST) frames, frames or supplied
/// images of differing sizes, supplied lists of the wrong length, masks that leave nothing static, a clip
/// without parallax (the [`Error::Input`] describes what to film instead), and flow that tracks too few
/// points.
pub fn track(
    frames: &[Image],
    options: &Options,
    source: &mut dyn FlowSource,
    progress: &mut dyn FnMut(Stage, f64) -> Result<()>,
) -> Result<Track> {
    let sources = Sources { flow: source, masks: None, features: None };
    track_observed(frames, options, sources, &mut Progress(progress))
}

/// The sources of observations that tracking queries.
pub struct Sources<'a> {
    /// Optical flow between neighbouring frames.
    pub flow: &'a mut dyn FlowSource,
    /// Masks of movers, if a network provides them. This source is not queried if masks are supplied.
    pub masks: Option<&'a mut dyn MaskSource>,
    /// Descriptor features that link frames which flow does not link; [`Sift`] if none is given. This source
    /// is not queried if flow links all frames.
    pub features: Option<&'a mut dyn FeatureSource>,
}

/// [`track`] with additional sources and an observer that can save finished parts. If the observer returns
/// parts that an earlier run on the same frames, options and sources has saved, then the result has the same
/// bits as that of a run that was never interrupted.
///
/// # Errors
/// As for [`track`], and whatever `observer` returns.
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
    // The masks of a fixed camera do not change any input of a further round.
    let rounds = if tripod { 1 } else { options.rounds.max(1) };
    let once = |known: Known, so_far: SoFar, round: usize, work: &mut Work| {
        let part = format!("round-{round}");
        let shares = [round, round + 1].map(|r| r as f64 / rounds as f64);
        work.part(&part, |work| known.round(so_far, work, &part, shares[0]..shares[1]))
    };
    so_far = once(known, so_far, 0, &mut work)?;
    // The lens is estimated once the movers are roughly known; the distortion is then removed for good.
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
        let mut judged = masks::Judged::new(observed, None, &mut work, part, 0.5..0.75)?;
        if !tripod {
            masks = judged.segment(None, &mut work, part, 0.75..1.0)?;
        }
        // The network is asked before the plates are computed because better masks give better plates.
        if let Some(source) = sources.masks {
            let found = prompted::ask(
                &judged,
                &masks,
                options.estimated_depth.as_ref(),
                source,
                &mut work,
                part,
            )?;
            judged.add(&found.odds);
            masks = judged.segment(None, &mut work, "last/fused", 1.0..1.0)?;
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
        let mut judged = masks::Judged::new(observed, Some(&plates), &mut work, part, 0.2..0.25)?;
        if let Some(drawn) = &drawn {
            judged.add(drawn);
        }
        masks = judged.segment(None, &mut work, part, 0.25..0.28)?;
        masks = carried::revised(&judged, &plates, masks, &mut work, part, 0.28..0.3)?;
    }
    let mut ground = None;
    if cameras.have_parallax() && options.stereo && options.depth.is_none() {
        let shares = 0.3..0.7;
        let measured =
            stereo::measure(frames, &cameras, &masks, &seen, &mut work, "depth", shares)?;
        (seen, ground) = (measured.seen, measured.ground);
    }
    let static_world = layers(&seen, &masks, None, &mut work, "depth/layers", 0.7..0.75)?;
    let plates = plates(&static_world, &masks, &mut work, "depth/plates", 0.75..0.85)?;
    let layers = layers(&seen, &masks, Some(&plates), &mut work, "depth", 0.85..0.9)?;
    cameras.ground = ground;
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

/// Computes the flow of all pairs of neighbouring frames. Each pair is saved if the flow source is costly.
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

/// Share of moving pixels below which the clip of a fixed camera shows a still image and not a scene.
const NOTHING_MOVES: f64 = 1e-3;

/// The share of the pixels that move, over all frames.
fn share(masks: &[Image]) -> f64 {
    let moving: usize = masks.iter().flat_map(|m| &m.pixels).filter(|p| **p > 0.5).count();
    let pixels: usize = masks.iter().map(|m| m.pixels.len()).sum();
    moving as f64 / pixels.max(1) as f64
}

/// Tracks of feature points that link the frames which `tracks` do not link.
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

/// The derivatives of a pixel's coordinates with respect to the point in the camera frame that it shows.
fn pixel_gradients(intrinsics: &Intrinsics, point: DVec3) -> [DVec3; 2] {
    [
        DVec3::new(1.0, 0.0, -point.x / point.z) * (intrinsics.fx / point.z),
        DVec3::new(0.0, 1.0, -point.y / point.z) * (intrinsics.fy / point.z),
    ]
}

/// The quantile of the values at `share`; 0 for an empty list.
fn quantile(mut values: Vec<f64>, share: f64) -> f64 {
    if values.is_empty() {
        return 0.0;
    }
    let place = ((values.len() - 1) as f64 * share).round() as usize;
    *values.select_nth_unstable_by(place, f64::total_cmp).1
}

/// Width and height of the frames that a flow belongs to, in pixels.
fn intrinsics_size(flow: &NeighbourFlow) -> (u32, u32) {
    (flow.width as u32, flow.height as u32)
}
