//! The training step: deform, render, compare, differentiate, update.

use super::frame_pool::{Capacity, DeviceView, FramePool};
use super::growth::{Growth, Statistics};
use super::motion::{MotionNow, MotionStart, MotionTrainer};
use super::optimiser::GaussianOptimiser;
use super::own_loss::OwnStep;
use super::rounds::ControlChanges;
use super::selection::Selection;
use super::settings::TrainSettings;
use super::views::{TrainingView, due, extent, scene_radius};
use crate::gpu::{Device, Readback, Recorder, Stream, Ticket};
use crate::ops::gaussians::GaussianBuffers;
use crate::ops::loss::{LossSettings, LossValue};
use crate::ops::render::{FrameCounts, PixelGradientViews, PixelViews};
use crate::types::range::{self, Check};
use crate::types::{DeformNet, Gaussians};
use crate::{Error, Result};
use rand::seq::SliceRandom;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::collections::VecDeque;

/// Progress of a training.
#[derive(Clone, Copy, Debug)]
pub struct Progress {
    /// Number of steps done.
    pub step: u32,
    /// Total number of steps.
    pub steps: u32,
    /// Number of Gaussians.
    pub gaussians: usize,
}

/// Number of steps between synchronisations. At each one the host waits for the device, and the dynamic
/// Gaussians are listed anew and matched with their control points.
pub const SYNC_INTERVAL: u32 = 100;

/// Number of submissions that may be in flight before the host waits for the oldest: enough to keep the
/// device busy while the next one is recorded.
const IN_FLIGHT: usize = 2;

/// A submitted step whose counts have not been examined.
pub(super) struct Pending {
    view: usize,
    counts: Counts,
}

/// The frame counts of a step.
enum Counts {
    /// The device may not have finished the step.
    UnderWay(Ticket, Readback<u32>),
    /// The step is finished; its counts are read.
    Known([u32; 2]),
}

/// Checks that every number is in its range, except those of the Gaussians.
fn check(views: &[TrainingView], motion: Option<&MotionStart>, settings: &TrainSettings) -> Check {
    settings.render.check().map_err(|what| format!("settings: {what}"))?;
    if let Some(unit) = settings.position_unit {
        range::wanted(unit > 0.0 && unit <= f64::from(range::REACH), || {
            format!("settings: a position unit of {unit:?}: it must be positive")
        })?;
    }
    range::colour(settings.background).map_err(|what| format!("background: {what}"))?;
    for (i, view) in views.iter().enumerate() {
        view.check().map_err(|what| format!("picture {i}: {what}"))?;
    }
    let Some(start) = motion else { return Ok(()) };
    start.points.check()?;
    start.network.as_ref().map_or(Ok(()), DeformNet::check)
}

/// Trains Gaussians on images.
pub struct Trainer {
    pub(super) device: Device,
    pub(super) stream: Stream,
    pub(super) settings: TrainSettings,
    pub(super) views: Vec<DeviceView>,
    pub(super) frame_pool: FramePool,
    pub(super) gaussians: GaussianBuffers,
    pub(super) gradients: GaussianBuffers,
    pub(super) optimiser: GaussianOptimiser,
    pub(super) growth: Option<Growth>,
    /// `Some` where density control or the revision of control points reads the statistics.
    pub(super) statistics: Option<Statistics>,
    pub(super) motion: Option<MotionTrainer>,
    /// `Some` where the scene moves.
    pub(super) selection: Option<Selection>,
    pub(super) control_changes: ControlChanges,
    /// Number of skipped gradients before the state that training was resumed from.
    pub(super) broken_before: u64,
    pub(super) extent: f64,
    /// The step with the caller's own loss, while one is in progress.
    pub(super) own: Option<OwnStep>,
    /// Scene radius of the first Gaussians, the unit of density control's scale limits.
    pub(super) scene_radius: f64,
    pub(super) step: u32,
    pub(super) rng: ChaCha8Rng,
    /// Views that remain in this round; the last one comes next.
    pub(super) round: Vec<usize>,
    last_view: Option<usize>,
    pub(super) pending: VecDeque<Pending>,
    pub(super) idle: Vec<Readback<u32>>,
}

impl Trainer {
    /// Uploads training views and Gaussians. With `motion`, Gaussians whose motion logit is above 0
    /// follow the control points, which are trained as well; without it, everything is static.
    ///
    /// # Errors
    /// [`Error::Input`] without views or Gaussians, or for a number that is out of its [range],
    /// including NaN; [`Error::OutOfMemory`]; [`Error::Shape`] when a view's image and its camera,
    /// weights, disparity or mask differ in size.
    pub fn new(
        device: &Device,
        views: &[TrainingView],
        gaussians: &Gaussians,
        motion: Option<&MotionStart>,
        settings: TrainSettings,
    ) -> Result<Trainer> {
        let scene_radius = scene_radius(views, gaussians);
        Trainer::with_scene_radius(device, views, gaussians, motion, settings, scene_radius)
    }

    /// As [`new`](Self::new), with a known scene radius.
    pub(super) fn with_scene_radius(
        device: &Device,
        views: &[TrainingView],
        gaussians: &Gaussians,
        motion: Option<&MotionStart>,
        settings: TrainSettings,
        scene_radius: f64,
    ) -> Result<Trainer> {
        if views.is_empty() {
            return Err(Error::Input("training needs at least one picture".into()));
        }
        let cameras = views.iter().map(|view| &view.camera);
        let extent = settings.position_unit.unwrap_or_else(|| extent(cameras));
        let capacity = Capacity::of(&settings, gaussians.len());
        Trainer::build(device, views, gaussians, motion, settings, (scene_radius, extent), capacity)
    }

    /// Builds a trainer, with or without training views, for a known scene radius and extent and a given
    /// capacity.
    pub(super) fn build(
        device: &Device,
        views: &[TrainingView],
        gaussians: &Gaussians,
        motion: Option<&MotionStart>,
        settings: TrainSettings,
        (scene_radius, extent): (f64, f64),
        capacity: Capacity,
    ) -> Result<Trainer> {
        if gaussians.is_empty() {
            return Err(Error::Input("training needs at least one Gaussian".into()));
        }
        check(views, motion, &settings).map_err(Error::Input)?;
        let mut stream = device.stream()?;
        let gaussian_capacity = capacity.gaussians;
        let degree = settings.sh_degree;
        let mut buffers = GaussianBuffers::new(device, gaussian_capacity, degree)?;
        buffers.upload(&mut stream, gaussians)?;
        for i in 0..gaussians.len() {
            gaussians.check(i).map_err(|what| Error::Input(format!("Gaussian {i}: {what}")))?;
        }
        let (mut motion_trainer, mut selection) = (None, None);
        if let Some(start) = motion {
            let mut trainer =
                MotionTrainer::new(&mut stream, start, settings.motion, gaussian_capacity)?;
            let mut logits = gaussians.motion_logits.clone();
            logits.resize(gaussians.len(), -1.0);
            let chosen =
                Selection::new(&mut stream, &logits, gaussian_capacity, settings.motion.selection)?;
            let least = chosen.least(0, settings.steps);
            trainer.set_dynamic(&mut stream, &logits, least, &buffers)?;
            (motion_trainer, selection) = (Some(trainer), Some(chosen));
        }
        let growth = Growth::new(
            &mut stream,
            &settings,
            gaussian_capacity,
            scene_radius,
            selection.as_ref(),
        )?;
        let revised = motion.is_some() && settings.motion.control.is_some();
        let statistics = match revised || growth.as_ref().is_some_and(Growth::wants_statistics) {
            true => Some(Statistics::new(&mut stream, gaussian_capacity)?),
            false => None,
        };
        let device_views =
            views.iter().map(|view| DeviceView::new(device, view)).collect::<Result<Vec<_>>>()?;
        Ok(Trainer {
            device: device.clone(),
            views: device_views,
            frame_pool: FramePool::new(capacity, &settings),
            gaussians: buffers,
            gradients: GaussianBuffers::new(device, gaussian_capacity, degree)?,
            optimiser: GaussianOptimiser::new(&mut stream, gaussian_capacity, degree)?,
            growth,
            statistics,
            motion: motion_trainer,
            selection,
            control_changes: ControlChanges::default(),
            broken_before: 0,
            scene_radius,
            extent,
            own: None,
            step: 0,
            rng: ChaCha8Rng::seed_from_u64(settings.seed),
            round: Vec::new(),
            last_view: None,
            pending: VecDeque::new(),
            idle: Vec::new(),
            stream,
            settings,
        })
    }

    /// The progress so far.
    pub fn progress(&self) -> Progress {
        Progress { step: self.step, steps: self.settings.steps, gaussians: self.gaussians.len }
    }

    /// Does one step on the next view of the round; each round shuffles the views anew. Returns before
    /// the device has finished.
    ///
    /// # Errors
    /// [`Error::OutOfMemory`], [`Error::DeviceLost`], or another failed Vulkan call; [`Error::Input`]
    /// for a trainer without training views, or during a step with the caller's own loss.
    pub fn step(&mut self) -> Result<()> {
        if self.views.is_empty() || self.own.is_some() {
            let what = "a step on the trainer's own pictures: there are none, or a step with a \
                        loss of your own is under way; see `Trainer::forward`";
            return Err(Error::Input(what.into()));
        }
        while self.pending.len() >= IN_FLIGHT {
            self.retire()?;
        }
        let view = self.next_view();
        self.submit(view)?;
        self.last_view = Some(view);
        self.step += 1;
        self.rounds()
    }

    /// Restricts training to some Gaussians; the others stay bit for bit as they are. Growth must be
    /// off.
    ///
    /// # Errors
    /// [`Error::Shape`] for another number of flags than Gaussians, or a failed upload.
    pub fn set_trainable(&mut self, trainable: &[bool]) -> Result<()> {
        if trainable.len() != self.gaussians.len || self.growth.is_some() {
            return Err(Error::Shape {
                op: "training",
                arg: "trainable",
                expected: format!("{}, and no growth", self.gaussians.len),
                actual: trainable.len(),
            });
        }
        let words: Vec<u32> = trainable.iter().map(|&flag| u32::from(flag)).collect();
        self.stream.upload(&mut self.optimiser.trainable, &words)
    }

    /// Waits for the steps in flight. A step whose frame exceeded the capacity is repeated later with a
    /// larger one.
    ///
    /// # Errors
    /// As for [`step`](Self::step).
    pub fn finish(&mut self) -> Result<()> {
        while !self.pending.is_empty() {
            self.retire()?;
        }
        Ok(())
    }

    /// Waits and reads the last step's loss. `None` before the first step, and where the last step has
    /// to be repeated.
    ///
    /// # Errors
    /// As for [`step`](Self::step).
    pub fn loss(&mut self) -> Result<Option<LossValue>> {
        let Some(view) = self.last_view else { return Ok(None) };
        let view = &self.views[view];
        let size = (view.camera.intrinsics.width, view.camera.intrinsics.height);
        let resources = self.frame_pool.for_size(&self.device, size)?;
        let value = resources.loss.value(
            &mut self.stream,
            &view.reference,
            view.disparity.as_ref(),
            &resources.loss_scratch,
        );
        value.map(Some)
    }

    /// Waits, and measures the PSNR in dB of the last step's render, from before that step's update,
    /// against its reference. `None` where [`loss`](Self::loss) gives `None`, where the view has no
    /// pixel with weight, and after the steps in which the mask loss has overwritten the render.
    /// Downloads both images.
    ///
    /// # Errors
    /// As for [`step`](Self::step).
    pub fn psnr(&mut self) -> Result<Option<f64>> {
        let Some(view) = self.last_view else { return Ok(None) };
        let (view, last) = (&self.views[view], self.step.saturating_sub(1));
        let repaints = |s: &Selection| s.repaints(view.mask.as_ref(), last, self.settings.steps);
        if self.selection.as_ref().is_some_and(repaints) {
            return Ok(None);
        }
        let size = (view.camera.intrinsics.width, view.camera.intrinsics.height);
        let resources = self.frame_pool.for_size(&self.device, size)?;
        view.reference.psnr(&mut self.stream, &resources.frame.pixels, self.settings.background)
    }

    /// Waits and reads the Gaussians.
    ///
    /// # Errors
    /// As for [`step`](Self::step).
    pub fn gaussians(&mut self) -> Result<Gaussians> {
        self.finish()?;
        self.download_gaussians()
    }

    /// As [`gaussians`](Self::gaussians), after the steps that have been submitted, whether or not their
    /// frames fitted.
    pub(super) fn download_gaussians(&mut self) -> Result<Gaussians> {
        let mut gaussians = self.gaussians.download(&mut self.stream)?;
        if let Some(selection) = &self.selection {
            gaussians.motion_logits = selection.download(&mut self.stream, gaussians.len())?;
        }
        Ok(gaussians)
    }

    /// Waits and reads the control points, and the network where they have no paths. `None` where the
    /// scene does not move.
    ///
    /// # Errors
    /// As for [`step`](Self::step).
    pub fn motion(&mut self) -> Result<Option<MotionNow>> {
        self.finish()?;
        self.download_motion()
    }

    /// As [`motion`](Self::motion), after the steps that have been submitted, whether or not their
    /// frames fitted.
    pub(super) fn download_motion(&mut self) -> Result<Option<MotionNow>> {
        self.motion.as_ref().map(|motion| motion.download(&mut self.stream)).transpose()
    }

    /// The numbers of control points that have been added and removed so far.
    pub fn control_changes(&self) -> ControlChanges {
        self.control_changes
    }

    /// Waits, and counts the gradients so far that were not finite and whose update was skipped. The
    /// expected count is 0.
    ///
    /// # Errors
    /// As for [`step`](Self::step).
    pub fn broken_gradients(&mut self) -> Result<u64> {
        let mut count = self.broken_before + self.optimiser.broken(&mut self.stream)?;
        if let Some(motion) = &self.motion {
            count += motion.broken(&mut self.stream)?;
        }
        if let Some(selection) = &self.selection {
            count += selection.broken(&mut self.stream)?;
        }
        Ok(count)
    }

    fn next_view(&mut self) -> usize {
        if self.round.is_empty() {
            let every: Vec<u32> = self.views.iter().map(|view| view.every).collect();
            let most = every.iter().copied().max().unwrap_or(1);
            let turn = if most > 1 { self.rng.random_range(0..most) } else { 0 };
            self.round = due(&every, turn);
            self.round.shuffle(&mut self.rng);
        }
        self.round.pop().expect("there is at least one view")
    }

    pub(super) fn submit(&mut self, index: usize) -> Result<()> {
        let view = &self.views[index];
        let size = (view.camera.intrinsics.width, view.camera.intrinsics.height);
        let resources = self.frame_pool.for_size(&self.device, size)?;
        let (step, steps) = (self.step, self.settings.steps);
        let degree = self.settings.sh_degree_at(step);
        let loss = LossSettings {
            ssim_share: self.settings.ssim_share,
            background: self.settings.background,
            depth_scale: self.settings.depth_scale,
        };
        let counts = match self.idle.pop() {
            Some(readback) => readback,
            None => self.device.readback(2)?,
        };
        let mut recorder = self.stream.record()?;
        let canonical = self.gaussians.views().at_degree(degree);
        let scene = match &mut self.motion {
            Some(motion) => {
                let soft = self.selection.as_ref().and_then(|s| s.soft(canonical.len, step, steps));
                motion.forward(&mut recorder, &canonical, view.time, soft, &mut self.rng)?;
                motion.motion.moved(canonical)
            }
            None => canonical,
        };
        let frame = &mut resources.frame;
        frame.forward(&mut recorder, &view.camera, scene, PixelViews::default())?;
        resources.loss.record(
            &mut recorder,
            &loss,
            &frame.pixels,
            &view.reference,
            view.disparity.as_ref(),
            &mut frame.gradients.pixels,
            &mut resources.loss_scratch,
        )?;
        let by = PixelGradientViews::default();
        frame.backward(&mut recorder, scene, by, &mut self.gradients, false)?;
        self.gather(&mut recorder, size)?;
        self.learn(&mut recorder, size, Some(index))?;
        let resources = self.frame_pool.for_size(&self.device, size)?;
        recorder.read_back(resources.frame.device_counts(), &counts);
        let ticket = self.stream.submit(recorder)?;
        self.pending.push_back(Pending { view: index, counts: Counts::UnderWay(ticket, counts) });
        Ok(())
    }

    /// Records what follows the render's backward pass: density control's statistics, and the gradients
    /// with respect to the motion.
    pub(super) fn gather(&mut self, recorder: &mut Recorder, size: (u32, u32)) -> Result<()> {
        let resources = self.frame_pool.for_size(&self.device, size)?;
        let (step, steps) = (self.step, self.settings.steps);
        let canonical = self.gaussians.views().at_degree(self.settings.sh_degree_at(step));
        if let Some(statistics) = &mut self.statistics {
            statistics.add(recorder, canonical.len, &resources.frame)?;
        }
        if let (Some(motion), Some(selection)) = (&mut self.motion, &mut self.selection) {
            let (n, listed) = (canonical.len, motion.motion.dynamic);
            let soft = selection.soft_gradients(recorder, n, listed, step, steps);
            motion.backward(recorder, &canonical, &mut self.gradients, soft)?;
        }
        Ok(())
    }

    /// Records the update of every parameter by the gradients; `view` is the view whose motion mask
    /// counts in this step.
    pub(super) fn learn(
        &mut self,
        recorder: &mut Recorder,
        size: (u32, u32),
        view: Option<usize>,
    ) -> Result<()> {
        let resources = self.frame_pool.for_size(&self.device, size)?;
        let (step, steps) = (self.step, self.settings.steps);
        if let (Some(motion), Some(selection)) = (&mut self.motion, &mut self.selection) {
            motion.update(recorder, step, steps, resources.frame.fits())?;
            let mask = view.and_then(|view| self.views[view].mask.as_ref());
            selection.train(
                recorder,
                &mut resources.frame,
                mask,
                self.gaussians.len,
                step,
                steps,
            )?;
        }
        if let Some(growth) = &self.growth {
            growth.regularise(recorder, &self.gaussians, &mut self.gradients)?;
        }
        self.optimiser.record(
            recorder,
            &self.settings,
            step,
            self.extent,
            self.settings.sh_degree_at(step),
            resources.frame.fits(),
            &mut self.gaussians,
            &self.gradients,
        )?;
        if let Some(growth) = &self.growth {
            let rate = self.settings.position_rate_at(step) * self.extent;
            growth.explore(recorder, &mut self.gaussians, rate, step)?;
        }
        Ok(())
    }

    /// Waits for the steps in flight without acting on their counts, and returns the view and the counts
    /// of each. The counts take effect at the same step as without this call.
    pub(super) fn settle(&mut self) -> Result<Vec<(usize, [u32; 2])>> {
        let mut settled = Vec::with_capacity(self.pending.len());
        for Pending { view, counts } in std::mem::take(&mut self.pending) {
            settled.push((view, self.words(counts)?));
        }
        self.set_settled(settled.clone());
        Ok(settled)
    }

    /// Sets the pending steps to these, which the device has finished.
    pub(super) fn set_settled(&mut self, settled: Vec<(usize, [u32; 2])>) {
        let known = |(view, words)| Pending { view, counts: Counts::Known(words) };
        self.pending = settled.into_iter().map(known).collect();
    }

    /// Waits for a step's counts and reads them.
    fn words(&mut self, counts: Counts) -> Result<[u32; 2]> {
        match counts {
            Counts::Known(words) => Ok(words),
            Counts::UnderWay(ticket, mut readback) => {
                self.stream.wait(ticket)?;
                let mut words = [0; 2];
                readback.read_into(&mut words)?;
                self.idle.push(readback);
                Ok(words)
            }
        }
    }

    /// Waits for the oldest step in flight, and schedules its view again if its frame did not fit.
    fn retire(&mut self) -> Result<()> {
        let Some(pending) = self.pending.pop_front() else { return Ok(()) };
        let counts = FrameCounts::from_device(self.words(pending.counts)?);
        let k = self.views[pending.view].camera.intrinsics;
        let size = (k.width, k.height);
        let resources = self.frame_pool.for_size(&self.device, size)?;
        if counts.intersections > resources.frame.plan().intersection_capacity() {
            // The device has not changed the parameters; the view is repeated.
            self.frame_pool.grow(&self.device, size, counts.intersections)?;
            self.round.push(pending.view);
            self.last_view = None;
        }
        Ok(())
    }
}
