//! Density control during training: one of two strategies.
//!
//! MCMC moves the dead to the living and lets the scene grow by a share; adaptive control clones,
//! splits and prunes by the gradients in the picture.

mod adaptive;
mod mcmc;
mod statistics;

pub(super) use statistics::Statistics;

use super::optimiser::GaussianOptimiser;
use super::selection::Selection;
use super::settings::{GrowthSettings, TrainSettings};
use crate::Result;
use crate::gpu::{Buffer, Recorder, Stream, ViewMut};
use crate::ops::gaussians::{GaussianBuffers, SH_BAND};
use adaptive::Adaptive;
use mcmc::Mcmc;

/// Density control, every so many steps.
pub(super) enum Growth {
    Mcmc(Box<Mcmc>),
    Adaptive(Box<Adaptive>),
}

/// What a round changes: every array with a row for each Gaussian.
pub(super) struct Population<'a> {
    pub(super) gaussians: &'a mut GaussianBuffers,
    /// Where there is motion.
    pub(super) selection: Option<&'a mut Selection>,
    pub(super) optimiser: &'a mut GaussianOptimiser,
}

impl Growth {
    /// For up to `capacity` Gaussians in a scene that reaches so far, with those who choose what moves
    /// where something does; `None` where the settings ask for no
    /// density control.
    pub(super) fn new(
        stream: &mut Stream,
        settings: &TrainSettings,
        capacity: usize,
        scene_radius: f64,
        selection: Option<&Selection>,
    ) -> Result<Option<Growth>> {
        Ok(match settings.growth {
            None => None,
            Some(GrowthSettings::Mcmc(mcmc)) => {
                let mcmc = Mcmc::new(stream.device(), mcmc, capacity, settings)?;
                Some(Growth::Mcmc(Box::new(mcmc)))
            }
            Some(GrowthSettings::Adaptive(adaptive)) => {
                let adaptive =
                    Adaptive::new(stream, adaptive, capacity, scene_radius, settings, selection)?;
                Some(Growth::Adaptive(Box::new(adaptive)))
            }
        })
    }

    /// Whether rounds read the [`Statistics`].
    pub(super) fn wants_statistics(&self) -> bool {
        matches!(self, Growth::Adaptive(_))
    }

    /// Whether a round is due after so many steps.
    pub(super) fn due(&self, step: u32) -> bool {
        match self {
            Growth::Mcmc(mcmc) => mcmc.due(step),
            Growth::Adaptive(adaptive) => adaptive.due(step),
        }
    }

    /// Records what a step adds to the gradients.
    pub(super) fn regularise(
        &self,
        recorder: &mut Recorder,
        gaussians: &GaussianBuffers,
        gradients: &mut GaussianBuffers,
    ) -> Result<()> {
        match self {
            Growth::Mcmc(mcmc) => mcmc.regularise(recorder, gaussians, gradients),
            Growth::Adaptive(_) => Ok(()),
        }
    }

    /// Records what a step does after its update, whose positions moved at `rate`.
    pub(super) fn explore(
        &self,
        recorder: &mut Recorder,
        gaussians: &mut GaussianBuffers,
        rate: f64,
        step: u32,
    ) -> Result<()> {
        match self {
            Growth::Mcmc(mcmc) => mcmc.explore(recorder, gaussians, rate, step),
            Growth::Adaptive(_) => Ok(()),
        }
    }

    /// Runs a round after so many steps.
    pub(super) fn round(
        &mut self,
        stream: &mut Stream,
        step: u32,
        population: Population<'_>,
        statistics: Option<&Statistics>,
    ) -> Result<()> {
        match (self, statistics) {
            (Growth::Mcmc(mcmc), _) => mcmc.round(stream, step, population),
            (Growth::Adaptive(adaptive), Some(statistics)) => {
                adaptive.round(stream, step, population, statistics)
            }
            (Growth::Adaptive(_), None) => unreachable!("it wants statistics"),
        }
    }
}

/// Every array with the floats of a row.
fn rows(buffers: &mut GaussianBuffers) -> Vec<(usize, ViewMut<'_, f32>)> {
    let degree = buffers.sh_degree as usize;
    let mut all = vec![
        (3, buffers.positions.view_mut()),
        (3, buffers.log_scales.view_mut()),
        (4, buffers.rotations.view_mut().floats()),
        (1, buffers.opacity_logits.view_mut()),
    ];
    let bands = buffers.sh.iter_mut().map(Buffer::view_mut);
    all.extend(SH_BAND.into_iter().zip(bands).take(degree + 1));
    all
}
