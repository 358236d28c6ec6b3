//! Small scenes at random, made of ordinary and of poisoned values, rendered and differentiated on the
//! device and in the oracle.
//!
//! Whatever goes in, what comes out must be finite, and close to the oracle as far as f32 can be:
//! each output's limit grows with how much the truth itself moves when the input does by a last place,
//! and with the error of the oracle in f32. A scene that fails is shrunk ([`shrink`]) and can be
//! written and read again ([`mod@file`]).

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

/// What is rendered.
#[derive(Clone, Debug)]
pub struct FuzzScene {
    /// A few Gaussians.
    pub gaussians: Gaussians,
    /// A camera with a small image.
    pub camera: Camera,
    /// Decides the image's gradient.
    pub seed: u64,
}

const KERNELS: &[&str] = &[
    "project/forward",
    "bin/compact",
    "bin/counts",
    "bin/emit",
    "bin/ranges",
    "raster/forward",
    "raster/backward",
    "raster/backward_narrow",
    "raster/gather",
    "project/backward",
    "project/pose",
];

/// The family's cases.
pub const CASES: &[Case] = &[
    Case { id: "fuzz/random", kernels: KERNELS, run: random },
    Case { id: "fuzz/regressions", kernels: KERNELS, run: regressions },
];

/// A taste of what `splat4d validate --fuzz` does at length.
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

/// Scenes that failed once.
fn regressions(h: &mut Harness) -> Result<()> {
    for (name, text) in regressions::ALL {
        let scene = file::parse(name, text)?;
        let wrong = judge(&h.device, &mut h.stream, &scene)?;
        let what = wrong.unwrap_or_else(|| "as the oracle".to_owned());
        h.holds(&format!("{name}: {what}"), what == "as the oracle");
    }
    Ok(())
}

/// A scene that failed, made small, and what was wrong with it.
#[derive(Debug)]
pub struct Failure {
    /// Its number; with the seed, it gives the scene before shrinking.
    pub index: u64,
    /// The small scene.
    pub scene: FuzzScene,
    /// What was wrong with the small one.
    pub what: String,
}

/// Judges the scenes `range` of a seed and gives the first that fails, shrunk. `watch` is told after
/// each scene; an error from it ends the run.
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
