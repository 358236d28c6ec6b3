//! Looks on while a scene is trained: progress, time by stage, checkpoints, Ctrl-C.

use splat4d::Result;
use splat4d::ops::loss::LossValue;
use splat4d::train::{Checkpoint, Measured, Observer, Phase};

use super::checkpoints::Checkpoints;
use super::clock::Clock;
use super::meter::Meter;

/// The observer of `train` and `reconstruct`.
pub struct Watcher<'a> {
    clock: &'a mut Clock,
    checkpoints: &'a mut Checkpoints,
    /// What a phase is called, on the bar and in the report.
    names: &'a dyn Fn(Phase) -> (&'static str, &'static str),
    under_way: Option<(Phase, Meter)>,
    /// Steps done here, without those of the run that this one resumes.
    steps: u32,
    /// What was measured on the way, where it is asked for.
    history: Option<Vec<Measured>>,
}

/// What a training leaves to tell.
pub struct Watched {
    /// Mean of a step of the last stage.
    pub milliseconds_per_step: f64,
    /// What was measured on the way; empty unless it was asked for. A run that resumes another has
    /// its own part.
    pub history: Vec<Measured>,
}

impl<'a> Watcher<'a> {
    /// Begins to look; `names` gives what a phase is called on the bar and in the report.
    pub fn new(
        clock: &'a mut Clock,
        checkpoints: &'a mut Checkpoints,
        names: &'a dyn Fn(Phase) -> (&'static str, &'static str),
    ) -> Watcher<'a> {
        Watcher { clock, checkpoints, names, under_way: None, steps: 0, history: None }
    }

    /// Measures on the way, too.
    pub fn measuring(self, measuring: bool) -> Watcher<'a> {
        Watcher { history: measuring.then(Vec::new), ..self }
    }

    /// Ends the last stage.
    pub fn finish(mut self) -> Watched {
        let stage = self.under_way.as_ref().map(|(phase, _)| (self.names)(*phase).1);
        self.end_stage();
        let seconds = stage.map_or(0.0, |stage| self.clock.seconds(stage));
        Watched {
            milliseconds_per_step: 1e3 * seconds / f64::from(self.steps.max(1)),
            history: self.history.unwrap_or_default(),
        }
    }

    fn end_stage(&mut self) {
        if let Some((phase, _)) = self.under_way.take() {
            self.clock.lap((self.names)(phase).1);
        }
    }
}

impl Observer for Watcher<'_> {
    fn progress(&mut self, phase: Phase, step: u32, steps: u32) -> Result<()> {
        self.checkpoints.interrupt()?;
        let before = self.under_way.as_ref().map(|(before, _)| *before);
        if before != Some(phase) {
            self.end_stage();
            let (bar, stage) = (self.names)(phase);
            if before.is_none_or(|before| (self.names)(before).1 != stage) {
                self.steps = 0;
            }
            let meter = Meter::new(bar, "steps", steps.into(), u64::from(step) - 1);
            self.under_way = Some((phase, meter));
        }
        self.steps += 1;
        if let Some((_, meter)) = &mut self.under_way {
            meter.set(step.into());
        }
        Ok(())
    }

    fn loss(&mut self, loss: LossValue) {
        if let Some((_, meter)) = &mut self.under_way {
            meter.message(format!("(L1 {:.4}, SSIM {:.3})", loss.l1, loss.ssim));
        }
    }

    fn measures(&self) -> bool {
        self.history.is_some()
    }

    fn measured(&mut self, measured: &Measured) {
        if let Some(history) = &mut self.history {
            history.push(*measured);
        }
    }

    fn wants_checkpoint(&mut self) -> bool {
        self.checkpoints.due()
    }

    fn checkpoint(&mut self, checkpoint: &Checkpoint) -> Result<()> {
        self.checkpoints.save("training", checkpoint);
        Ok(())
    }
}
