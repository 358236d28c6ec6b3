//! Frames that say in their colours what a network would have to know, so that a network that only reads the
//! colours gives exact answers: with it the whole way of a network's answers through the program can be held
//! against the truth.
//!
//! Of the clip's own colours only the brightness stays, as the mean of the channels, so that pictures can still be
//! matched. All else stands in how the channels differ, which is linear: scaling a frame does no harm but
//! at edges.
//!
//! | | value |
//! |---|---|
//! | mean | 0.3 + 0.4 × the brightness of the clip's own picture |
//! | red − green | 0.35 / z, in the camera, per metre |
//! | blue − green | a number of the frame, from 0 to 0.2, and 0.25 more where something moves |
//!
//! The frame's numbers stand in sixteen upright bands of one width. With k the band and v its number
//! from −1 to 1, blue − green is 0.2 (k + 0.1 + 0.4 (v + 1)) / 16: a band says which it is, wherever a frame was
//! cut. The numbers, in order: the quaternion (x, y, z, w) and the place of the camera in the world, in 4 m; the
//! focal length, in 4096 pixels of the frame; the quaternion and the place of what moves, by which its points at rest
//! are carried, in 4 m; 0.
//!
//! Rounding to 16 bits is diffused from pixel to pixel within a band, so that its mean is far more exact than one pixel.

use glam::{DMat3, DQuat, DVec3};

use super::Clip;
use super::scene::{Motion, Part};
use crate::error::{Error, Result};
use crate::types::{Image, Pose};

/// Bands in a frame.
const BANDS: usize = 16;
/// Least number of pixels in a band.
const LEAST: u32 = 4;
/// Least mean of the channels, and how much of the brightness it has.
const MEAN: [f64; 2] = [0.3, 0.4];
/// Red − green at a depth of 1 m.
const INVERSE_DEPTH: f64 = 0.35;
/// Smallest depth that can be coded, m.
const NEAREST: f64 = 0.8;
/// Largest blue − green of what stands still.
const NUMBERS: f64 = 0.2;
/// By how much blue − green is larger where something moves.
const MOVES: f64 = 0.25;
/// What a coded length of 1 stands for, m.
const LENGTH: f64 = 4.0;
/// What a coded focal length of 1 stands for, pixels.
const FOCAL: f64 = 4096.0;
/// Farthest that a point of what moves may be from where one rigid motion carries it, m.
const RIGID: f64 = 1e-6;
/// Largest value of a 16-bit channel.
const WHITE: f64 = 65535.0;

/// Where all that moves is carried at each time, rest to world; at rest where nothing moves.
///
/// # Errors
/// [`Error::Input`] where it does not move as one rigid thing.
pub(super) fn rigid_motion(name: &str, parts: &[Part], times: &[f64]) -> Result<Vec<Pose>> {
    let moving: Vec<_> =
        parts.iter().filter_map(|part| Some((part.motion.as_ref()?, &part.mesh))).collect();
    let Some((first, _)) = moving.first() else {
        return Ok(vec![Pose::IDENTITY; times.len()]);
    };
    let at = |time: &f64| {
        // A rigid motion is told by where it carries the origin and the axes.
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

/// Puts the codes into a clip's frames; `world_from_rest` is of what moves, at each of them. Pictures from aside
/// stay as they are.
///
/// # Errors
/// [`Error::Input`] for frames that are too narrow, and for numbers that the code cannot hold.
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

/// One frame.
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
        // Who reads the numbers leaves out what lies at a band's edge.
        if band_of(x.saturating_sub(1)) == band && band_of((x + 1).min(width - 1)) == band {
            error[band] = blue - blue.round();
        }
        for (to, value) in to.iter_mut().zip([red, green, blue]) {
            *to = (value.round() / WHITE) as f32;
        }
    }
    out
}
