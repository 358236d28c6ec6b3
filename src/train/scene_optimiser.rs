//! A scene on the device under training: it renders, differentiates and updates.
//!
//! This is the path of every training step, with the engine's loss ([`Trainer`](super::Trainer)) or with
//! the caller's own ([`own_loss`](super::own_loss)).

use super::frame_pool::{Capacity, FramePool};
use super::growth::{Growth, Statistics};
use super::motion::{MotionNow, MotionStart, MotionTrainer};
use super::optimiser::{GaussianOptimiser, GaussianStep};
use super::own_loss::{Differentiated, Pass, Rendered, Updated};
use super::rounds::ControlChanges;
use super::selection::Selection;
use super::settings::TrainSettings;
use crate::gpu::{Buffer, Device, Readback, Recorder, Stream};
use crate::ops::gaussians::GaussianBuffers;
use crate::ops::render::{PixelGradientViews, PixelViews};
use crate::types::range::{self, Check};
use crate::types::{Camera, DeformNet, Gaussians};
use crate::{Error, Result};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use std::sync::Arc;

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

/// Checks that every number of the settings and the motion model is in its range.
fn check(motion: Option<&MotionStart>, settings: &TrainSettings) -> Check {
    settings.render.check().map_err(|what| format!("settings: {what}"))?;
    if let Some(unit) = settings.position_unit {
        range::wanted(unit > 0.0 && unit <= f64::from(range::REACH), || {
            format!("settings: a position unit of {unit:?}: it must be positive")
        })?;
    }
    range::colour(settings.background).map_err(|what| format!("background: {what}"))?;
    let Some(start) = motion else { return Ok(()) };
    start.points.check()?;
    start.network.as_ref().map_or(Ok(()), DeformNet::check)
}

/// A scene on the device, with gradients and the state of their optimiser. It knows no training views
/// and no loss; `own_loss` has the steps.
pub struct SceneOptimiser {
    pub(super) device: Device,
    pub(super) stream: Stream,
    pub(super) settings: TrainSettings,
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
    /// Scene radius of the first Gaussians, the unit of density control's scale limits.
    pub(super) scene_radius: f64,
    pub(super) step: u32,
    pub(super) rng: ChaCha8Rng,
    pub(super) idle: Vec<Readback<u32>>,
    /// Identifies the passes of this optimiser.
    pub(super) identity: Arc<()>,
}

/// The sizes of a scene, world units.
#[derive(Clone, Copy)]
pub(super) struct Lengths {
    /// Scene radius, the unit of density control's scale limits.
    pub(super) radius: f64,
    /// The unit of the positions' learning rate.
    pub(super) extent: f64,
}

impl SceneOptimiser {
    /// Uploads Gaussians. With `motion`, those whose motion logit is above 0 follow the control points,
    /// which are trained as well; without it, everything is static. `extent` is the unit of the
    /// positions' learning rate and of density control's scale limits: about the distance of the
    /// outermost camera from the cameras' mean, world units.
    ///
    /// # Errors
    /// [`Error::Input`] without Gaussians, for an extent that is not positive, or for a number that is
    /// out of its [range], including NaN; [`Error::OutOfMemory`].
    pub fn new(
        device: &Device,
        gaussians: &Gaussians,
        motion: Option<&MotionStart>,
        extent: f64,
        settings: TrainSettings,
    ) -> Result<SceneOptimiser> {
        if !(extent > 0.0 && extent <= f64::from(range::REACH)) {
            let most = range::REACH;
            let what =
                format!("a scene of extent {extent:?}: it must be positive, at most {most:e}");
            return Err(Error::Input(what));
        }
        let capacity = Capacity::of(&settings, gaussians.len());
        let lengths = Lengths { radius: extent, extent };
        SceneOptimiser::build(device, gaussians, motion, settings, lengths, capacity)
    }

    /// As [`new`](Self::new), for known lengths and a given capacity.
    pub(super) fn build(
        device: &Device,
        gaussians: &Gaussians,
        motion: Option<&MotionStart>,
        settings: TrainSettings,
        Lengths { radius, extent }: Lengths,
        capacity: Capacity,
    ) -> Result<SceneOptimiser> {
        if gaussians.is_empty() {
            return Err(Error::Input("training needs at least one Gaussian".into()));
        }
        check(motion, &settings).map_err(Error::Input)?;
        let mut stream = device.stream()?;
        let most = capacity.gaussians;
        let degree = settings.sh_degree;
        let mut buffers = GaussianBuffers::new(device, most, degree)?;
        buffers.upload(&mut stream, gaussians)?;
        for i in 0..gaussians.len() {
            gaussians.check(i).map_err(|what| Error::Input(format!("Gaussian {i}: {what}")))?;
        }
        let (mut motion_trainer, mut selection) = (None, None);
        if let Some(start) = motion {
            let mut trainer = MotionTrainer::new(&mut stream, start, settings.motion, most)?;
            let mut logits = gaussians.motion_logits.clone();
            logits.resize(gaussians.len(), -1.0);
            let chosen = Selection::new(&mut stream, &logits, most, settings.motion.selection)?;
            let least = chosen.least(0, settings.steps);
            trainer.set_dynamic(&mut stream, &logits, least, &buffers)?;
            (motion_trainer, selection) = (Some(trainer), Some(chosen));
        }
        let growth = Growth::new(&mut stream, &settings, most, radius, selection.as_ref())?;
        let revised = motion.is_some() && settings.motion.control.is_some();
        let statistics = match revised || growth.as_ref().is_some_and(Growth::wants_statistics) {
            true => Some(Statistics::new(&mut stream, most)?),
            false => None,
        };
        Ok(SceneOptimiser {
            device: device.clone(),
            frame_pool: FramePool::new(capacity, &settings),
            gaussians: buffers,
            gradients: GaussianBuffers::new(device, most, degree)?,
            optimiser: GaussianOptimiser::new(&mut stream, most, degree)?,
            growth,
            statistics,
            motion: motion_trainer,
            selection,
            control_changes: ControlChanges::default(),
            broken_before: 0,
            scene_radius: radius,
            extent,
            step: 0,
            rng: ChaCha8Rng::seed_from_u64(settings.seed),
            idle: Vec::new(),
            identity: Arc::new(()),
            stream,
            settings,
        })
    }

    /// The progress so far.
    pub fn progress(&self) -> Progress {
        Progress { step: self.step, steps: self.settings.steps, gaussians: self.gaussians.len }
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

    /// Waits and reads the Gaussians.
    ///
    /// # Errors
    /// [`Error::OutOfMemory`], [`Error::DeviceLost`], or another failed Vulkan call.
    pub fn gaussians(&mut self) -> Result<Gaussians> {
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
    /// As for [`gaussians`](Self::gaussians).
    pub fn motion(&mut self) -> Result<Option<MotionNow>> {
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
    /// As for [`gaussians`](Self::gaussians).
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

    /// Records the render of the scene from `camera` at `time`.
    pub(super) fn render(
        &mut self,
        recorder: &mut Recorder,
        camera: &Camera,
        time: f64,
    ) -> Result<Pass<Rendered>> {
        let size = (camera.intrinsics.width, camera.intrinsics.height);
        let frame = &mut self.frame_pool.for_size(&self.device, size)?.frame;
        let (step, steps) = (self.step, self.settings.steps);
        let canonical = self.gaussians.views().at_degree(self.settings.sh_degree_at(step));
        let scene = match &mut self.motion {
            Some(motion) => {
                let soft = self.selection.as_ref().and_then(|s| s.soft(canonical.len, step, steps));
                motion.forward(recorder, &canonical, time, soft, &mut self.rng)?;
                motion.motion.moved(canonical)
            }
            None => canonical,
        };
        frame.forward(recorder, camera, scene, PixelViews::default())?;
        let counts = match self.idle.pop() {
            Some(readback) => readback,
            None => self.device.readback(2)?,
        };
        recorder.read_back(frame.device_counts(), &counts);
        Ok(Pass::new(size, counts, self.identity.clone()))
    }

    /// Records the gradients with respect to every parameter, from the gradient with respect to the
    /// image, and what else follows from them: density control's statistics, and the loss by the view's
    /// motion mask in the steps that have one.
    pub(super) fn differentiate(
        &mut self,
        recorder: &mut Recorder,
        pass: Pass<Rendered>,
        by: PixelGradientViews<'_>,
        with_pose: bool,
        mask: Option<&Buffer<f32>>,
    ) -> Result<Pass<Differentiated>> {
        let frame = &mut self.frame_pool.for_size(&self.device, pass.size())?.frame;
        let (step, steps) = (self.step, self.settings.steps);
        let canonical = self.gaussians.views().at_degree(self.settings.sh_degree_at(step));
        let scene = match &self.motion {
            Some(motion) => motion.motion.moved(canonical),
            None => canonical,
        };
        frame.backward(recorder, scene, by, &mut self.gradients, with_pose)?;
        if let Some(statistics) = &mut self.statistics {
            statistics.add(recorder, canonical.len, frame)?;
        }
        if let (Some(motion), Some(selection)) = (&mut self.motion, &mut self.selection) {
            let (n, listed) = (canonical.len, motion.motion.dynamic);
            let soft = selection.soft_gradients(recorder, n, listed, step, steps);
            motion.backward(recorder, &canonical, &mut self.gradients, soft)?;
            selection.differentiate(recorder, frame, mask, n, step, steps)?;
        }
        Ok(pass.reach())
    }

    /// Records the update of every parameter by these gradients and by the regularisers of density
    /// control.
    pub(super) fn learn(
        &mut self,
        recorder: &mut Recorder,
        pass: Pass<Differentiated>,
    ) -> Result<Pass<Updated>> {
        let frame = &self.frame_pool.for_size(&self.device, pass.size())?.frame;
        let (step, steps) = (self.step, self.settings.steps);
        let fits = frame.fits();
        if let (Some(motion), Some(selection)) = (&mut self.motion, &mut self.selection) {
            motion.update(recorder, step, steps, fits)?;
            selection.update(recorder, fits, self.gaussians.len, step, steps)?;
        }
        if let Some(growth) = &self.growth {
            growth.regularise(recorder, &self.gaussians, &mut self.gradients)?;
        }
        let at = GaussianStep { settings: &self.settings, step, extent: self.extent, fits };
        self.optimiser.record(recorder, at, &mut self.gaussians, &self.gradients)?;
        if let Some(growth) = &self.growth {
            let rate = self.settings.position_rate_at(step) * self.extent;
            growth.explore(recorder, &mut self.gaussians, rate, step)?;
        }
        Ok(pass.reach())
    }
}
