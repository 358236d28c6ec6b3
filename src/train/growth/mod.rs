//! Density control during training: one of two strategies.
//!
//! MCMC moves dead Gaussians to live ones and grows the scene by a factor. Adaptive control clones,
//! splits and prunes by the gradients with respect to the image position.

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

/// A strategy of density control.
pub(super) enum Growth {
    Mcmc(Box<Mcmc>),
    Adaptive(Box<Adaptive>),
}

/// Everything that a round changes: all arrays with a row for each Gaussian.
pub(super) struct Population<'a> {
    pub(super) gaussians: &'a mut GaussianBuffers,
    /// `Some` where the scene moves.
    pub(super) selection: Option<&'a mut Selection>,
    pub(super) optimiser: &'a mut GaussianOptimiser,
}

impl Growth {
    /// Density control for up to `capacity` Gaussians in a scene of a given scene radius; `selection`
    /// holds the motion logits where the scene moves. `None` where the settings ask for no density
    /// control.
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

    /// Whether a round is due after `step` steps.
    pub(super) fn due(&self, step: u32) -> bool {
        match self {
            Growth::Mcmc(mcmc) => mcmc.due(step),
            Growth::Adaptive(adaptive) => adaptive.due(step),
        }
    }

    /// Records the gradients of the regularisers, if the strategy has any.
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

    /// Records the exploration noise after a step's update, if the strategy has it; `rate` is the
    /// positions' learning rate.
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

    /// Runs a round after `step` steps.
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

/// Every array, with its number of floats per row.
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
