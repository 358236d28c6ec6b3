//! The constants of projection and blending, and settings that trade accuracy for speed.

use super::range::{self, Check};
#[cfg(feature = "files")]
use serde::{Deserialize, Serialize};

use crate::{Error, Result};

/// The constants of projection and blending; a scene's file stores them, so that every renderer
/// blends as the trainer did. The defaults are gsplat's.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RenderSettings {
    /// Splats whose centre has a smaller depth are culled, scene units.
    pub near: f32,
    /// Added to both diagonal entries of the 2D covariance, pixels².
    pub dilation: f32,
    /// A splat with a smaller α in a pixel does not contribute to it.
    pub alpha_cut: f32,
    /// Upper limit of α; a capped α passes no gradient to opacity or shape.
    pub alpha_cap: f32,
    /// Blending stops *before* the splat that would bring the transmittance to this or below.
    pub transmittance_stop: f32,
    /// The Jacobian is evaluated at tangents clamped to this many half fields of view.
    pub tangent_clamp: f32,
}

impl Default for RenderSettings {
    fn default() -> Self {
        RenderSettings {
            near: 0.01,
            dilation: 0.3,
            alpha_cut: 1.0 / 255.0,
            alpha_cap: 0.999,
            transmittance_stop: 1e-4,
            tangent_clamp: 1.3,
        }
    }
}

impl RenderSettings {
    /// Checks that every number is in its range.
    ///
    /// # Errors
    /// A description of the violation.
    pub fn check(&self) -> Check {
        range::inside("near", self.near, &(1e-12..=1e12))?;
        range::inside("dilation", self.dilation, &(0.0..=1e6))?;
        range::inside("alpha_cut", self.alpha_cut, &(0.0..=1.0))?;
        // Gradients are divided by 1 − α.
        range::inside("alpha_cap", self.alpha_cap, &(0.0..=0.99999))?;
        range::inside("transmittance_stop", self.transmittance_stop, &(0.0..=1.0))?;
        range::inside("tangent_clamp", self.tangent_clamp, &(0.0..=1e6))
    }
}

/// Maximum number of depth bits for sorting: all bits of an f32 except the sign.
pub const DEPTH_BITS: u32 = 31;

/// The implementation of blending; the images are equal up to rounding.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "files", derive(Serialize, Deserialize))]
#[cfg_attr(feature = "files", serde(rename_all = "snake_case"))]
pub enum RasterKind {
    /// Each subgroup blends its own block of a tile; splats are shared through subgroup operations.
    #[default]
    Subgroup,
    /// A workgroup per tile, splats staged in shared memory.
    Shared,
}

/// Settings that trade accuracy for speed. The default is exact; the keys of the JSON form are the
/// field names.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "files", derive(Serialize, Deserialize))]
#[cfg_attr(feature = "files", serde(default, deny_unknown_fields))]
pub struct Tuning {
    /// Highest degree of the spherical harmonics that is evaluated.
    pub sh_degree: u32,
    /// Keep the spherical harmonics as 16-bit floats; for rendering only.
    pub half_sh: bool,
    /// Keep log scales, rotations and opacity logits as 16-bit floats; for rendering only. Rotations
    /// that a scene's motion has turned stay in f32.
    pub half_shapes: bool,
    /// Overrides the scene's [`RenderSettings::alpha_cut`].
    pub alpha_cut: Option<f32>,
    /// Overrides the scene's [`RenderSettings::transmittance_stop`].
    pub transmittance_stop: Option<f32>,
    /// Number of depth bits, from the highest, that splats are sorted by. Splats that are equal in
    /// these bits are blended in the order of their index. The sort takes one pass per 8 bits.
    pub depth_bits: u32,
    /// Maximum number of control points that a dynamic Gaussian follows.
    pub neighbours: Option<u32>,
    /// The implementation of blending; which one is faster depends on the device.
    pub raster: RasterKind,
}

impl Default for Tuning {
    fn default() -> Self {
        Tuning {
            sh_degree: 3,
            half_sh: false,
            half_shapes: false,
            alpha_cut: None,
            transmittance_stop: None,
            depth_bits: DEPTH_BITS,
            neighbours: None,
            raster: RasterKind::Subgroup,
        }
    }
}

impl Tuning {
    /// Checks that all values lie in their ranges.
    ///
    /// # Errors
    /// [`Error::Input`] that names the field.
    pub fn check(&self) -> Result<()> {
        let share = |value: Option<f32>| value.is_none_or(|v| v > 0.0 && v < 1.0);
        let wrong = match self {
            t if t.sh_degree > 3 => "sh_degree must be 0 to 3",
            t if !share(t.alpha_cut) => "alpha_cut must lie between 0 and 1",
            t if !share(t.transmittance_stop) => "transmittance_stop must lie between 0 and 1",
            t if !(1..=DEPTH_BITS).contains(&t.depth_bits) => "depth_bits must be 1 to 31",
            t if t.neighbours.is_some_and(|k| !(1..=8).contains(&k)) => "neighbours must be 1 to 8",
            _ => return Ok(()),
        };
        Err(Error::Input(format!("settings: {wrong}")))
    }

    /// The given render settings with the overrides applied.
    pub fn apply(&self, settings: RenderSettings) -> RenderSettings {
        RenderSettings {
            alpha_cut: self.alpha_cut.unwrap_or(settings.alpha_cut),
            transmittance_stop: self.transmittance_stop.unwrap_or(settings.transmittance_stop),
            ..settings
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_out_of_range_is_named() {
        Tuning::default().check().unwrap();
        let bad = [
            r#"{"sh_degree": 4}"#,
            r#"{"alpha_cut": 0}"#,
            r#"{"transmittance_stop": 1.5}"#,
            r#"{"depth_bits": 0}"#,
            r#"{"depth_bits": 32}"#,
            r#"{"neighbours": 9}"#,
        ];
        for text in bad {
            let message = serde_json::from_str::<Tuning>(text).unwrap().check().unwrap_err();
            let field = text.split('"').nth(1).unwrap();
            assert!(message.to_string().contains(field), "{message}");
        }
        assert!(serde_json::from_str::<Tuning>(r#"{"alpha": 0.1}"#).is_err(), "a wrong name");
    }

    #[test]
    fn only_what_is_given_replaces() {
        let tuned = Tuning { alpha_cut: Some(0.02), ..Tuning::default() };
        let own = RenderSettings { transmittance_stop: 0.005, ..RenderSettings::default() };
        let applied = tuned.apply(own);
        assert_eq!((applied.alpha_cut, applied.transmittance_stop), (0.02, 0.005));
        assert_eq!(Tuning::default().apply(own), own);
    }
}
