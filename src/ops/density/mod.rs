//! Density control on the device; `oracle::density` has the formulae.
//!
//! There are two strategies: [`Relocation`] with [`jitter`] (MCMC: a fixed number of Gaussians, dead
//! ones move to live ones), and [`Adaptation`] with [`accumulate`] and [`reset_opacity`] (clone, split,
//! prune).

mod adaptation;
mod relocation;

pub use adaptation::{Adaptation, AdaptationArgs};
pub use relocation::{Relocation, RelocationArgs};

use crate::error::{Error, Result};
use crate::gpu::{Groups, Recorder, View, ViewMut};
use crate::kernels::density as kernels;

/// Opacity up to which a Gaussian is dead.
pub const DEAD_OPACITY: f64 = 0.005;

/// Workgroup size of all kernels of the family.
const WORKGROUP: u32 = 64;

/// Inputs and output of [`jitter`].
pub struct JitterArgs<'a> {
    /// Centres, three values each; changed in place.
    pub positions: ViewMut<'a, f32>,
    /// Log-scales, three values each.
    pub log_scales: View<'a, f32>,
    /// Rotations.
    pub rotations: View<'a, [f32; 4]>,
    /// Opacity logits.
    pub opacity_logits: View<'a, f32>,
    /// Factor of the noise.
    pub size: f32,
    /// Seed of the noise.
    pub seed: u32,
    /// Number of the step; each number gives different noise.
    pub step: u32,
}

/// Records MCMC's exploration: noise with the Gaussian's covariance, times `size`, is added to every
/// centre; the fainter the Gaussian, the stronger the noise. A displacement that is not finite is
/// skipped.
///
/// # Errors
/// [`Error::Shape`] where the lengths disagree.
pub fn jitter(recorder: &mut Recorder, args: JitterArgs<'_>) -> Result<()> {
    let JitterArgs { positions, log_scales, rotations, opacity_logits, size, seed, step } = args;
    let count = opacity_logits.len();
    equal("positions", 3 * count, positions.len())?;
    equal("log_scales", 3 * count, log_scales.len())?;
    equal("rotations", count, rotations.len())?;
    recorder.dispatch::<kernels::Jitter>(
        Groups::linear(count, WORKGROUP, recorder.device().limits())?,
        kernels::JitterParams { count: count as u32, seed, step_number: step, size },
        kernels::JitterArgs { log_scales, rotations, opacity_logits, positions },
    )
}

/// Records the addition of one view's gradients to the statistics of [`Adaptation`]. The gradients are
/// those with respect to mean x, mean y (pixels), depth and opacity
/// ([`FrameGradients::means`]); the statistics are the sum of norms in units of half the
/// image, and the number of views. Gaussians whose entry in `visible` is 0 are skipped, and nothing is
/// added where `fits` holds 0.
///
/// # Errors
/// [`Error::Shape`] where the lengths disagree; gradients and visibility may be longer.
///
/// [`FrameGradients::means`]: crate::ops::render::FrameGradients::means
pub fn accumulate(
    recorder: &mut Recorder,
    statistics: ViewMut<'_, f32>,
    mean_gradients: View<'_, [f32; 4]>,
    visible: View<'_, u32>,
    fits: View<'_, u32>,
    image: [u32; 2],
) -> Result<()> {
    let count = statistics.len() / 2;
    equal("statistics", 2 * count, statistics.len())?;
    super::at_least(
        "density control",
        &[
            ("mean_gradients", count, mean_gradients.len()),
            ("visible", count, visible.len()),
            ("fits", 1, fits.len()),
        ],
    )?;
    let [half_width, half_height] = image.map(|side| side as f32 / 2.0);
    recorder.dispatch::<kernels::Accumulate>(
        Groups::linear(count, WORKGROUP, recorder.device().limits())?,
        kernels::AccumulateParams { count: count as u32, half_width, half_height },
        kernels::AccumulateArgs { mean_gradients, visible, fits, statistics },
    )
}

/// Records the opacity reset: logits are clamped to at most `limit`. The caller must zero the moments.
///
/// # Errors
/// As for [`Recorder::dispatch`].
pub fn reset_opacity(
    recorder: &mut Recorder,
    opacity_logits: ViewMut<'_, f32>,
    limit: f32,
) -> Result<()> {
    let count = opacity_logits.len();
    recorder.dispatch::<kernels::Reset>(
        Groups::linear(count, WORKGROUP, recorder.device().limits())?,
        kernels::ResetParams { count: count as u32, limit },
        kernels::ResetArgs { opacity_logits },
    )
}

fn logit(probability: f64) -> f32 {
    (probability / (1.0 - probability)).ln() as f32
}

fn equal(arg: &'static str, expected: usize, actual: usize) -> Result<()> {
    if actual == expected {
        return Ok(());
    }
    Err(Error::Shape { op: "density control", arg, expected: expected.to_string(), actual })
}

/// Records the addition of MCMC's regularisers to the gradients: `opacity_weight` times the mean
/// opacity and `scale_weight` times the mean scale.
///
/// # Errors
/// [`Error::Shape`] where the lengths disagree.
pub fn regularise(
    recorder: &mut Recorder,
    opacity_logits: View<'_, f32>,
    log_scales: View<'_, f32>,
    opacity_gradients: ViewMut<'_, f32>,
    log_scale_gradients: ViewMut<'_, f32>,
    opacity_weight: f64,
    scale_weight: f64,
) -> Result<()> {
    let count = opacity_logits.len();
    equal("log_scales", 3 * count, log_scales.len())?;
    equal("opacity_gradients", count, opacity_gradients.len())?;
    equal("log_scale_gradients", 3 * count, log_scale_gradients.len())?;
    recorder.dispatch::<kernels::Regularise>(
        Groups::linear(count, WORKGROUP, recorder.device().limits())?,
        kernels::RegulariseParams {
            count: count as u32,
            opacity_factor: (opacity_weight / count.max(1) as f64) as f32,
            scale_factor: (scale_weight / (3 * count).max(1) as f64) as f32,
        },
        kernels::RegulariseArgs {
            opacity_logits,
            log_scales,
            opacity_gradients,
            log_scale_gradients,
        },
    )
}
