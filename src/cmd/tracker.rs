//! Tracking observer: progress, time by stage, checkpoints, Ctrl-C.

use splat4d::Result;
use splat4d::track::{Observer, Stage};

use super::checkpoints::Checkpoints;
use super::clock::Clock;
use super::interrupt;
use super::live::Live;
use super::meter::Meter;

/// The observer of `reconstruct` during tracking, and of `track`.
pub struct Tracker<'a> {
    clock: &'a mut Clock,
    checkpoints: Option<&'a mut Checkpoints>,
    under_way: Option<(Stage, Meter)>,
    live: Option<&'a Live>,
}

impl<'a> Tracker<'a> {
    /// Starts observing; parts are checkpointed if there are checkpoints.
    pub fn new(clock: &'a mut Clock, checkpoints: Option<&'a mut Checkpoints>) -> Tracker<'a> {
        Tracker { clock, checkpoints, under_way: None, live: None }
    }

    /// Also reports to a live view.
    pub fn shown(self, live: Option<&'a Live>) -> Tracker<'a> {
        Tracker { live, ..self }
    }

    /// Ends the last stage.
    pub fn finish(mut self) {
        self.end_stage();
    }

    fn end_stage(&mut self) {
        if let Some((stage, _)) = self.under_way.take() {
            self.clock.lap(name(stage));
        }
    }
}

/// Name of a stage, on the progress bar and in the report.
fn name(stage: Stage) -> &'static str {
    match stage {
        Stage::Flow => "flow",
        Stage::Cameras => "cameras",
        Stage::Masks => "masks",
        Stage::Depth => "depth",
    }
}

impl Observer for Tracker<'_> {
    fn progress(&mut self, stage: Stage, share: f64) -> Result<()> {
        match &self.checkpoints {
            Some(checkpoints) => checkpoints.interrupt()?,
            None => interrupt::check()?,
        }
        if self.under_way.as_ref().is_none_or(|(before, _)| *before != stage) {
            self.end_stage();
            self.under_way = Some((stage, Meter::new(name(stage), "%", 100, 0)));
        }
        if let Some((_, meter)) = &mut self.under_way {
            meter.set((100.0 * share) as u64);
        }
        if let Some(live) = self.live {
            live.percent(&format!("tracking, {}", name(stage)), (100.0 * share) as u64);
        }
        Ok(())
    }

    fn keeps(&self) -> bool {
        self.checkpoints.as_ref().is_some_and(|checkpoints| checkpoints.are_on())
    }

    fn keep(&mut self, part: &str, value: Vec<u8>) -> Result<()> {
        if let Some(checkpoints) = &mut self.checkpoints {
            checkpoints.keep(part, value);
        }
        Ok(())
    }

    fn kept(&mut self, part: &str) -> Result<Option<Vec<u8>>> {
        self.checkpoints.as_ref().map_or(Ok(None), |checkpoints| checkpoints.kept(part))
    }
}
