//! Density control during training: MCMC relocation and growth.

use super::optimiser::GaussianOptimiser;
use super::settings::GrowthSettings;
use crate::Result;
use crate::gpu::{Buffer, Device, Recorder, Stream};
use crate::ops::density::{Relocation, RelocationArgs};
use crate::ops::gaussians::{GaussianBuffers, SH_BAND};
use crate::types::MotionClass;

/// Relocates the dead and adds new Gaussians, every so many steps.
pub(super) struct Growth {
    relocation: Relocation,
    settings: GrowthSettings,
    capacity: usize,
    seed: u32,
}

impl Growth {
    pub(super) fn new(
        device: &Device,
        settings: GrowthSettings,
        capacity: usize,
        seed: u64,
    ) -> Result<Growth> {
        let relocation = Relocation::new(device, capacity)?;
        Ok(Growth { relocation, settings, capacity, seed: seed as u32 })
    }

    pub(super) fn settings(&self) -> &GrowthSettings {
        &self.settings
    }

    /// Whether a round is due after `step` of `steps`.
    pub(super) fn due(&self, step: u32, steps: u32) -> bool {
        let last = (f64::from(steps) * self.settings.until) as u32;
        step >= self.settings.from && step <= last && step.is_multiple_of(self.settings.every)
    }

    /// Runs a round: the dead of each class move to the living of their class, then the scene grows
    /// by a share, up to the capacity. `motion_logits` has room for as many Gaussians as there may
    /// be.
    pub(super) fn round(
        &mut self,
        stream: &mut Stream,
        step: u32,
        gaussians: &mut GaussianBuffers,
        mut motion_logits: Option<&mut Buffer<f32>>,
        optimiser: &mut GaussianOptimiser,
    ) -> Result<()> {
        let classes: &[MotionClass] = match motion_logits {
            Some(_) => &[MotionClass::Static, MotionClass::Dynamic],
            None => &[MotionClass::Any],
        };
        let n = gaussians.len;
        let mut recorder = stream.record()?;
        for &class in classes {
            let args = arguments(gaussians, &motion_logits, class, self.seed, step);
            self.relocation.relocate(&mut recorder, args)?;
            self.apply(&mut recorder, gaussians, &mut motion_logits, optimiser)?;
        }
        let wanted = (n as f64 * (self.settings.factor - 1.0)).ceil() as usize;
        let added = wanted.min(self.capacity - n);
        if added > 0 {
            // Drawn by opacity over all: a new Gaussian has the class of the one it copies.
            let class = MotionClass::Any;
            let args = arguments(gaussians, &motion_logits, class, self.seed ^ 0x9e37_79b9, step);
            self.relocation.grow(&mut recorder, args, added)?;
            gaussians.len = n + added;
            self.apply(&mut recorder, gaussians, &mut motion_logits, optimiser)?;
        }
        stream.submit(recorder)?;
        Ok(())
    }

    /// Copies every parameter to the slots of the last draw, and zeroes the moments of what was
    /// drawn or replaced.
    fn apply(
        &self,
        recorder: &mut Recorder,
        gaussians: &mut GaussianBuffers,
        motion_logits: &mut Option<&mut Buffer<f32>>,
        optimiser: &mut GaussianOptimiser,
    ) -> Result<()> {
        let r = &self.relocation;
        for (row, values) in rows(gaussians) {
            r.copy(recorder, values.view_mut(), row)?;
        }
        r.copy(recorder, gaussians.rotations.view_mut().floats(), 4)?;
        if let Some(logits) = motion_logits {
            r.copy(recorder, logits.view_mut(), 1)?;
        }
        for moments in [&mut optimiser.first, &mut optimiser.second] {
            for (row, values) in rows(moments) {
                r.zero(recorder, values.view_mut(), row)?;
            }
            r.zero(recorder, moments.rotations.view_mut().floats(), 4)?;
        }
        Ok(())
    }
}

/// Every array of floats with the floats of a row, all but the rotations.
fn rows(buffers: &mut GaussianBuffers) -> Vec<(usize, &mut Buffer<f32>)> {
    let degree = buffers.sh_degree as usize;
    let mut all = vec![
        (3, &mut buffers.positions),
        (3, &mut buffers.log_scales),
        (1, &mut buffers.opacity_logits),
    ];
    all.extend(SH_BAND.into_iter().zip(&mut buffers.sh).take(degree + 1));
    all
}

fn arguments<'a>(
    gaussians: &'a mut GaussianBuffers,
    motion_logits: &'a Option<&mut Buffer<f32>>,
    class: MotionClass,
    seed: u32,
    step: u32,
) -> RelocationArgs<'a> {
    let n = gaussians.len;
    RelocationArgs {
        opacity_logits: gaussians.opacity_logits.range_mut(0..n),
        log_scales: gaussians.log_scales.range_mut(0..3 * n),
        motion_logits: motion_logits.as_ref().map(|logits| logits.range(0..n)),
        class,
        seed,
        step,
    }
}
