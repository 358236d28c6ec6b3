//! Training observer: progress, time by stage, checkpoints, Ctrl-C.

use std::borrow::Cow;
use std::time::{Duration, Instant};

use serde_json::{Value, json};
use splat4d::Result;
use splat4d::gpu::Device;
use splat4d::ops::loss::LossValue;
use splat4d::scene::Scene;
use splat4d::train::{Checkpoint, Measured, Observer, Phase};
use splat4d::view::protocol::Progressed;

use super::checkpoints::Checkpoints;
use super::clock::Clock;
use super::live::{Foreseen, Live};
use super::meter::Meter;

/// Checkpoint of a training: its state, and the measurements so far.
pub type Kept = (Checkpoint, Vec<Measured>);

/// Inverse of the maximum share of time spent on measuring only for a page, with or without viewers. The
/// measured time includes waiting for steps in flight, which is not lost.
const SHARE: u32 = 60;
const SHARE_SEEN: u32 = 10;

/// The observer of `train` and `reconstruct`.
pub struct Watcher<'a> {
    clock: &'a mut Clock,
    checkpoints: &'a mut Checkpoints,
    /// Gives the names of a phase, on the progress bar and in the report.
    names: &'a dyn Fn(Phase) -> (&'static str, &'static str),
    under_way: Option<(Phase, Meter)>,
    /// Steps done in this run, without those of the run that it resumes.
    steps: u32,
    /// Measurements during the training.
    history: Vec<Measured>,
    /// Whether everything is to be measured.
    measuring: bool,
    live: Option<&'a Live>,
    /// Start of the current measurement for the page.
    begun: Option<Instant>,
    /// End of the last one, and its duration.
    last: Option<(Instant, Duration)>,
}

/// Results of a training's observation.
pub struct Watched {
    /// Mean duration of a step of the last stage, milliseconds.
    milliseconds_per_step: f64,
    /// Measurements during the training, including those of the run that this one resumes.
    pub history: Vec<Measured>,
}

impl Watched {
    /// The scene's own report with the values that vary between runs, which the scene does not keep, so that
    /// identical runs give identical files.
    pub fn report(
        &self,
        scene: &Scene,
        foreseen: Foreseen,
        device: &Device,
        clock: &Clock,
    ) -> Value {
        let mut report = scene.report.clone();
        report["predicted_bytes"] = json!(foreseen.with_page);
        report["peak_bytes"] = json!(device.memory().1);
        report["milliseconds_per_step"] = json!(self.milliseconds_per_step);
        report["seconds"] = clock.json();
        report
    }
}

/// Name on the page for a phase's name on the progress bar.
fn stage(name: &'static str) -> Cow<'static, str> {
    match name {
        "training" => name.into(),
        part => format!("training, {part}").into(),
    }
}

/// Number of steps of the stages before the one of a measurement.
pub fn steps_before(history: &[Measured], phase: Phase) -> u32 {
    let still = history.iter().filter(|m| m.phase == Phase::Static).map(|m| m.step).max();
    if phase == Phase::Joint { still.unwrap_or(0) } else { 0 }
}

impl<'a> Watcher<'a> {
    /// Starts observing; `names` gives the names of a phase on the progress bar and in the report.
    pub fn new(
        clock: &'a mut Clock,
        checkpoints: &'a mut Checkpoints,
        names: &'a dyn Fn(Phase) -> (&'static str, &'static str),
    ) -> Watcher<'a> {
        Watcher {
            clock,
            checkpoints,
            names,
            under_way: None,
            steps: 0,
            history: Vec::new(),
            measuring: false,
            live: None,
            begun: None,
            last: None,
        }
    }

    /// Also measures during the training.
    pub fn measuring(self, measuring: bool) -> Watcher<'a> {
        Watcher { measuring, ..self }
    }

    /// Continues from earlier measurements.
    pub fn after(self, history: Vec<Measured>) -> Watcher<'a> {
        history.iter().for_each(|measured| self.draw(&history, measured));
        Watcher { history, ..self }
    }

    /// Also reports to a live view; to be called before [`after`](Self::after).
    pub fn shown(self, live: Option<&'a Live>) -> Watcher<'a> {
        Watcher { live, ..self }
    }

    /// Adds a point to the page's curves.
    fn draw(&self, history: &[Measured], measured: &Measured) {
        let Some(live) = self.live else { return };
        let Measured { phase, step, gaussians, l1, ssim, psnr } = *measured;
        let step = steps_before(history, phase) + step;
        live.measured(Progressed { step, gaussians, l1, ssim, psnr });
    }

    /// Ends the last stage.
    pub fn finish(mut self) -> Watched {
        let stage = self.under_way.as_ref().map(|(phase, _)| (self.names)(*phase).1);
        self.end_stage();
        let seconds = stage.map_or(0.0, |stage| self.clock.seconds(stage));
        Watched {
            milliseconds_per_step: 1e3 * seconds / f64::from(self.steps.max(1)),
            history: self.history,
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
        if let Some(live) = self.live {
            live.steps(&stage((self.names)(phase).0), step, steps);
        }
        Ok(())
    }

    fn loss(&mut self, loss: LossValue) {
        if let Some((_, meter)) = &mut self.under_way {
            meter.message(format!("(L1 {:.4}, SSIM {:.3})", loss.l1, loss.ssim));
        }
    }

    fn measures(&mut self) -> bool {
        let is_due = |live: &Live| {
            let share = if live.is_seen() { SHARE_SEEN } else { SHARE };
            self.last.is_none_or(|(ended, took)| ended.elapsed() >= took * share)
        };
        let drawn = self.live.is_some_and(is_due);
        self.begun = drawn.then(Instant::now);
        self.measuring || drawn
    }

    fn measured(&mut self, measured: &Measured) {
        if let Some(begun) = self.begun.take() {
            self.last = Some((Instant::now(), begun.elapsed()));
        }
        self.draw(&self.history, measured);
        self.history.push(*measured);
    }

    fn wants_scene(&mut self) -> bool {
        self.live.is_some_and(Live::wants_scene)
    }

    fn scene(&mut self, scene: Scene) {
        if let Some(live) = self.live {
            live.scene(scene);
        }
    }

    fn wants_checkpoint(&mut self) -> bool {
        self.checkpoints.due()
    }

    fn checkpoint(&mut self, checkpoint: &Checkpoint) -> Result<()> {
        self.checkpoints.save("training", &(checkpoint, &self.history));
        Ok(())
    }
}
