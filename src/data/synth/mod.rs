//! Synthetic clips with exact ground truth, ray-traced on the CPU.
//!
//! A clip shows a furnished, fully textured room from a moving camera; most clips contain movers. Every
//! object is a mesh whose vertices are closed functions of time, so that the point behind a pixel has an
//! exact position at every other time: depth, flow, masks and visibility are computed from the same
//! triangles as the pixels. In most clips surfaces are diffuse, their light is baked at rest, and movers
//! cast no shadow, so a surface point has one colour in all frames and from all cameras. In `throw`, `hold`
//! and `walk` movers are lit at their current positions and cast shadows, and the held object is glossy.
//!
//! The room is about 6 m wide and extends 4 to 6 m in front of the camera. The world axes are those of a
//! level camera that looks into the room (x right, y down, z forward).

mod coded;
mod held;
mod mesh;
mod movers;
mod person;
mod render;
mod scene;
mod street;
mod texture;
mod thrown;
mod trace;
mod write;

use std::collections::BTreeSet;

use glam::{DVec2, DVec3};
use rayon::prelude::*;

use crate::error::{Error, Result};
use crate::io::check_memory;
use crate::types::{Camera, Image, Intrinsics, PointPath, Pose, Tracks};
use render::{Geometry, Moment, Truth};
use scene::Scene;
use trace::Hit;

pub use write::write;

/// The clips, by name:
/// - `rigid`: a cart is driven through the room, the camera moves;
/// - `bend`: a cloth ripples and a column bends, the camera moves;
/// - `crowd`: walkers cover more than half of the image, the camera moves;
/// - `still`: nothing moves but the camera;
/// - `tripod`: the cart again, the camera fixed;
/// - `throw`: a ball and a box fly past each other, spinning, over a floor that is nearly plain;
/// - `hold`: a hand turns a glossy jug before the camera;
/// - `walk`: a person with limbs walks across the room and turns;
/// - `pan`: a car passes in a street, the camera rotates in place and follows it;
/// - `follow`: the same with a hand-held camera of a standing person.
pub const NAMES: [&str; 10] =
    ["rigid", "bend", "crowd", "still", "tripod", "throw", "hold", "walk", "pan", "follow"];

/// The held-out cameras: their offset, as a share of the median depth in the middle of the clip, and its
/// direction.
const HELD_OUT: [(f64, DVec3); 3] = [
    (0.08, DVec3::new(0.8, -0.6, 0.0)),
    (0.18, DVec3::new(-0.9, -0.4, 0.17)),
    (0.30, DVec3::new(0.94, -0.3, 0.17)),
];
/// Stride of the frames whose times the held-out cameras render.
const HELD_OUT_EVERY: usize = 2;

/// Number of grid columns of the tracked points, which are taken from the first, the middle and the last
/// frame.
const TRACK_COLUMNS: u32 = 32;

/// Upper bound of a clip's size; all frames and ground truth are held in memory, bytes.
const MOST_BYTES: u64 = 8 << 30;

/// Length, size and seed of a clip.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SynthOptions {
    /// Number of frames; the motion is the same for any number.
    pub frames: usize,
    /// Width, pixels.
    pub width: u32,
    /// Height, pixels.
    pub height: u32,
    /// Seed of textures, shapes and paths. The same seed gives bit-identical clips.
    pub seed: u64,
}

impl Default for SynthOptions {
    fn default() -> SynthOptions {
        SynthOptions { frames: 24, width: 320, height: 180, seed: 0 }
    }
}

/// A clip with its ground truth. Images are `width` × `height`; `n` is the number of frames.
#[derive(Clone, Debug, PartialEq)]
pub struct Clip {
    /// The clip's name.
    pub name: String,
    /// `n` images of three channels, encoded values in [0, 1].
    pub frames: Vec<Image>,
    /// `n` times, from 0 to 1 in even steps.
    pub times: Vec<f64>,
    /// Intrinsics of all cameras.
    pub intrinsics: Intrinsics,
    /// `n` world-to-camera poses, metres.
    pub view_from_world: Vec<Pose>,
    /// `n` images of one channel: z in the camera frame at the pixel's centre, metres.
    pub depth: Vec<Image>,
    /// `n` − 1 images of two channels; `[i]` leads from frame i to i + 1: the displacement in pixels of the
    /// surface point at the pixel's centre, whether or not it is occluded there.
    pub flow_forward: Vec<Image>,
    /// `n` − 1 images of two channels; `[i]` leads from frame i + 1 to i.
    pub flow_backward: Vec<Image>,
    /// `n` − 1 images of one channel: 1 where `flow_forward` ends inside the image at a visible point, else
    /// 0.
    pub visible_forward: Vec<Image>,
    /// `n` − 1 images of one channel: the same for `flow_backward`.
    pub visible_backward: Vec<Image>,
    /// `n` images of one channel: 1 where the pixel's centre shows a mover, else 0.
    pub masks: Vec<Image>,
    /// Point tracks through the clip, of the points at a pixel grid in the first, the middle and the last
    /// frame.
    pub tracks: Tracks,
    /// Cameras offset from the path, for evaluating novel views: by 8, 18 and 30 % of the median depth.
    pub held_out: [HeldOut; 3],
    /// Whether the frames encode ground truth in their colours, see [`coded_clip`]; their values are then
    /// quantised to 16 bits.
    pub coded: bool,
}

/// A camera at a constant offset from the clip's own, with its views at every second time of the clip.
#[derive(Clone, Debug, PartialEq)]
pub struct HeldOut {
    /// Its distance from the clip's camera over the median depth of the clip's middle frame.
    pub aside: f64,
    /// Indices of the clip's frames at whose times it has views; the following lists have the same length.
    pub times: Vec<usize>,
    /// Camera of each view.
    pub cameras: Vec<Camera>,
    /// Rendered views, images of three channels.
    pub frames: Vec<Image>,
    /// Images of one channel: 1 where the pixel's centre shows a mover, else 0.
    pub masks: Vec<Image>,
    /// Images of one channel: 1 where some frame of the clip shows the static point at the pixel's centre,
    /// and on movers; else 0.
    pub covisible: Vec<Image>,
}

impl Clip {
    /// The camera of a frame.
    ///
    /// # Panics
    /// When there is no such frame.
    pub fn camera(&self, frame: usize) -> Camera {
        Camera { intrinsics: self.intrinsics, view_from_world: self.view_from_world[frame] }
    }

    /// Appends a frame's ground truth; with a frame `before` it, the first flow leads there.
    fn push_truth(&mut self, truth: Truth, before: bool) {
        self.depth.push(truth.depth);
        self.masks.push(truth.mask);
        let mut flows = truth.flows.into_iter();
        if let Some(backward) = before.then(|| flows.next()).flatten() {
            self.flow_backward.push(backward.flow);
            self.visible_backward.push(backward.visible);
        }
        if let Some(forward) = flows.next() {
            self.flow_forward.push(forward.flow);
            self.visible_forward.push(forward.visible);
        }
    }
}

/// Renders one of the clips [`NAMES`].
///
/// # Errors
/// [`Error::Input`] for an unknown name, fewer than 2 frames, an image under 16 pixels a side, or
/// a clip that would not fit into 8 GiB.
pub fn clip(name: &str, options: &SynthOptions) -> Result<Clip> {
    check(options)?;
    rendered(name, options, scene(name, options)?)
}

/// [`clip`] with frames that encode ground truth in their colours (depth, movers, the camera, the movers'
/// motion), so that a network that only decodes the colours gives exact answers: see `coded.rs` for the
/// code. Brightness keeps the clip's texture. Offset views are unchanged.
///
/// # Errors
/// Those of [`clip`]; movers that are not one rigid body, frames less than 64 pixels wide.
pub fn coded_clip(name: &str, options: &SynthOptions) -> Result<Clip> {
    check(options)?;
    let scene = scene(name, options)?;
    let motion = coded::rigid_motion(name, &scene.parts, &times(options.frames))?;
    let mut clip = rendered(name, options, scene)?;
    coded::code(&mut clip, &motion)?;
    Ok(clip)
}

fn scene(name: &str, options: &SynthOptions) -> Result<Scene> {
    Scene::new(name, options.seed).ok_or_else(|| {
        Error::Input(format!("there is no clip named {name:?}; choose one of {}", NAMES.join(", ")))
    })
}

/// Times from 0 to 1 in even steps.
fn times(frames: usize) -> Vec<f64> {
    (0..frames).map(|i| i as f64 / (frames - 1) as f64).collect()
}

fn rendered(name: &str, options: &SynthOptions, scene: Scene) -> Result<Clip> {
    let SynthOptions { frames, width, height, .. } = *options;
    let path = scene.path;
    let intrinsics = Intrinsics::centred(scene.focal * f64::from(width), width, height);
    let geometry = Geometry::new(scene);
    let times = times(frames);
    let camera =
        |time, offset| Camera { intrinsics, view_from_world: path.view_from_world(time, offset) };
    let unit = {
        let middle = times[frames / 2];
        geometry.median_depth(&geometry.at(middle), &camera(middle, DVec3::ZERO))
    };
    let shown: Vec<usize> = (0..frames).step_by(HELD_OUT_EVERY).collect();
    let mut clip = Clip {
        name: name.to_owned(),
        frames: Vec::new(),
        times: times.clone(),
        intrinsics,
        view_from_world: times.iter().map(|t| path.view_from_world(*t, DVec3::ZERO)).collect(),
        depth: Vec::new(),
        flow_forward: Vec::new(),
        flow_backward: Vec::new(),
        visible_forward: Vec::new(),
        visible_backward: Vec::new(),
        masks: Vec::new(),
        tracks: Tracks { size: Some((width, height)), points: Vec::new() },
        held_out: HELD_OUT.map(|(aside, direction)| HeldOut {
            aside,
            times: shown.clone(),
            cameras: shown
                .iter()
                .map(|i| camera(times[*i], direction.normalize() * aside * unit))
                .collect(),
            frames: Vec::new(),
            masks: Vec::new(),
            covisible: Vec::new(),
        }),
        coded: false,
    };
    let cameras: Vec<Camera> = times.iter().map(|t| camera(*t, DVec3::ZERO)).collect();
    let (queries, followed): (Vec<_>, Vec<_>) =
        points_to_follow(&geometry, &times, &cameras).into_iter().unzip();
    let point = |query| PointPath { query, ..PointPath::default() };
    clip.tracks.points = queries.into_iter().map(point).collect();
    let mut held_out_depth: [Vec<Image>; HELD_OUT.len()] = Default::default();
    // The current frame with its neighbours; the geometry of all frames is not kept.
    let mut window: [Option<Moment>; 3] = [None, None, Some(geometry.at(times[0]))];
    for here in 0..frames {
        window.rotate_left(1);
        window[2] = times.get(here + 1).map(|time| geometry.at(*time));
        let [before, Some(now), after] = &window else { break };
        clip.frames.push(geometry.picture(now, &cameras[here]));
        let places = geometry.places(followed.iter(), (now, &cameras[here]));
        for (point, (pixel, seen)) in clip.tracks.points.iter_mut().zip(places) {
            point.pixels.push(pixel);
            point.seen.push(seen);
        }
        if here % HELD_OUT_EVERY == 0 {
            for (held_out, depth) in clip.held_out.iter_mut().zip(&mut held_out_depth) {
                let camera = &held_out.cameras[here / HELD_OUT_EVERY];
                held_out.frames.push(geometry.picture(now, camera));
                let truth = geometry.truth((now, camera), &[]);
                held_out.masks.push(truth.mask);
                depth.push(truth.depth);
            }
        }
        let backward = before.iter().map(|moment| (moment, &cameras[here - 1]));
        let forward = after.iter().map(|moment| (moment, &cameras[here + 1]));
        let others: Vec<_> = backward.chain(forward).collect();
        let truth = geometry.truth((now, &cameras[here]), &others);
        clip.push_truth(truth, before.is_some());
    }
    for (held_out, depth) in clip.held_out.iter_mut().zip(&held_out_depth) {
        let views = held_out.cameras.iter().zip(depth).zip(&held_out.masks);
        let seen = views
            .map(|((camera, depth), mask)| covisible(camera, depth, mask, &cameras, &clip.depth));
        held_out.covisible = seen.collect();
    }
    Ok(clip)
}

/// The surface points at a pixel grid of the first, the middle and the last frame, each with its frame and
/// pixel.
fn points_to_follow(
    geometry: &Geometry,
    times: &[f64],
    cameras: &[Camera],
) -> Vec<((usize, DVec2), Hit)> {
    let frames = times.len();
    let pixels = grid(cameras[0].intrinsics.width, cameras[0].intrinsics.height);
    let mut points = Vec::new();
    for frame in BTreeSet::from([0, frames / 2, frames - 1]) {
        let hits = geometry.hits((&geometry.at(times[frame]), &cameras[frame]), &pixels);
        let met = pixels.iter().zip(hits);
        points.extend(met.filter_map(|(pixel, hit)| Some(((frame, *pixel), hit?))));
    }
    points
}

/// Centres of the pixels on a grid.
fn grid(width: u32, height: u32) -> Vec<DVec2> {
    let spacing = (width / TRACK_COLUMNS).max(1);
    let along = |size: u32| (spacing / 2..size).step_by(spacing as usize);
    let centre = |x, y| DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
    along(height).flat_map(|y| along(width).map(move |x| centre(x, y))).collect()
}

/// 1 where a frame of the clip shows the point at a pixel's centre, and on movers.
fn covisible(
    camera: &Camera,
    depth: &Image,
    mask: &Image,
    cameras: &[Camera],
    depth_of_frames: &[Image],
) -> Image {
    let world_from_view = camera.view_from_world.inverse();
    let mut seen = mask.clone();
    let width = depth.width as usize;
    seen.pixels.par_iter_mut().enumerate().filter(|(_, seen)| **seen == 0.0).for_each(
        |(pixel, seen)| {
            let centre = DVec2::new((pixel % width) as f64 + 0.5, (pixel / width) as f64 + 0.5);
            let z = f64::from(depth.pixels[pixel]);
            let point = world_from_view.apply(camera.intrinsics.ray(centre) * z);
            let shown =
                z > 0.0 && cameras.iter().zip(depth_of_frames).any(|(c, d)| shows(c, d, point));
            *seen = f32::from(shown);
        },
    );
    seen
}

/// Whether a frame shows a point: it is not behind all of the surrounding pixels.
fn shows(camera: &Camera, depth: &Image, point: DVec3) -> bool {
    let local = camera.view_from_world.apply(point);
    if local.z <= 0.0 {
        return false;
    }
    let at = camera.intrinsics.project(local);
    let (width, height) = (f64::from(depth.width), f64::from(depth.height));
    if !(at.x >= 0.0 && at.y >= 0.0 && at.x < width && at.y < height) {
        return false;
    }
    // The four pixels inside the image whose centres surround it.
    let near = |at: f64, size: u32| {
        let low = (at - 0.5).floor().max(0.0) as u32;
        [low, (low + 1).min(size - 1)]
    };
    let (xs, ys) = (near(at.x, depth.width), near(at.y, depth.height));
    let farthest = xs.iter().flat_map(|&x| ys.map(|y| depth.at(x, y)[0])).fold(0.0, f32::max);
    local.z <= f64::from(farthest) * (1.0 + 1e-3)
}

fn check(options: &SynthOptions) -> Result<()> {
    let SynthOptions { frames, width, height, .. } = *options;
    if !(2..=10_000).contains(&frames) {
        return Err(Error::Input(format!("a clip has 2 to 10000 frames, not {frames}")));
    }
    if width.min(height) < 16 {
        return Err(Error::Input(format!(
            "a clip is at least 16 pixels wide and high, not {width}×{height}"
        )));
    }
    // An image of three channels, depth, mask, two flow fields of two channels with visibility; and for
    // every second frame three images with depth, mask and covisibility.
    let bytes = u128::from(width) * u128::from(height) * frames as u128 * (3 + 2 + 6 + 9) * 4;
    if bytes > u128::from(MOST_BYTES) {
        return Err(Error::Input(format!(
            "{frames} frames of {width}×{height} take {} GiB of memory, more than {}; \
             ask for fewer or smaller frames",
            bytes >> 30,
            MOST_BYTES >> 30
        )));
    }
    check_memory(bytes as u64, &format!("a clip of {frames} frames of {width}×{height}"))
}
