//! Synthetic clips with exact ground truth, ray-traced on the CPU.
//!
//! A clip shows a furnished room, textured all over, from a camera that moves through it; most
//! have something that moves. Everything is a mesh whose vertices are closed functions of time,
//! so that the point behind a pixel has an exact place at every other time: depth, flow, masks
//! and visibility are read from the same triangles as the pixels. In most clips surfaces are
//! diffuse, their light is baked at rest, and what moves casts no shadow, so a surface point has one
//! colour in all frames and from all cameras. In `throw`, `hold` and `walk` movers are lit where they
//! are and cast shadows, and what is held is glossy.
//!
//! The room is about 6 m wide and 4 to 6 m deep before the camera; world axes are the camera's of
//! a level camera that looks into the room (x right, y down, z forward).

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
use render::{Geometry, Moment};
use scene::Scene;
use trace::Hit;

pub use write::write;

/// The clips, by name:
/// - `rigid`: a cart is driven through the room, the camera moves;
/// - `bend`: a cloth ripples and a column bends, the camera moves;
/// - `crowd`: walkers cover more than half of the picture, the camera moves;
/// - `still`: nothing moves but the camera;
/// - `tripod`: the cart again, the camera fixed;
/// - `throw`: a ball and a box fly past each other, spinning, over a floor that is nearly plain;
/// - `hold`: a hand turns a glossy jug before the camera;
/// - `walk`: a person with limbs walks across the room and turns;
/// - `pan`: a car passes in a street, the camera turns in place and follows it;
/// - `follow`: the same, the camera in the hands of one who stands.
pub const NAMES: [&str; 10] =
    ["rigid", "bend", "crowd", "still", "tripod", "throw", "hold", "walk", "pan", "follow"];

/// Where the held-out cameras are: how far aside, as a share of the median depth in the middle of the
/// clip, and in which direction.
const HELD_OUT: [(f64, DVec3); 3] = [
    (0.08, DVec3::new(0.8, -0.6, 0.0)),
    (0.18, DVec3::new(-0.9, -0.4, 0.17)),
    (0.30, DVec3::new(0.94, -0.3, 0.17)),
];
/// Held-out cameras take every so-manieth frame.
const HELD_OUT_EVERY: usize = 2;

/// Points whose tracks are known lie on a grid of so many columns, in the first, the middle and the last
/// frame.
const TRACK_COLUMNS: u32 = 32;

/// A clip holds all of its frames and truth in memory; no more than this.
const MOST_BYTES: u64 = 8 << 30;

/// How long and how large a clip is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SynthOptions {
    /// Number of frames; the same motion takes place in whatever number there is.
    pub frames: usize,
    /// Width, pixels.
    pub width: u32,
    /// Height, pixels.
    pub height: u32,
    /// Moves textures, shapes and paths. The same seed gives the same bits.
    pub seed: u64,
}

impl Default for SynthOptions {
    fn default() -> SynthOptions {
        SynthOptions { frames: 24, width: 320, height: 180, seed: 0 }
    }
}

/// A clip and all that is true of it. Images are `width` × `height`; `n` is the number of frames.
#[derive(Clone, Debug, PartialEq)]
pub struct Clip {
    /// The clip's name.
    pub name: String,
    /// `n` pictures of three channels, encoded values in [0, 1].
    pub frames: Vec<Image>,
    /// `n` times, from 0 to 1 in even steps.
    pub times: Vec<f64>,
    /// Of all cameras.
    pub intrinsics: Intrinsics,
    /// `n` poses, metres.
    pub view_from_world: Vec<Pose>,
    /// `n` images of one channel: z in the camera at the pixel's centre, metres.
    pub depth: Vec<Image>,
    /// `n` − 1 images of two channels; `[i]` is from frame i to i + 1: by how many pixels the
    /// surface point at the pixel's centre moves, whether or not it is hidden there.
    pub flow_forward: Vec<Image>,
    /// `n` − 1 images of two channels; `[i]` is from frame i + 1 to i.
    pub flow_backward: Vec<Image>,
    /// `n` − 1 images of one channel: 1 where `flow_forward` ends inside the picture on a point
    /// that is seen there, else 0.
    pub visible_forward: Vec<Image>,
    /// `n` − 1 images of one channel, the same of `flow_backward`.
    pub visible_backward: Vec<Image>,
    /// `n` images of one channel: 1 where the pixel's centre shows something that moves, else 0.
    pub masks: Vec<Image>,
    /// Points through the clip: those that pixels of a grid show in the first, the middle and the last
    /// frame.
    pub tracks: Tracks,
    /// Cameras beside the path, for measuring novel views: 8, 18 and 30 % of the median depth aside.
    pub held_out: [HeldOut; 3],
    /// Whether the frames say in their colours what is true of them, see [`coded_clip`]; then their values are
    /// those of 16 bits.
    pub coded: bool,
}

/// A camera that keeps beside the clip's own, and what it sees at every second time of the clip.
#[derive(Clone, Debug, PartialEq)]
pub struct HeldOut {
    /// Its distance from the clip's camera over the median depth of the clip's middle frame.
    pub aside: f64,
    /// The frames of the clip at whose times it takes its pictures; as many as there are of the
    /// following.
    pub times: Vec<usize>,
    /// Where it is.
    pub cameras: Vec<Camera>,
    /// Pictures of three channels.
    pub frames: Vec<Image>,
    /// Images of one channel: 1 where the pixel's centre shows something that moves, else 0.
    pub masks: Vec<Image>,
    /// Images of one channel: 1 where some frame of the clip shows the static point at the pixel's
    /// centre, and where something moves; else 0.
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
}

/// Renders a clip of [`NAMES`].
///
/// # Errors
/// [`Error::Input`] for an unknown name, fewer than 2 frames, an image under 16 pixels a side, or
/// a clip that would not fit into 8 GiB.
pub fn clip(name: &str, options: &SynthOptions) -> Result<Clip> {
    check(options)?;
    rendered(name, options, scene(name, options)?)
}

/// [`clip`] with frames that say in their colours what is true of them (depth, what moves, the camera, the motion of
/// what moves), so that a network that only reads the colours gives exact answers: see `coded.rs` for the
/// code. Brightness keeps the clip's texture. Pictures from aside stay as they are.
///
/// # Errors
/// Those of [`clip`]; a clip that moves other than as one rigid thing, frames under 64 pixels in width.
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

/// From 0 to 1 in even steps.
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
    let pixels = grid(width, height);
    let mut followed: Vec<(usize, DVec2, Hit)> = Vec::new();
    for frame in BTreeSet::from([0, frames / 2, frames - 1]) {
        let moment = geometry.at(times[frame]);
        let hits = geometry.hits((&moment, &camera(times[frame], DVec3::ZERO)), &pixels);
        let met = pixels.iter().zip(hits).filter_map(|(pixel, hit)| Some((frame, *pixel, hit?)));
        followed.extend(met);
    }
    let point = |(frame, pixel, _): &(usize, DVec2, Hit)| PointPath {
        query: (*frame, *pixel),
        ..PointPath::default()
    };
    clip.tracks.points = followed.iter().map(point).collect();
    let mut held_out_depth: [Vec<Image>; HELD_OUT.len()] = Default::default();
    let cameras: Vec<Camera> = times.iter().map(|t| camera(*t, DVec3::ZERO)).collect();
    // The frame in hand with its neighbours; a long clip's geometry is not kept whole.
    let mut window: [Option<Moment>; 3] = [None, None, Some(geometry.at(times[0]))];
    for here in 0..frames {
        window.rotate_left(1);
        window[2] = times.get(here + 1).map(|time| geometry.at(*time));
        let [before, Some(now), after] = &window else { break };
        clip.frames.push(geometry.picture(now, &cameras[here]));
        let places = geometry.places(followed.iter().map(|(.., hit)| hit), (now, &cameras[here]));
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
        clip.depth.push(truth.depth);
        clip.masks.push(truth.mask);
        let mut flows = truth.flows.into_iter();
        if let Some(backward) = before.as_ref().and_then(|_| flows.next()) {
            clip.flow_backward.push(backward.flow);
            clip.visible_backward.push(backward.visible);
        }
        if let Some(forward) = flows.next() {
            clip.flow_forward.push(forward.flow);
            clip.visible_forward.push(forward.visible);
        }
    }
    for (held_out, depth) in clip.held_out.iter_mut().zip(&held_out_depth) {
        let views = held_out.cameras.iter().zip(depth).zip(&held_out.masks);
        let seen = views
            .map(|((camera, depth), mask)| covisible(camera, depth, mask, &cameras, &clip.depth));
        held_out.covisible = seen.collect();
    }
    Ok(clip)
}

/// Middles of pixels on a grid.
fn grid(width: u32, height: u32) -> Vec<DVec2> {
    let spacing = (width / TRACK_COLUMNS).max(1);
    let along = |size: u32| (spacing / 2..size).step_by(spacing as usize);
    let centre = |x, y| DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
    along(height).flat_map(|y| along(width).map(move |x| centre(x, y))).collect()
}

/// 1 where a frame of the clip shows the point at a pixel's centre, and where something moves.
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

/// Whether a frame shows a point: it is not behind all of the pixels about it.
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
    // The four pixels whose centres are about it, inside the picture.
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
    // A picture of three channels, depth, mask, two flows of two channels with visibility; and for
    // every second frame three pictures with depth, mask and what is covisible.
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
