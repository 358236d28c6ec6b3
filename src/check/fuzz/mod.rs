//! Fuzzing: small random scenes of ordinary and of extreme values, rendered and differentiated on
//! the device and in the oracle.
//!
//! For any input, the results must be finite and as close to the oracle as f32 allows: each
//! output's limit grows with the change of the true value when the input changes by one ulp, and
//! with the error of the oracle in f32. A failing scene is minimised ([`shrink`]) and can be
//! written to a file and read again ([`mod@file`]).

mod draw;
pub mod file;
mod judge;
mod regressions;
mod shrink;

use super::{Case, Harness};
use crate::error::Result;
use crate::gpu::Device;
use crate::types::{Camera, Gaussians};
pub use draw::draw;
pub use judge::judge;
pub use shrink::shrink;

/// A random scene to render.
#[derive(Clone, Debug)]
pub struct FuzzScene {
    /// A few Gaussians.
    pub gaussians: Gaussians,
    /// A camera with a small image.
    pub camera: Camera,
    /// Seed of the image's gradient.
    pub seed: u64,
}

/// The family's cases.
pub const CASES: &[Case] =
    &[Case { id: "fuzz/random", run: random }, Case { id: "fuzz/regressions", run: regressions }];

/// A short run of `splat4d validate --fuzz`.
fn random(h: &mut Harness) -> Result<()> {
    let seed = rand::RngExt::random(&mut h.rng);
    for index in 0..150 {
        let scene = draw(seed, index);
        let wrong = judge(&h.device, &mut h.stream, &scene)?;
        let what = wrong.unwrap_or_else(|| "as the oracle".to_owned());
        h.holds(&format!("scene {index} of seed {seed}: {what}"), what == "as the oracle");
    }
    Ok(())
}

/// Scenes that failed in the past.
fn regressions(h: &mut Harness) -> Result<()> {
    for (name, text) in regressions::ALL {
        let scene = file::parse(name, text)?;
        let wrong = judge(&h.device, &mut h.stream, &scene)?;
        let what = wrong.unwrap_or_else(|| "as the oracle".to_owned());
        h.holds(&format!("{name}: {what}"), what == "as the oracle");
    }
    Ok(())
}

/// A failing scene, minimised, with a description of the failure.
#[derive(Debug)]
pub struct Failure {
    /// Index of the scene; with the seed it gives the original scene.
    pub index: u64,
    /// The minimised scene.
    pub scene: FuzzScene,
    /// Description of the failure of the minimised scene.
    pub what: String,
}

/// Checks the scenes `range` of a seed and returns the first that fails, minimised. `watch` is
/// called after each scene; an error from it ends the run.
///
/// # Errors
/// A failed Vulkan call; whatever `watch` returns.
pub fn run(
    device: &Device,
    seed: u64,
    range: std::ops::Range<u64>,
    watch: &mut dyn FnMut() -> Result<()>,
) -> Result<Option<Failure>> {
    let mut stream = device.stream()?;
    for index in range {
        let scene = draw(seed, index);
        if judge(device, &mut stream, &scene)?.is_some() {
            let (scene, what) = shrink(device, &mut stream, scene)?;
            return Ok(Some(Failure { index, scene, what }));
        }
        watch()?;
    }
    Ok(None)
}
