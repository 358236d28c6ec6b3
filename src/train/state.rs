//! The state of a training on the host: everything that its next step depends on, except the training
//! views and settings.

use rand_chacha::ChaCha8Rng;
#[cfg(feature = "files")]
use serde::{Deserialize, Serialize};

use super::motion::{Following, MotionMoments, MotionStart};
use super::rounds::ControlChanges;
use super::scene_optimiser::SceneOptimiser;
use super::selection::SelectionState;
use super::settings::TrainSettings;
use super::trainer::Trainer;
use super::views::TrainingView;
use crate::gpu::Device;
use crate::types::Gaussians;
use crate::{Error, Result};

/// The state of a training, from [`Trainer::state`] for [`Trainer::resume`], or from
/// [`SceneOptimiser::state`] for [`SceneOptimiser::resume`].
#[derive(Clone, Debug, PartialEq)]
#[cfg_attr(feature = "files", derive(Serialize, Deserialize))]
pub struct TrainerState {
    step: u32,
    gaussians: Gaussians,
    /// First and second moments, laid out as the Gaussians.
    moments: [Gaussians; 2],
    trainable: Vec<bool>,
    motion: Option<(MotionStart, MotionMoments, Following)>,
    /// State of the motion logits' training; the logits themselves are in `gaussians`.
    selection: Option<SelectionState>,
    /// Density statistics, `Some` where the trainer keeps them.
    statistics: Option<Vec<f32>>,
    control_changes: ControlChanges,
    broken_gradients: u64,
    scene_radius: f64,
    rng: ChaCha8Rng,
    round: Vec<usize>,
    /// Capacity for intersections by image size; it decides which steps are repeated.
    capacities: Vec<((u32, u32), usize)>,
    /// Steps whose counts have not been examined: view and counts.
    pending: Vec<(usize, [u32; 2])>,
}

impl TrainerState {
    /// Number of steps done.
    pub fn step(&self) -> u32 {
        self.step
    }

    fn start(&self) -> Option<&MotionStart> {
        self.motion.as_ref().map(|(start, ..)| start)
    }
}

impl Trainer {
    /// Waits and reads everything that the next step depends on. Reading the state does not change the
    /// course of the training.
    ///
    /// # Errors
    /// As for [`step`](Self::step).
    pub fn state(&mut self) -> Result<TrainerState> {
        let pending = self.settle()?;
        Ok(TrainerState { round: self.round.clone(), pending, ..self.scene.state()? })
    }

    /// Resumes training from a state. With the same views and settings as the trainer that the state
    /// came from, every later step gives the same bits.
    ///
    /// # Errors
    /// As for [`Trainer::new`]; [`Error::Input`] for a state that refers to views that are not given.
    pub fn resume(
        device: &Device,
        views: &[TrainingView],
        state: TrainerState,
        settings: TrainSettings,
    ) -> Result<Trainer> {
        let mut pictures = state.round.iter().chain(state.pending.iter().map(|(view, _)| view));
        if pictures.any(|&view| view >= views.len()) {
            return Err(Error::Input("the state to resume from is of other images".into()));
        }
        let (gaussians, radius) = (&state.gaussians, state.scene_radius);
        let mut trainer =
            Trainer::with_scene_radius(device, views, gaussians, state.start(), settings, radius)?;
        trainer.round.clone_from(&state.round);
        trainer.set_settled(state.pending.clone());
        trainer.scene.restore(state)?;
        Ok(trainer)
    }
}

impl SceneOptimiser {
    /// Waits and reads everything that the next step depends on. Reading the state does not change the
    /// course of the training.
    ///
    /// # Errors
    /// As for [`gaussians`](Self::gaussians).
    pub fn state(&mut self) -> Result<TrainerState> {
        let gaussians = self.gaussians()?;
        let n = gaussians.len();
        let motion = match self.motion()? {
            None => None,
            Some((points, network)) => {
                let trainer = self.motion.as_ref().expect("it gave its parameters");
                let neighbours = trainer.motion.skin.neighbours().k();
                let moments = trainer.moments(&mut self.stream)?;
                let following = trainer.following(&mut self.stream)?;
                Some((MotionStart { points, network, neighbours }, moments, following))
            }
        };
        let trainable = self.stream.download(&self.optimiser.trainable)?;
        Ok(TrainerState {
            step: self.step,
            moments: self.optimiser.moments(&mut self.stream, n)?,
            trainable: trainable[..n].iter().map(|&word| word != 0).collect(),
            gaussians,
            motion,
            selection: match &self.selection {
                Some(selection) => selection.state(&mut self.stream, n)?,
                None => None,
            },
            statistics: match &self.statistics {
                Some(statistics) => Some(statistics.download(&mut self.stream, n)?),
                None => None,
            },
            control_changes: self.control_changes,
            broken_gradients: self.broken_gradients()?,
            scene_radius: self.scene_radius,
            rng: self.rng.clone(),
            round: Vec::new(),
            capacities: self.frame_pool.capacities(),
            pending: Vec::new(),
        })
    }

    /// Resumes training from a state. With the same settings as the optimiser that the state came from,
    /// every later step gives the same bits.
    ///
    /// # Errors
    /// As for [`new`](Self::new); [`Error::Input`] for the state of a trainer on views.
    pub fn resume(
        device: &Device,
        state: TrainerState,
        settings: TrainSettings,
    ) -> Result<SceneOptimiser> {
        if !(state.round.is_empty() && state.pending.is_empty()) {
            let what = "the state to resume from is of a training on images";
            return Err(Error::Input(what.into()));
        }
        let (gaussians, radius) = (&state.gaussians, state.scene_radius);
        let mut scene = SceneOptimiser::new(device, gaussians, state.start(), radius, settings)?;
        scene.restore(state)?;
        Ok(scene)
    }

    /// Restores what a new optimiser of the state's Gaussians and motion does not hold.
    fn restore(&mut self, state: TrainerState) -> Result<()> {
        self.optimiser.set_moments(&mut self.stream, &state.moments)?;
        let words: Vec<u32> = state.trainable.into_iter().map(u32::from).collect();
        self.stream.upload(&mut self.optimiser.trainable, &words)?;
        if let (Some(motion), Some((_, moments, following))) = (&mut self.motion, &state.motion) {
            motion.set_moments(&mut self.stream, moments)?;
            motion.set_following(&mut self.stream, following)?;
        }
        if let (Some(selection), Some(state)) = (&mut self.selection, state.selection) {
            selection.set_state(&mut self.stream, &state)?;
        }
        if let (Some(statistics), Some(sums)) = (&mut self.statistics, state.statistics) {
            statistics.restore(&mut self.stream, &sums)?;
        }
        self.control_changes = state.control_changes;
        self.broken_before = state.broken_gradients;
        for (size, capacity) in state.capacities {
            self.frame_pool.reserve(&self.device, size, capacity)?;
        }
        (self.step, self.rng) = (state.step, state.rng);
        Ok(())
    }
}
