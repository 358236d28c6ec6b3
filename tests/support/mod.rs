//! Helpers of the tests of readers and files.

// Each test binary uses its own part.
#![allow(dead_code, unused_imports)]

// A test binary may also include `common`, which has the same module.
#[allow(clippy::duplicate_mod)]
mod data;

pub use data::shared_data as shared;

use std::fs;
use std::path::Path;

use glam::{DQuat, DVec3};
use splat4d::Result;
use splat4d::types::{Camera, Image, Intrinsics, Pose};

pub fn message<T>(result: Result<T>) -> String {
    match result {
        Ok(_) => panic!("an error was expected"),
        Err(error) => error.to_string(),
    }
}

#[track_caller]
pub fn says(message: &str, parts: &[&str]) {
    for part in parts {
        assert!(message.contains(part), "`{part}` is not in: {message}");
    }
}

pub fn picture(width: u32, height: u32, seed: u32) -> Image {
    let mut image = Image::new(width, height, 3);
    for y in 0..height {
        for x in 0..width {
            let v = |f: f32| {
                0.5 + 0.45 * ((x as f32 + seed as f32) * f).sin() * (y as f32 * 0.7 * f).cos()
            };
            image.at_mut(x, y).copy_from_slice(&[v(0.11), v(0.17), v(0.23)]);
        }
    }
    image
}

/// A small pseudo-random generator for mutations.
pub struct Dice(pub u64);

impl Dice {
    pub fn roll(&mut self, n: usize) -> usize {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963);
        (self.0 >> 33) as usize % n
    }
}

/// Writes damaged copies of a file over `target` and calls `read` on each. The copies are prefixes, which
/// must fail if `prefixes_fail`, and copies with a few bytes changed, which must only not panic.
pub fn damage(original: &[u8], target: &Path, prefixes_fail: bool, read: impl Fn(&Path) -> bool) {
    let mut dice = Dice(7);
    let step = (original.len() / 97).max(1);
    for length in (0..original.len()).step_by(step).chain([original.len() - 1]) {
        fs::write(target, &original[..length]).unwrap();
        let fine = read(target);
        assert!(!(fine && prefixes_fail), "{} read at {length} bytes", target.display());
    }
    for _ in 0..150 {
        let mut bytes = original.to_vec();
        for _ in 0..1 + dice.roll(4) {
            // Headers are short and matter most.
            let within = if dice.roll(2) == 0 { bytes.len().min(256) } else { bytes.len() };
            let at = dice.roll(within);
            bytes[at] = [0, 1, 0x7f, 0x80, 0xff, dice.roll(256) as u8][dice.roll(6)];
        }
        fs::write(target, &bytes).unwrap();
        read(target);
    }
}

/// A camera of 40×30 pixels, a different one for each `i`.
pub fn some_camera(i: u32) -> Camera {
    let rotation = DQuat::from_euler(glam::EulerRot::YXZ, 0.3 * f64::from(i), -0.2, 0.1);
    Camera {
        intrinsics: Intrinsics { fx: 55.0, fy: 54.0, cx: 19.5, cy: 16.0, width: 40, height: 30 },
        view_from_world: Pose::new(rotation, DVec3::new(1.0, -2.0, 3.0 + f64::from(i))),
    }
}

/// A compressed PLY of `count` Gaussians, all with the same `words`, and the bytes of their spherical
/// harmonics.
pub fn compressed(count: usize, words: [u32; 4], sh: &[u8]) -> Vec<u8> {
    let bounds = ["x", "y", "z", "scale_x", "scale_y", "scale_z", "r", "g", "b"];
    let mut head = String::from("ply\nformat binary_little_endian 1.0\n");
    head += &format!("element chunk {}\n", count.div_ceil(256));
    for end in ["min", "max"] {
        for name in bounds {
            head += &format!("property float {end}_{name}\n");
        }
    }
    head += &format!("element vertex {count}\n");
    for name in ["position", "rotation", "scale", "color"] {
        head += &format!("property uint packed_{name}\n");
    }
    if !sh.is_empty() {
        head += &format!("element sh {count}\n");
        (0..sh.len()).for_each(|i| head += &format!("property uchar f_rest_{i}\n"));
    }
    head += "end_header\n";
    let mut bytes = head.into_bytes();
    for chunk in 0..count.div_ceil(256) {
        let low = [-1.0f32, 0.0, chunk as f32, -6.0, -5.0, -4.0, 0.0, 0.0, 0.0];
        let high = [1.0f32, 2.0, chunk as f32 + 1.0, -2.0, -1.0, 0.0, 1.0, 2.0, 1.0];
        low.iter().chain(&high).for_each(|v| bytes.extend(v.to_le_bytes()));
    }
    (0..count).for_each(|_| words.iter().for_each(|w| bytes.extend(w.to_le_bytes())));
    (0..count).for_each(|_| bytes.extend(sh));
    bytes
}
