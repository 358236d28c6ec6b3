//! Observers of a training: progress, measurements, previews and checkpoints.

use serde::{Deserialize, Serialize};

use super::rounds::SYNC_INTERVAL;
use super::state::TrainerState;
use super::trainer::Trainer;
use crate::ops::loss::LossValue;
use crate::scene::Scene;
use crate::{Error, Result};

/// The phase of a training.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Phase {
    /// Training of the static scene alone.
    Static,
    /// Joint training of all Gaussians and their motion.
    Joint,
}

/// Everything that the rest of the training depends on, except input and settings. A training that
/// resumes from a checkpoint ends with the same bits as an uninterrupted one.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum Checkpoint {
    /// The state within [`Phase::Static`].
    Static(TrainerState),
    /// The state within [`Phase::Joint`].
    Joint(TrainerState),
}

impl Checkpoint {
    /// The error for a checkpoint that this training cannot have written.
    pub(super) fn foreign(&self) -> Error {
        let (phase, step) = self.place();
        Error::Input(format!(
            "the checkpoint (phase {phase:?}, step {step}) is of another training; begin anew"
        ))
    }

    /// The phase of the training, and the number of steps done in it.
    pub fn place(&self) -> (Phase, u32) {
        match self {
            Checkpoint::Static(trainer) => (Phase::Static, trainer.step()),
            Checkpoint::Joint(trainer) => (Phase::Joint, trainer.step()),
        }
    }
}

/// Measurements of the progress of a training, taken on the render of a step before that step's update.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Measured {
    /// The phase of a training.
    pub phase: Phase,
    /// Number of steps done in the phase.
    pub step: u32,
    /// Number of Gaussians.
    pub gaussians: usize,
    /// Weighted mean of the absolute differences.
    pub l1: f64,
    /// Weighted mean of SSIM, at most 1.
    pub ssim: f64,
    /// PSNR in dB; `None` where [`Trainer::psnr`] gives `None` or it is infinite.
    pub psnr: Option<f64>,
}

/// Number of measurements per phase, at least, if it has that many steps.
const MEASUREMENTS: u32 = 60;

/// An observer of a training. A closure that takes phase, steps done and total steps is an observer that
/// wants no checkpoints.
pub trait Observer {
    /// Called after every step. An error ends the training.
    fn progress(&mut self, phase: Phase, step: u32, steps: u32) -> Result<()>;

    /// Receives the loss of the last step, every [`SYNC_INTERVAL`] steps.
    fn loss(&mut self, _loss: LossValue) {}

    /// Whether to call [`measured`](Self::measured) now; asked each time a measurement is due. Measuring
    /// waits for the device and downloads an image.
    fn measures(&mut self) -> bool {
        false
    }

    /// Receives measurements, about 60 times in a phase or every [`SYNC_INTERVAL`] steps, and after the
    /// last step.
    fn measured(&mut self, _measured: &Measured) {}

    /// Whether to call [`scene`](Self::scene) now; asked after every step. Copying the scene waits for
    /// the device.
    fn wants_scene(&mut self) -> bool {
        false
    }

    /// Receives the current scene after [`wants_scene`](Self::wants_scene). It has no cameras where the
    /// trainer does not know them.
    fn scene(&mut self, _scene: Scene) {}

    /// Whether to call [`checkpoint`](Self::checkpoint) now; asked after every step. Reading the state
    /// waits for the device.
    fn wants_checkpoint(&mut self) -> bool {
        false
    }

    /// Receives the state to save after [`wants_checkpoint`](Self::wants_checkpoint). An error ends the
    /// training.
    fn checkpoint(&mut self, _checkpoint: &Checkpoint) -> Result<()> {
        Ok(())
    }
}

impl<F: FnMut(Phase, u32, u32) -> Result<()>> Observer for F {
    fn progress(&mut self, phase: Phase, step: u32, steps: u32) -> Result<()> {
        self(phase, step, steps)
    }
}

/// Runs a trainer until its last step; `wrap` makes a checkpoint of its state.
pub(super) fn run(
    trainer: &mut Trainer,
    phase: Phase,
    observer: &mut dyn Observer,
    wrap: impl Fn(TrainerState) -> Checkpoint,
) -> Result<()> {
    let mut now = trainer.progress();
    while now.step < now.steps {
        trainer.step()?;
        now = trainer.progress();
        observer.progress(phase, now.step, now.steps)?;
        if now.step.is_multiple_of(SYNC_INTERVAL)
            && now.step < now.steps
            && let Some(loss) = trainer.loss()?
        {
            observer.loss(loss);
        }
        let every = (now.steps / MEASUREMENTS).clamp(1, SYNC_INTERVAL);
        if (now.step.is_multiple_of(every) || now.step == now.steps)
            && observer.measures()
            && let Some(LossValue { l1, ssim, .. }) = trainer.loss()?
            // A view without any weight has no measurement.
            && l1 > 0.0
        {
            let psnr = trainer.psnr()?.filter(|psnr| psnr.is_finite());
            let (step, gaussians) = (now.step, now.gaussians);
            observer.measured(&Measured { phase, step, gaussians, l1, ssim, psnr });
        }
        if observer.wants_scene() {
            observer.scene(trainer.glimpse()?);
        }
        if observer.wants_checkpoint() {
            observer.checkpoint(&wrap(trainer.state()?))?;
        }
    }
    trainer.finish()
}
