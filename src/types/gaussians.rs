//! The Gaussians of a scene on the host.

use super::range::{self, Check, HALF, LOG_SCALE, REACH};
#[cfg(feature = "files")]
use serde::{Deserialize, Serialize};

/// The value of the constant spherical harmonic, 1/(2√π).
pub const SH_C0: f32 = 0.282_094_8;

/// The number of spherical-harmonic coefficients per colour channel at `degree`.
pub const fn sh_coefficients(degree: u32) -> usize {
    ((degree + 1) * (degree + 1)) as usize
}

/// 3D Gaussians, one row of every array per Gaussian.
#[derive(Clone, Debug, Default, PartialEq)]
#[cfg_attr(feature = "files", derive(Serialize, Deserialize))]
pub struct Gaussians {
    /// Centres in the world (canonical) frame.
    pub positions: Vec<[f32; 3]>,
    /// Natural logarithms of the standard deviations along the Gaussian's own axes.
    pub log_scales: Vec<[f32; 3]>,
    /// `world_from_gaussian` quaternions (w, x, y, z); need not be normalised.
    pub rotations: Vec<[f32; 4]>,
    /// Logits of the opacity.
    pub opacity_logits: Vec<f32>,
    /// Degree of the spherical harmonics, 0 to 3.
    pub sh_degree: u32,
    /// Coefficients, `sh_coefficients(sh_degree)` RGB rows per Gaussian, lowest band first.
    pub sh: Vec<[f32; 3]>,
    /// Motion logits: a Gaussian with a logit above 0 is dynamic and follows the control points.
    /// Empty in a static scene.
    pub motion_logits: Vec<f32>,
}

impl Gaussians {
    /// One black dynamic Gaussian at the origin, for rehearsals that depend only on sizes.
    pub(crate) fn one(sh_degree: u32) -> Gaussians {
        Gaussians {
            positions: vec![[0.0; 3]],
            log_scales: vec![[0.0; 3]],
            rotations: vec![[1.0, 0.0, 0.0, 0.0]],
            opacity_logits: vec![0.0],
            sh_degree,
            sh: vec![[0.0; 3]; sh_coefficients(sh_degree)],
            motion_logits: vec![1.0],
        }
    }

    /// Number of Gaussians.
    pub fn len(&self) -> usize {
        self.positions.len()
    }

    /// Checks that every number of the Gaussian at `index` is in its range; see [`range`]. The
    /// arrays must have consistent lengths.
    ///
    /// # Errors
    /// A description of the violation.
    pub fn check(&self, index: usize) -> Check {
        let per = sh_coefficients(self.sh_degree);
        self.positions[index].iter().try_for_each(|&v| range::within("position", v, REACH))?;
        let scales = self.log_scales[index];
        scales.iter().try_for_each(|&v| range::inside("log scale", v, &LOG_SCALE))?;
        range::direction(self.rotations[index])?;
        range::within("opacity logit", self.opacity_logits[index], HALF)?;
        let sh = self.sh[index * per..(index + 1) * per].as_flattened();
        sh.iter().try_for_each(|&v| range::within("spherical harmonic", v, HALF))?;
        let motion = self.motion_logits.get(index);
        motion.map_or(Ok(()), |&v| range::within("motion logit", v, HALF))
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.positions.is_empty()
    }

    /// Whether any Gaussian follows the control points.
    pub fn is_dynamic(&self) -> bool {
        self.motion_logits.iter().any(|&m| m > 0.0)
    }

    /// Whether the Gaussian at `index` follows the control points.
    pub fn moves(&self, index: usize) -> bool {
        self.motion_logits.get(index).is_some_and(|&m| m > 0.0)
    }

    /// The Gaussians with spherical harmonics truncated to at most `degree`.
    pub fn at_degree(mut self, degree: u32) -> Gaussians {
        if degree < self.sh_degree {
            let (bands, kept) = (sh_coefficients(self.sh_degree), sh_coefficients(degree));
            self.sh = self.sh.chunks_exact(bands).flat_map(|rows| rows[..kept].to_vec()).collect();
            self.sh_degree = degree;
        }
        self
    }

    /// The highest degree at which any Gaussian has a coefficient that is not zero.
    pub fn used_sh_degree(&self) -> u32 {
        let bands = sh_coefficients(self.sh_degree);
        let is_used = |degree: &u32| {
            let band = sh_coefficients(degree - 1)..sh_coefficients(*degree);
            self.sh
                .chunks_exact(bands)
                .any(|rows| rows[band.clone()].as_flattened().iter().any(|&h| h != 0.0))
        };
        (1..=self.sh_degree).rev().find(is_used).unwrap_or(0)
    }
}
