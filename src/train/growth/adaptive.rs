//! Adaptive density control: clone, split, prune (Kerbl et al. 2023), and the opacity reset.

use super::{Population, Statistics, rows};
use crate::gpu::{Readback, Recorder, Stream};
use crate::ops::density::{self, Adaptation, AdaptationArgs};
use crate::ops::gaussians::GaussianBuffers;
use crate::train::selection::Selection;
use crate::train::settings::{AdaptiveSettings, TrainSettings};
use crate::types::AdaptSettings;
use crate::{Error, Result};

pub(in crate::train) struct Adaptive {
    adaptation: Adaptation,
    settings: AdaptiveSettings,
    scene_radius: f64,
    last: u32,
    seed: u32,
    /// Target of the gather; swapped with the current arrays after it.
    spare: GaussianBuffers,
    spare_selection: Option<Selection>,
    totals: Readback<u32>,
}

impl Adaptive {
    pub(super) fn new(
        stream: &mut Stream,
        settings: AdaptiveSettings,
        capacity: usize,
        scene_radius: f64,
        train: &TrainSettings,
        selection: Option<&Selection>,
    ) -> Result<Adaptive> {
        let device = &stream.device().clone();
        Ok(Adaptive {
            adaptation: Adaptation::new(device, capacity)?,
            settings,
            scene_radius,
            last: (f64::from(train.steps) * settings.until) as u32,
            seed: train.seed as u32,
            spare: GaussianBuffers::new(device, capacity, train.sh_degree)?,
            spare_selection: selection.map(|chosen| chosen.spare(stream)).transpose()?,
            totals: device.readback(3)?,
        })
    }

    fn adapts(&self, step: u32) -> bool {
        let AdaptiveSettings { from, every, .. } = self.settings;
        step >= from && step <= self.last && step.is_multiple_of(every)
    }

    fn resets(&self, step: u32) -> bool {
        let every = self.settings.reset_every;
        every > 0 && step <= self.last && step.is_multiple_of(every)
    }

    pub(super) fn due(&self, step: u32) -> bool {
        self.adapts(step) || self.resets(step)
    }

    pub(super) fn round(
        &mut self,
        stream: &mut Stream,
        step: u32,
        mut population: Population<'_>,
        statistics: &Statistics,
    ) -> Result<()> {
        if self.adapts(step) {
            self.adapt(stream, step, &mut population, statistics)?;
        }
        if self.resets(step) {
            let mut recorder = stream.record()?;
            let n = population.gaussians.len;
            let p = self.settings.reset_opacity;
            let limit = (p / (1.0 - p)).ln() as f32;
            let logits = population.gaussians.opacity_logits.range_mut(0..n);
            density::reset_opacity(&mut recorder, logits, limit)?;
            let optimiser = &mut *population.optimiser;
            for moments in [&mut optimiser.first, &mut optimiser.second] {
                recorder.fill(moments.opacity_logits.view_mut(), 0);
            }
            stream.submit(recorder)?;
        }
        Ok(())
    }

    /// Clones, splits and prunes, and waits for the new number of Gaussians.
    fn adapt(
        &mut self,
        stream: &mut Stream,
        step: u32,
        population: &mut Population<'_>,
        statistics: &Statistics,
    ) -> Result<()> {
        let AdaptiveSettings { gradient, small, large, opacity, reset_every, .. } = self.settings;
        // Large Gaussians fill gaps until the first opacity reset has shown which ones are needed.
        let settled = reset_every > 0 && step > reset_every;
        let settings = AdaptSettings {
            gradient,
            small: small * self.scene_radius,
            opacity,
            large: if settled { large * self.scene_radius } else { f64::INFINITY },
        };
        let mut recorder = stream.record()?;
        let gaussians = &mut *population.gaussians;
        let n = gaussians.len;
        let args = AdaptationArgs {
            statistics: statistics.of(n),
            opacity_logits: gaussians.opacity_logits.range(0..n),
            log_scales: gaussians.log_scales.range(0..3 * n),
        };
        self.adaptation.plan(&mut recorder, &settings, args)?;
        self.gather(&mut recorder, gaussians, false)?;
        self.adaptation.draw_parts(
            &mut recorder,
            gaussians.positions.view_mut(),
            gaussians.log_scales.view_mut(),
            gaussians.rotations.view(),
            self.seed,
            step,
        )?;
        let optimiser = &mut *population.optimiser;
        self.gather(&mut recorder, &mut optimiser.first, true)?;
        self.gather(&mut recorder, &mut optimiser.second, true)?;
        if let (Some(selection), Some(spare)) =
            (&mut population.selection, &mut self.spare_selection)
        {
            for ((row, values), (_, to)) in selection.rows().into_iter().zip(spare.rows()) {
                self.adaptation.gather(&mut recorder, values.as_view(), to, row, false)?;
            }
            for ((row, values), (_, to)) in selection.moments().into_iter().zip(spare.moments()) {
                self.adaptation.gather(&mut recorder, values.as_view(), to, row, true)?;
            }
            std::mem::swap(*selection, spare);
        }
        recorder.read_back(self.adaptation.totals(), &self.totals);
        let ticket = stream.submit(recorder)?;
        stream.wait(ticket)?;
        gaussians.len = self.totals.read()?[2] as usize;
        if gaussians.len == 0 {
            return Err(Error::Input(format!(
                "density control has removed every Gaussian at step {step}: none is more opaque \
                 than {opacity}; begin with other points, or use MCMC"
            )));
        }
        Ok(())
    }

    /// Records the gather of arrays into the new order.
    fn gather(
        &mut self,
        recorder: &mut Recorder,
        buffers: &mut GaussianBuffers,
        moments: bool,
    ) -> Result<()> {
        for ((row, values), (_, gathered)) in rows(buffers).into_iter().zip(rows(&mut self.spare)) {
            self.adaptation.gather(recorder, values.as_view(), gathered, row, moments)?;
        }
        std::mem::swap(buffers, &mut self.spare);
        Ok(())
    }
}
