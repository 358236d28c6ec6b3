//! A trainer's state on the host: everything that its next step depends on, except the training views
//! and settings.

use rand_chacha::ChaCha8Rng;
#[cfg(feature = "files")]
use serde::{Deserialize, Serialize};

use super::frame_pool::Capacity;
use super::motion::{Following, MotionMoments, MotionStart};
use super::rounds::ControlChanges;
use super::selection::SelectionState;
use super::settings::TrainSettings;
use super::trainer::Trainer;
use super::views::TrainingView;
use crate::gpu::Device;
use crate::types::Gaussians;
use crate::{Error, Result};

/// The state of a trainer, from [`Trainer::state`] for [`Trainer::resume`].
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
}

impl Trainer {
    /// Waits and reads everything that the next step depends on. Reading the state does not change the
    /// course of the training.
    ///
    /// # Errors
    /// As for [`step`](Self::step).
    pub fn state(&mut self) -> Result<TrainerState> {
        let pending = self.settle()?;
        let gaussians = self.download_gaussians()?;
        let n = gaussians.len();
        let motion = match self.download_motion()? {
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
            round: self.round.clone(),
            capacities: self.frame_pool.capacities(),
            pending,
        })
    }

    /// Resumes training from a state. With the same views (none for a trainer without them) and settings
    /// as the trainer that the state came from, every later step gives the same bits.
    ///
    /// # Errors
    /// As for [`Trainer::new`]; [`Error::Input`] for a state that refers to views that are not given.
    pub fn resume(
        device: &Device,
        views: &[TrainingView],
        state: TrainerState,
        settings: TrainSettings,
    ) -> Result<Trainer> {
        let TrainerState { step, gaussians, moments, trainable, rng, round, capacities, .. } =
            state;
        let mut pictures = round.iter().chain(state.pending.iter().map(|(view, _)| view));
        if pictures.any(|&view| view >= views.len()) {
            return Err(Error::Input("the state to resume from is of other pictures".into()));
        }
        let start = state.motion.as_ref().map(|(start, ..)| start);
        let scene_radius = state.scene_radius;
        let mut trainer = match views.is_empty() {
            true => {
                let capacity = Capacity::of(&settings, gaussians.len());
                Trainer::build(
                    device,
                    &[],
                    &gaussians,
                    start,
                    settings,
                    (scene_radius, scene_radius),
                    capacity,
                )?
            }
            false => Trainer::with_scene_radius(
                device,
                views,
                &gaussians,
                start,
                settings,
                scene_radius,
            )?,
        };
        trainer.optimiser.set_moments(&mut trainer.stream, &moments)?;
        let words: Vec<u32> = trainable.into_iter().map(u32::from).collect();
        trainer.stream.upload(&mut trainer.optimiser.trainable, &words)?;
        if let (Some(motion), Some((_, moments, following))) = (&mut trainer.motion, &state.motion)
        {
            motion.set_moments(&mut trainer.stream, moments)?;
            motion.set_following(&mut trainer.stream, following)?;
        }
        if let (Some(selection), Some(state)) = (&mut trainer.selection, state.selection) {
            selection.set_state(&mut trainer.stream, &state)?;
        }
        if let (Some(statistics), Some(sums)) = (&mut trainer.statistics, state.statistics) {
            statistics.restore(&mut trainer.stream, &sums)?;
        }
        trainer.control_changes = state.control_changes;
        trainer.broken_before = state.broken_gradients;
        for (size, capacity) in capacities {
            trainer.frame_pool.reserve(device, size, capacity)?;
        }
        (trainer.step, trainer.rng, trainer.round) = (step, rng, round);
        trainer.set_settled(state.pending);
        Ok(trainer)
    }
}
