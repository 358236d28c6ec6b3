//! MCMC density control: dead Gaussians move to live ones, and the scene grows by a factor.

use super::{Population, rows};
use crate::Result;
use crate::gpu::{Device, Recorder, Stream};
use crate::ops::density::{self, JitterArgs, Relocation, RelocationArgs};
use crate::ops::gaussians::GaussianBuffers;
use crate::train::settings::{McmcSettings, TrainSettings};
use crate::types::MotionClass;

pub(in crate::train) struct Mcmc {
    relocation: Relocation,
    settings: McmcSettings,
    capacity: usize,
    last: u32,
    seed: u32,
}

impl Mcmc {
    pub(super) fn new(
        device: &Device,
        settings: McmcSettings,
        capacity: usize,
        train: &TrainSettings,
    ) -> Result<Mcmc> {
        let relocation = Relocation::new(device, capacity)?;
        let last = settings.last_of(train.steps);
        Ok(Mcmc { relocation, settings, capacity, last, seed: train.seed as u32 })
    }

    pub(super) fn due(&self, step: u32) -> bool {
        step <= self.last && self.settings.due(step)
    }

    pub(super) fn regularise(
        &self,
        recorder: &mut Recorder,
        gaussians: &GaussianBuffers,
        gradients: &mut GaussianBuffers,
    ) -> Result<()> {
        let (canonical, n) = (gaussians.views(), gaussians.len);
        density::regularise(
            recorder,
            canonical.opacity_logits,
            canonical.log_scales,
            gradients.opacity_logits.range_mut(0..n),
            gradients.log_scales.range_mut(0..3 * n),
            self.settings.opacity_weight,
            self.settings.scale_weight,
        )
    }

    pub(super) fn explore(
        &self,
        recorder: &mut Recorder,
        gaussians: &mut GaussianBuffers,
        rate: f64,
        step: u32,
    ) -> Result<()> {
        let n = gaussians.len;
        density::jitter(
            recorder,
            JitterArgs {
                positions: gaussians.positions.range_mut(0..3 * n),
                log_scales: gaussians.log_scales.range(0..3 * n),
                rotations: gaussians.rotations.range(0..n),
                opacity_logits: gaussians.opacity_logits.range(0..n),
                size: (rate * self.settings.noise) as f32,
                seed: self.seed,
                step,
            },
        )
    }

    /// Moves the dead of each class (static, dynamic) to live ones of their class, then grows the scene
    /// by a factor, up to the capacity.
    pub(super) fn round(
        &mut self,
        stream: &mut Stream,
        step: u32,
        mut population: Population<'_>,
    ) -> Result<()> {
        let classes: &[MotionClass] = match population.selection {
            Some(_) => &[MotionClass::Static, MotionClass::Dynamic],
            None => &[MotionClass::Any],
        };
        let n = population.gaussians.len;
        let mut recorder = stream.record()?;
        for &class in classes {
            let args = arguments(&mut population, class, self.seed, step);
            self.relocation.relocate(&mut recorder, args)?;
            self.apply(&mut recorder, &mut population)?;
        }
        let added = self.settings.wanted(n).min(self.capacity - n);
        if added > 0 {
            // The draw is over all classes: a new Gaussian has the class of the one that it copies.
            let seed = self.seed ^ 0x9e37_79b9;
            let args = arguments(&mut population, MotionClass::Any, seed, step);
            self.relocation.grow(&mut recorder, args, added)?;
            population.gaussians.len = n + added;
            self.apply(&mut recorder, &mut population)?;
        }
        stream.submit(recorder)?;
        Ok(())
    }

    /// Copies every parameter to the slots of the last draw, and zeroes the moments of Gaussians that
    /// were drawn or replaced.
    fn apply(&self, recorder: &mut Recorder, population: &mut Population<'_>) -> Result<()> {
        let r = &self.relocation;
        for (row, values) in rows(population.gaussians) {
            r.copy(recorder, values, row)?;
        }
        if let Some(selection) = &mut population.selection {
            for (row, values) in selection.rows() {
                r.copy(recorder, values, row)?;
            }
            for (row, values) in selection.moments() {
                r.zero(recorder, values, row)?;
            }
        }
        let optimiser = &mut *population.optimiser;
        for moments in [&mut optimiser.first, &mut optimiser.second] {
            for (row, values) in rows(moments) {
                r.zero(recorder, values, row)?;
            }
        }
        Ok(())
    }
}

fn arguments<'a>(
    population: &'a mut Population<'_>,
    class: MotionClass,
    seed: u32,
    step: u32,
) -> RelocationArgs<'a> {
    let gaussians = &mut *population.gaussians;
    let n = gaussians.len;
    RelocationArgs {
        opacity_logits: gaussians.opacity_logits.range_mut(0..n),
        log_scales: gaussians.log_scales.range_mut(0..3 * n),
        motion_logits: population.selection.as_deref().map(|selection| selection.logits(n)),
        class,
        seed,
        step,
    }
}
