//! Synthetic clips with exact ground truth, ray-traced on the CPU.
//!
//! A clip shows a furnished room, textured all over, from a camera that moves through it; most
//! have something that moves. Everything is a mesh whose vertices are closed functions of time,
//! so that the point behind a pixel has an exact place at every other time: depth, flow, masks
//! and visibility are read from the same triangles as the pixels. Surfaces are diffuse, their
//! light is baked at rest, and what moves casts no shadow, so a surface point has one colour in
//! all frames and from all cameras.
//!
//! The room is about 6 m wide and 4 to 6 m deep before the camera; world axes are the camera's of
//! a level camera that looks into the room (x right, y down, z forward).

mod mesh;
mod movers;
mod render;
mod scene;
mod texture;
mod trace;
mod write;

use glam::DVec3;

use crate::error::{Error, Result};
use crate::io::check_memory;
use crate::types::{Camera, Image, Intrinsics, Pose};
use render::{Geometry, Moment};
use scene::Scene;

pub use write::{check_folder, write};

/// The clips, by name:
/// - `rigid`: a cart is driven through the room, the camera moves;
/// - `bend`: a cloth ripples and a column bends, the camera moves;
/// - `crowd`: walkers cover more than half of the picture, the camera moves;
/// - `still`: nothing moves but the camera;
/// - `tripod`: the cart again, the camera fixed.
pub const NAMES: [&str; 5] = ["rigid", "bend", "crowd", "still", "tripod"];

/// Metres from the camera's path to each held-out camera: 3 to 6 % of the depth of the scene.
const HELD_OUT: [DVec3; 2] = [DVec3::new(0.13, -0.11, 0.0), DVec3::new(-0.12, 0.09, 0.1)];

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
    /// Two cameras beside the path, for measuring novel views.
    pub held_out: [HeldOut; 2],
}

/// A camera that keeps beside the clip's own, and what it sees at every time of the clip.
#[derive(Clone, Debug, PartialEq)]
pub struct HeldOut {
    /// `n` cameras.
    pub cameras: Vec<Camera>,
    /// `n` pictures of three channels.
    pub frames: Vec<Image>,
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
    let SynthOptions { frames, width, height, seed } = *options;
    let scene = Scene::new(name, seed).ok_or_else(|| {
        Error::Input(format!("there is no clip named {name:?}; choose one of {}", NAMES.join(", ")))
    })?;
    let path = scene.path;
    let intrinsics = Intrinsics::centred(scene.focal * f64::from(width), width, height);
    let geometry = Geometry::new(scene);
    let times: Vec<f64> = (0..frames).map(|i| i as f64 / (frames - 1) as f64).collect();
    let camera =
        |time, offset| Camera { intrinsics, view_from_world: path.view_from_world(time, offset) };
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
        held_out: HELD_OUT.map(|offset| HeldOut {
            cameras: times.iter().map(|t| camera(*t, offset)).collect(),
            frames: Vec::new(),
        }),
    };
    let cameras: Vec<Camera> = times.iter().map(|t| camera(*t, DVec3::ZERO)).collect();
    // The frame in hand with its neighbours; a long clip's geometry is not kept whole.
    let mut window: [Option<Moment>; 3] = [None, None, Some(geometry.at(times[0]))];
    for here in 0..frames {
        window.rotate_left(1);
        window[2] = times.get(here + 1).map(|time| geometry.at(*time));
        let [before, Some(now), after] = &window else { break };
        clip.frames.push(geometry.picture(now, &cameras[here]));
        for held_out in &mut clip.held_out {
            held_out.frames.push(geometry.picture(now, &held_out.cameras[here]));
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
    Ok(clip)
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
    // Three pictures of three channels, depth, mask, two flows of two channels with visibility.
    let bytes = u128::from(width) * u128::from(height) * frames as u128 * (9 + 2 + 6) * 4;
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
