//! Solid textures: band-limited noise in several octaves, with an overlaid pattern.
//!
//! Every texture is a function only of a point in its shape's own frame, so that a surface point has the
//! same unlit colour in every frame and from every camera.

use glam::{IVec3, Vec3};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

/// Weight of each octave, finest first. The spectrum decreases toward fine detail like that of natural
/// images: equal weights would put most of the energy at scales that no reconstruction resolves.
const OCTAVES: [f32; 5] = [0.10, 0.16, 0.20, 0.22, 0.22];

/// The pattern over the noise.
#[derive(Clone, Copy, Debug)]
pub(super) enum Pattern {
    /// No pattern.
    Plain,
    /// Round blobs of differing size, one to a cell of this side.
    Blobs(f32),
    /// Soft stripes across a direction, whose length is stripes per unit.
    Stripes(Vec3),
    /// Planks of this width, side by side along x and running along z, each with a different tint.
    Planks(f32),
}

/// The colour of a surface.
#[derive(Clone, Debug)]
pub(super) struct Material {
    /// Main colour.
    pub base: Vec3,
    /// Colour of the pattern.
    pub accent: Vec3,
    pub pattern: Pattern,
    /// Lattice spacing of the finest octave, in units of the scene: the smallest detail.
    pub finest: f32,
    /// Seed of the noise.
    pub seed: u32,
    /// Strength of noise and pattern: 1 is fully textured, 0 is one plain colour.
    pub contrast: f32,
    /// Share of the light that is reflected specularly.
    pub gloss: f32,
}

impl Material {
    /// A material of random hues.
    pub fn random(rng: &mut ChaCha8Rng, pattern: Pattern, finest: f32) -> Material {
        let hue = rng.random_range(0.0..1.0f32);
        let base = hsv(hue, rng.random_range(0.3..0.7), rng.random_range(0.5..0.85));
        // Different from the base in hue and in brightness, so that the pattern shows in grey as well.
        let value = if base.element_sum() > 1.5 { 0.3 } else { 0.95 };
        let accent = hsv(hue + rng.random_range(0.25..0.75), 0.5, value);
        Material { base, accent, pattern, finest, seed: rng.random(), contrast: 1.0, gloss: 0.0 }
    }

    /// A material close to a given main colour.
    pub fn tinted(rng: &mut ChaCha8Rng, base: [f32; 3], pattern: Pattern, finest: f32) -> Material {
        let base = Vec3::from(base)
            + Vec3::from_array(std::array::from_fn(|_| rng.random_range(-0.06..0.06)));
        Material {
            base,
            accent: base * rng.random_range(0.5..0.65),
            pattern,
            finest,
            seed: rng.random(),
            contrast: 1.0,
            gloss: 0.0,
        }
    }

    /// The same material with weaker noise and pattern.
    pub fn of_contrast(self, contrast: f32) -> Material {
        Material { contrast, ..self }
    }

    /// The same material with a share of specular reflection.
    pub fn glossy(self, gloss: f32) -> Material {
        Material { gloss, ..self }
    }

    /// The unlit colour at a point of the shape's own frame.
    pub fn colour(&self, p: Vec3) -> Vec3 {
        let mut noise = Vec3::ZERO;
        let mut frequency = 1.0 / self.finest;
        for (octave, weight) in OCTAVES.iter().enumerate() {
            noise += lattice_noise(p * frequency, self.seed.wrapping_add(octave as u32)) * *weight;
            frequency *= 0.5;
        }
        let cover = self.cover(p, noise) * self.contrast;
        let noise = noise * self.contrast;
        let tint = Vec3::new(noise.y, -0.5 * (noise.y + noise.z), noise.z) * 0.3;
        self.base.lerp(self.accent, cover) * (1.0 + 1.2 * noise.x) + tint
    }

    /// Coverage of the pattern in [0, 1]; edges are as soft as the finest noise.
    fn cover(&self, p: Vec3, noise: Vec3) -> f32 {
        let soft = self.finest;
        match self.pattern {
            Pattern::Plain => 0.0,
            Pattern::Blobs(side) => {
                let cell = (p / side).floor();
                let random = unit(hash(cell.as_ivec3(), self.seed ^ 0x51ed_270b));
                // The blob stays within its cell, so that one look-up suffices.
                let radius = (0.22 + 0.24 * random.x.abs()) * side;
                let centre = (cell + 0.5) * side + random * (0.5 * side - radius);
                step_down((p - centre).length() - radius, soft)
            }
            Pattern::Stripes(across) => {
                // The noise bends the stripes: otherwise all stripes look alike, and flow may match the
                // wrong one.
                let phase = (p.dot(across) + 0.5 * noise.z) * std::f32::consts::TAU;
                let slope = across.length() * std::f32::consts::TAU;
                step_down(-phase.sin() / slope, soft)
            }
            Pattern::Planks(width) => {
                let across = p.x / width;
                let cell = across.floor();
                let tint = |n: f32| unit(hash(IVec3::new(n as i32, 0, 0), self.seed)).x * 0.5 + 0.5;
                let into = (across - cell) * width;
                let seam = step_down(into.min(width - into) - 0.5 * soft, soft);
                (0.6 * tint(cell)).max(seam)
            }
        }
    }
}

/// 1 well below zero, 0 well above, smooth over a band of ±`soft`.
fn step_down(distance: f32, soft: f32) -> f32 {
    let s = (0.5 - 0.5 * distance / soft).clamp(0.0, 1.0);
    s * s * (3.0 - 2.0 * s)
}

/// Three independent value noises on the integer lattice, each in [-1, 1].
fn lattice_noise(p: Vec3, seed: u32) -> Vec3 {
    let cell = p.floor();
    let f = p - cell;
    let cell = cell.as_ivec3();
    let s = f * f * (Vec3::splat(3.0) - 2.0 * f);
    let at = |x, y, z| unit(hash(cell + IVec3::new(x, y, z), seed));
    let edge = |y, z| at(0, y, z).lerp(at(1, y, z), s.x);
    let face = |z| edge(0, z).lerp(edge(1, z), s.y);
    face(0).lerp(face(1), s.z)
}

/// Mixes a lattice point and a seed into 32 bits (multiply and xor-shift rounds).
fn hash(p: IVec3, seed: u32) -> u32 {
    let mut h = seed.wrapping_mul(0x9e37_79b1);
    for part in p.to_array() {
        h = (h ^ part as u32).wrapping_mul(0x85eb_ca6b);
        h ^= h >> 15;
    }
    h = h.wrapping_mul(0xc2b2_ae35);
    h ^ (h >> 14)
}

/// Three values in [-1, 1] out of 30 bits.
fn unit(bits: u32) -> Vec3 {
    let part = |shift: u32| ((bits >> shift) & 1023) as f32 / 511.5 - 1.0;
    Vec3::new(part(0), part(10), part(20))
}

/// A colour from hue (turns), saturation and value.
fn hsv(hue: f32, saturation: f32, value: f32) -> Vec3 {
    let ramp = |offset: f32| {
        let h = (hue + offset).rem_euclid(1.0) * 6.0;
        ((h - 3.0).abs() - 1.0).clamp(0.0, 1.0)
    };
    let pure = Vec3::new(ramp(0.0), ramp(2.0 / 3.0), ramp(1.0 / 3.0));
    value * (Vec3::ONE - saturation * (Vec3::ONE - pure))
}
