//! Training on views with the engine's loss.

use super::frame_pool::{Capacity, DeviceView};
use super::motion::{MotionNow, MotionStart};
use super::rounds::ControlChanges;
use super::scene_optimiser::{Lengths, Progress, SceneOptimiser};
use super::selection::Selection;
use super::settings::TrainSettings;
use super::views::{TrainingView, due, extent, scene_radius};
use crate::gpu::{Device, Readback, Ticket};
use crate::ops::loss::{LossArgs, LossSettings, LossValue};
use crate::ops::render::{FrameCounts, PixelGradientViews};
use crate::types::Gaussians;
use crate::{Error, Result};
use rand::RngExt;
use rand::seq::SliceRandom;
use std::collections::VecDeque;

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

/// Trains Gaussians on images.
pub struct Trainer {
    pub(super) scene: SceneOptimiser,
    pub(super) views: Vec<DeviceView>,
    /// Views that remain in this round; the last one comes next.
    pub(super) round: Vec<usize>,
    last_view: Option<usize>,
    pending: VecDeque<Pending>,
}

impl Trainer {
    /// Uploads training views and Gaussians. With `motion`, Gaussians whose motion logit is above 0
    /// follow the control points, which are trained as well; without it, everything is static.
    ///
    /// # Errors
    /// [`Error::Input`] without views or Gaussians, or for a number that is out of its
    /// [range](crate::types::range), including NaN; [`Error::OutOfMemory`]; [`Error::Shape`] when a view's
    /// image and its camera, weights, disparity or mask differ in size.
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
        radius: f64,
    ) -> Result<Trainer> {
        if views.is_empty() {
            return Err(Error::Input("training needs at least one image".into()));
        }
        for (i, view) in views.iter().enumerate() {
            view.check().map_err(|what| Error::Input(format!("image {i}: {what}")))?;
        }
        let cameras = views.iter().map(|view| &view.camera);
        let extent = settings.position_unit.unwrap_or_else(|| extent(cameras));
        let capacity = Capacity::of(&settings, gaussians.len());
        let lengths = Lengths { radius, extent };
        let scene = SceneOptimiser::build(device, gaussians, motion, settings, lengths, capacity)?;
        let views = views.iter().map(|view| DeviceView::new(device, view));
        Ok(Trainer::of(scene, views.collect::<Result<_>>()?))
    }

    /// A trainer of this scene on these views.
    pub(super) fn of(scene: SceneOptimiser, views: Vec<DeviceView>) -> Trainer {
        let (round, pending) = (Vec::new(), VecDeque::new());
        Trainer { scene, views, round, last_view: None, pending }
    }

    /// The progress so far.
    pub fn progress(&self) -> Progress {
        self.scene.progress()
    }

    /// Waits for the steps in flight, and gives the scene, for a step with the caller's own loss.
    ///
    /// # Errors
    /// As for [`step`](Self::step).
    pub fn scene(&mut self) -> Result<&mut SceneOptimiser> {
        self.finish()?;
        Ok(&mut self.scene)
    }

    /// Does one step on the next view of the round; each round shuffles the views anew. Returns before
    /// the device has finished.
    ///
    /// # Errors
    /// [`Error::OutOfMemory`], [`Error::DeviceLost`], or another failed Vulkan call; [`Error::Input`]
    /// during a step with the caller's own loss.
    pub fn step(&mut self) -> Result<()> {
        self.scene.check_free()?;
        while self.pending.len() >= IN_FLIGHT {
            self.retire()?;
        }
        let view = self.next_view();
        self.submit(view)?;
        self.last_view = Some(view);
        self.scene.step += 1;
        if self.scene.syncs() {
            self.finish()?;
        }
        self.scene.rounds()
    }

    /// Restricts training to some Gaussians, as [`SceneOptimiser::set_trainable`].
    ///
    /// # Errors
    /// As there.
    pub fn set_trainable(&mut self, trainable: &[bool]) -> Result<()> {
        self.scene.set_trainable(trainable)
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
        let resources = self.scene.frame_pool.for_size(&self.scene.device, size)?;
        let value = resources.loss.value(
            &mut self.scene.stream,
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
        let (view, last) = (&self.views[view], self.scene.step.saturating_sub(1));
        let repaints =
            |s: &Selection| s.repaints(view.mask.as_ref(), last, self.scene.settings.steps);
        if self.scene.selection.as_ref().is_some_and(repaints) {
            return Ok(None);
        }
        let size = (view.camera.intrinsics.width, view.camera.intrinsics.height);
        let resources = self.scene.frame_pool.for_size(&self.scene.device, size)?;
        view.reference.psnr(
            &mut self.scene.stream,
            &resources.frame.pixels,
            self.scene.settings.background,
        )
    }

    /// Waits and reads the Gaussians.
    ///
    /// # Errors
    /// As for [`step`](Self::step).
    pub fn gaussians(&mut self) -> Result<Gaussians> {
        self.scene()?.gaussians()
    }

    /// Waits and reads the control points, and the network where they have no paths. `None` where the
    /// scene does not move.
    ///
    /// # Errors
    /// As for [`step`](Self::step).
    pub fn motion(&mut self) -> Result<Option<MotionNow>> {
        self.scene()?.motion()
    }

    /// The numbers of control points that have been added and removed so far.
    pub fn control_changes(&self) -> ControlChanges {
        self.scene.control_changes()
    }

    /// Waits, and counts the gradients so far that were not finite, as
    /// [`SceneOptimiser::broken_gradients`].
    ///
    /// # Errors
    /// As for [`step`](Self::step).
    pub fn broken_gradients(&mut self) -> Result<u64> {
        self.scene.broken_gradients()
    }

    fn next_view(&mut self) -> usize {
        if self.round.is_empty() {
            let every: Vec<u32> = self.views.iter().map(|view| view.every).collect();
            let most = every.iter().copied().max().unwrap_or(1);
            let turn = if most > 1 { self.scene.rng.random_range(0..most) } else { 0 };
            self.round = due(&every, turn);
            self.round.shuffle(&mut self.scene.rng);
        }
        self.round.pop().expect("there is at least one view")
    }

    /// Submits a step on a view.
    pub(super) fn submit(&mut self, index: usize) -> Result<()> {
        let Trainer { scene, views, .. } = self;
        let view = &views[index];
        let mut recorder = scene.stream.record()?;
        let pass = scene.render(&mut recorder, &view.camera, view.time)?;
        let how = LossSettings {
            ssim_share: scene.settings.ssim_share,
            background: scene.settings.background,
            depth_scale: scene.settings.depth_scale,
        };
        let resources = scene.frame_pool.for_size(&scene.device, pass.size())?;
        let (frame, scratch) = (&mut resources.frame, &mut resources.loss_scratch);
        let args = LossArgs {
            rendered: &frame.pixels,
            reference: &view.reference,
            disparity: view.disparity.as_ref(),
            gradients: &mut frame.gradients.pixels,
        };
        resources.loss.record(&mut recorder, &how, args, scratch)?;
        let (by, mask) = (PixelGradientViews::default(), view.mask.as_ref());
        let pass = scene.differentiate(&mut recorder, pass, by, false, mask)?;
        let pass = scene.learn(&mut recorder, pass)?;
        let ticket = scene.stream.submit(recorder)?;
        let counts = Counts::UnderWay(ticket, pass.into_counts());
        self.pending.push_back(Pending { view: index, counts });
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
                self.scene.stream.wait(ticket)?;
                let mut words = [0; 2];
                readback.read_into(&mut words)?;
                self.scene.idle.push(readback);
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
        let resources = self.scene.frame_pool.for_size(&self.scene.device, size)?;
        if counts.intersections > resources.frame.plan().intersection_capacity() {
            // The device has not changed the parameters; the view is repeated.
            self.scene.frame_pool.grow(&self.scene.device, size, counts.intersections)?;
            self.round.push(pending.view);
            self.last_view = None;
        }
        Ok(())
    }
}
