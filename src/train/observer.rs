//! Who looks on while a scene is trained: progress, and checkpoints.

use serde::{Deserialize, Serialize};

use super::state::TrainerState;
use super::trainer::{SYNC_INTERVAL, Trainer};
use crate::ops::loss::LossValue;
use crate::scene::Scene;
use crate::{Error, Result};

/// What is being trained.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Phase {
    /// The static world.
    Static,
    /// Everything together.
    Joint,
}

/// All that the rest of the training depends on, besides input and settings. A training that
/// resumes from it ends with the same bits as one that was never interrupted.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum Checkpoint {
    /// Under way in [`Phase::Static`].
    Static(TrainerState),
    /// Under way in [`Phase::Joint`].
    Joint(TrainerState),
}

impl Checkpoint {
    /// The error for a checkpoint that the training at hand cannot have written.
    pub(super) fn foreign(&self) -> Error {
        let (phase, step) = self.place();
        Error::Input(format!(
            "the checkpoint (phase {phase:?}, step {step}) is of another training; begin anew"
        ))
    }

    /// Where the training was: the phase, and the steps done in it.
    pub fn place(&self) -> (Phase, u32) {
        match self {
            Checkpoint::Static(trainer) => (Phase::Static, trainer.step()),
            Checkpoint::Joint(trainer) => (Phase::Joint, trainer.step()),
        }
    }
}

/// How far a training has come, as measured on the picture of a step before what it changes.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Measured {
    /// What is being trained.
    pub phase: Phase,
    /// Steps done in it.
    pub step: u32,
    /// Number of Gaussians.
    pub gaussians: usize,
    /// Weighted mean of the absolute differences.
    pub l1: f64,
    /// Weighted mean of SSIM.
    pub ssim: f64,
    /// dB; `None` where [`Trainer::psnr`] gives none.
    pub psnr: Option<f64>,
}

/// So many times is a phase measured, at least, where its steps suffice.
const MEASUREMENTS: u32 = 60;

/// Looks on while a scene is trained. A closure that takes phase, steps done and steps in all is one
/// that wants no checkpoints.
pub trait Observer {
    /// Told after every step. An error ends the training.
    fn progress(&mut self, phase: Phase, step: u32, steps: u32) -> Result<()>;

    /// The loss of the last step, every [`SYNC_INTERVAL`] steps.
    fn loss(&mut self, _loss: LossValue) {}

    /// Whether [`measured`](Self::measured) is of use now; asked each time that it could be told. Measuring
    /// waits for the device and downloads a picture.
    fn measures(&mut self) -> bool {
        false
    }

    /// How far the training is, some 60 times in a phase or every [`SYNC_INTERVAL`] steps, and after its
    /// last step.
    fn measured(&mut self, _measured: &Measured) {}

    /// Whether the scene as it is would be of use now; asked after every step. Copying it waits for the
    /// device.
    fn wants_scene(&mut self) -> bool {
        false
    }

    /// The scene as it is, after it was wanted. One whose cameras are not the trainer's to know has none.
    fn scene(&mut self, _scene: Scene) {}

    /// Whether the state should be put away now; asked after every step. Reading the state waits for
    /// the device.
    fn wants_checkpoint(&mut self) -> bool {
        false
    }

    /// The state to put away, after it was wanted. An error ends the training.
    fn checkpoint(&mut self, _checkpoint: &Checkpoint) -> Result<()> {
        Ok(())
    }
}

impl<F: FnMut(Phase, u32, u32) -> Result<()>> Observer for F {
    fn progress(&mut self, phase: Phase, step: u32, steps: u32) -> Result<()> {
        self(phase, step, steps)
    }
}

/// Steps until a trainer is done; `wrap` makes a checkpoint of its state.
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
            // Of a picture that counts nowhere there is none.
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
