//! Parameters of Gaussians as 16-bit floats, two to a word. They halve the memory to read for every
//! splat and are rounded to 11 significant bits. They serve rendering only: gradients need f32.

use super::gaussians::{GaussianViews, SH_BAND};
use crate::Result;
use crate::gpu::{Buffer, Device};
use crate::types::{Gaussians, sh_coefficients};

/// Spherical harmonics as 16-bit floats, one buffer per band.
pub struct HalfHarmonics {
    sh: [Buffer<f32>; 4],
    sh_degree: u32,
    len: usize,
}

/// Log scales, opacity logits and rotations as 16-bit floats. Positions stay in f32, since rounding them
/// to 11 bits would move splats by whole pixels.
pub struct HalfShapes {
    log_scales: Buffer<f32>,
    rotations: Buffer<[f32; 4]>,
    opacity_logits: Buffer<f32>,
    len: usize,
}

/// Packs two values to a word, the first in the low half, rounded to nearest.
fn pack(values: &[f32]) -> Vec<f32> {
    let bits = |value: f32| u32::from(half::f16::from_f32(value).to_bits());
    values
        .chunks(2)
        .map(|pair| f32::from_bits(bits(pair[0]) | bits(pair.get(1).copied().unwrap_or(0.0)) << 16))
        .collect()
}

/// Normalises a quaternion, since its norm may exceed the range of 16-bit floats; a zero quaternion
/// stays zero.
fn unit(rotation: [f32; 4]) -> [f32; 4] {
    let wide = rotation.map(f64::from);
    let length = wide.iter().map(|x| x * x).sum::<f64>().sqrt();
    // The kernels treat shorter quaternions as zero.
    if length >= 1e-10 { wide.map(|x| (x / length) as f32) } else { [0.0; 4] }
}

impl HalfHarmonics {
    /// Allocates the harmonics of `len` Gaussians.
    ///
    /// # Errors
    /// [`Error::OutOfMemory`](crate::Error::OutOfMemory).
    pub fn new(device: &Device, len: usize, sh_degree: u32) -> Result<HalfHarmonics> {
        let band = |k: usize| {
            let values = if k as u32 <= sh_degree { SH_BAND[k] * len } else { 0 };
            device.buffer(["sh0", "sh1", "sh2", "sh3"][k], values.div_ceil(2))
        };
        Ok(HalfHarmonics { sh: [band(0)?, band(1)?, band(2)?, band(3)?], sh_degree, len })
    }

    /// Uploads the harmonics of a scene.
    ///
    /// # Errors
    /// [`Error::OutOfMemory`](crate::Error::OutOfMemory), or a failed submission.
    pub fn from_host(device: &Device, gaussians: &Gaussians) -> Result<HalfHarmonics> {
        let mut half = HalfHarmonics::new(device, gaussians.len(), gaussians.sh_degree)?;
        let mut stream = device.stream()?;
        let coefficients = sh_coefficients(gaussians.sh_degree);
        let mut first = 0;
        for band in 0..=gaussians.sh_degree as usize {
            let rows = SH_BAND[band] / 3;
            let mut values: Vec<f32> = Vec::new();
            for row in gaussians.sh.chunks_exact(coefficients) {
                values.extend(row[first..first + rows].as_flattened());
            }
            stream.upload(&mut half.sh[band], &pack(&values))?;
            first += rows;
        }
        Ok(half)
    }

    /// The Gaussians with these harmonics instead of their own.
    pub fn replace<'a>(&'a self, gaussians: GaussianViews<'a>) -> GaussianViews<'a> {
        GaussianViews {
            sh: self.sh.each_ref().map(Buffer::view),
            sh_degree: gaussians.sh_degree.min(self.sh_degree),
            len: gaussians.len.min(self.len),
            half_sh: true,
            ..gaussians
        }
    }
}

impl HalfShapes {
    /// Allocates the shapes of `len` Gaussians.
    ///
    /// # Errors
    /// [`Error::OutOfMemory`](crate::Error::OutOfMemory).
    pub fn new(device: &Device, len: usize) -> Result<HalfShapes> {
        Ok(HalfShapes {
            log_scales: device.buffer("log scales", (3 * len).div_ceil(2))?,
            // Two words per quaternion, and four words per element.
            rotations: device.buffer("rotations", len.div_ceil(2))?,
            opacity_logits: device.buffer("opacity logits", len.div_ceil(2))?,
            len,
        })
    }

    /// Uploads the shapes of a scene.
    ///
    /// # Errors
    /// [`Error::OutOfMemory`](crate::Error::OutOfMemory), or a failed submission.
    pub fn from_host(device: &Device, gaussians: &Gaussians) -> Result<HalfShapes> {
        let mut half = HalfShapes::new(device, gaussians.len())?;
        let units: Vec<[f32; 4]> = gaussians.rotations.iter().map(|&q| unit(q)).collect();
        let mut words = pack(units.as_flattened());
        words.resize(words.len().next_multiple_of(4), 0.0);
        let mut stream = device.stream()?;
        stream.upload(&mut half.log_scales, &pack(gaussians.log_scales.as_flattened()))?;
        stream.upload(&mut half.rotations, bytemuck::cast_slice::<f32, [f32; 4]>(&words))?;
        stream.upload(&mut half.opacity_logits, &pack(&gaussians.opacity_logits))?;
        Ok(half)
    }

    /// The Gaussians with these shapes instead of their own.
    pub fn replace<'a>(&'a self, gaussians: GaussianViews<'a>) -> GaussianViews<'a> {
        GaussianViews {
            log_scales: self.log_scales.view(),
            rotations: self.rotations.view(),
            opacity_logits: self.opacity_logits.view(),
            len: gaussians.len.min(self.len),
            half_scales: true,
            half_rotations: true,
            half_opacities: true,
            ..gaussians
        }
    }
}
