//! Frames whose colours encode the answers of a network, so that a network that only decodes the colours is
//! exact. With it, the program's whole path of network outputs can be tested against the ground truth.
//!
//! Only the brightness of the clip's own colours is kept, as the mean of the channels, so that images can
//! still be matched. Everything else is encoded in the differences of the channels, which is linear:
//! scaling a frame affects the code only at edges.
//!
//! | | value |
//! |---|---|
//! | mean | 0.3 + 0.4 × the brightness of the clip's own image |
//! | red − green | 0.35 / z, in the camera frame, per metre |
//! | blue − green | a per-frame number from 0 to 0.2, plus 0.25 on movers |
//!
//! The numbers of a frame are in sixteen vertical bands of equal width. With k the band and v its number
//! from −1 to 1, blue − green is 0.2 (k + 0.1 + 0.4 (v + 1)) / 16, so that a band identifies itself
//! wherever the frame is cropped. The numbers are, in order: the quaternion (x, y, z, w) and position of
//! the camera in the world, in units of 4 m; the focal length, in units of 4096 pixels of the frame; the
//! quaternion and translation of the mover's motion, which carries its points at rest, in units of 4 m; 0.
//!
//! The error of rounding to 16 bits is diffused from pixel to pixel within a band, so that the mean of a band is
//! far more accurate than a single pixel.

use glam::{DMat3, DQuat, DVec3};

use super::Clip;
use super::scene::{Motion, Part};
use crate::error::{Error, Result};
use crate::types::{Image, Pose};

/// Number of bands in a frame.
const BANDS: usize = 16;
/// Minimum number of pixels across a band.
const LEAST: u32 = 4;
/// Smallest mean of the channels, and the weight of the brightness in it.
const MEAN: [f64; 2] = [0.3, 0.4];
/// Red − green at a depth of 1 m.
const INVERSE_DEPTH: f64 = 0.35;
/// Smallest depth that can be coded, m.
const NEAREST: f64 = 0.8;
/// Largest blue − green of the static scene.
const NUMBERS: f64 = 0.2;
/// Offset of blue − green on movers.
const MOVES: f64 = 0.25;
/// Length that a coded value of 1 represents, m.
const LENGTH: f64 = 4.0;
/// Focal length that a coded value of 1 represents, pixels.
const FOCAL: f64 = 4096.0;
/// Maximum deviation of a mover's point from a single rigid motion, m.
const RIGID: f64 = 1e-6;
/// Largest value of a 16-bit channel.
const WHITE: f64 = 65535.0;

/// Transform of the movers from rest to world at each time; the identity where nothing moves.
///
/// # Errors
/// [`Error::Input`] where the movers are not one rigid body.
pub(super) fn rigid_motion(name: &str, parts: &[Part], times: &[f64]) -> Result<Vec<Pose>> {
    let moving: Vec<_> =
        parts.iter().filter_map(|part| Some((part.motion.as_ref()?, &part.mesh))).collect();
    let Some((first, _)) = moving.first() else {
        return Ok(vec![Pose::IDENTITY; times.len()]);
    };
    let at = |time: &f64| {
        // A rigid motion is determined by the images of the origin and the axes.
        let origin = first(DVec3::ZERO, *time);
        let axes = DVec3::AXES.map(|axis| first(axis, *time) - origin);
        let rotation = DQuat::from_mat3(&DMat3::from_cols(axes[0], axes[1], axes[2])).normalize();
        let carried = Pose::new(rotation, origin);
        let is_off =
            |motion: &Motion, p: DVec3| carried.apply(p).distance(motion(p, *time)) > RIGID;
        let bends = moving
            .iter()
            .any(|(motion, mesh)| mesh.vertices.iter().any(|v| is_off(motion, v.position)));
        if bends {
            return Err(Error::Input(format!(
                "what moves in {name} does not move as one rigid thing, which colours could code; code \
                 rigid, still or tripod"
            )));
        }
        Ok(carried)
    };
    times.iter().map(at).collect()
}

/// Encodes a clip's frames; `world_from_rest` is the movers' transform at each of them. Offset views are
/// unchanged.
///
/// # Errors
/// [`Error::Input`] for frames that are too narrow, and for numbers outside the range of the code.
pub(super) fn code(clip: &mut Clip, world_from_rest: &[Pose]) -> Result<()> {
    let width = clip.intrinsics.width;
    if width < LEAST * BANDS as u32 {
        return Err(Error::Input(format!(
            "coded frames are at least {} pixels wide, not {width}",
            LEAST * BANDS as u32
        )));
    }
    for (i, moved) in world_from_rest.iter().enumerate() {
        let numbers = numbers(&clip.view_from_world[i].inverse(), clip.intrinsics.fx, moved);
        let nearest = clip.depth[i].pixels.iter().copied().fold(f32::INFINITY, f32::min);
        if let Some(number) = numbers.iter().find(|v| v.abs() > 1.0) {
            return Err(Error::Input(format!(
                "frame {i} of {} cannot be coded: a number of its geometry is {number:.3}, beyond 1",
                clip.name
            )));
        }
        if f64::from(nearest) < NEAREST {
            return Err(Error::Input(format!(
                "frame {i} of {} cannot be coded: something is {nearest:.2} m before the camera, nearer \
                 than {NEAREST} m",
                clip.name
            )));
        }
        clip.frames[i] = coded(&clip.frames[i], &clip.depth[i], &clip.masks[i], &numbers);
    }
    clip.coded = true;
    Ok(())
}

/// The numbers of a frame's bands.
fn numbers(world_from_view: &Pose, focal: f64, world_from_rest: &Pose) -> [f64; BANDS] {
    let pose = |pose: &Pose| {
        let (q, p) = (pose.rotation, pose.translation / LENGTH);
        [q.x, q.y, q.z, q.w, p.x, p.y, p.z]
    };
    let mut numbers = [0.0; BANDS];
    numbers[..7].copy_from_slice(&pose(world_from_view));
    numbers[7] = focal / FOCAL;
    numbers[8..15].copy_from_slice(&pose(world_from_rest));
    numbers
}

/// Encodes one frame.
fn coded(frame: &Image, depth: &Image, mask: &Image, numbers: &[f64; BANDS]) -> Image {
    let width = frame.width as usize;
    let mut out = Image::new(frame.width, frame.height, 3);
    let band_of = |x: usize| x * BANDS / width;
    let mut error = [0.0; BANDS];
    for (i, to) in out.pixels.chunks_exact_mut(3).enumerate() {
        let own = &frame.pixels[3 * i..3 * i + 3];
        let brightness = own.iter().map(|c| f64::from(c.clamp(0.0, 1.0))).sum::<f64>() / 3.0;
        let (x, band) = (i % width, band_of(i % width));
        let number = (band as f64 + 0.1 + 0.4 * (numbers[band] + 1.0)) / BANDS as f64;
        let moves = if mask.pixels[i] > 0.5 { MOVES } else { 0.0 };
        let (nearness, told) =
            (INVERSE_DEPTH / f64::from(depth.pixels[i]), NUMBERS * number + moves);
        let mean = MEAN[0] + MEAN[1] * brightness;
        let green = ((mean - (nearness + told) / 3.0) * WHITE).round();
        let red = green + nearness * WHITE;
        let blue = green + told * WHITE + error[band];
        // The decoder ignores pixels at a band's edge.
        if band_of(x.saturating_sub(1)) == band && band_of((x + 1).min(width - 1)) == band {
            error[band] = blue - blue.round();
        }
        for (to, value) in to.iter_mut().zip([red, green, blue]) {
            *to = (value.round() / WHITE) as f32;
        }
    }
    out
}
