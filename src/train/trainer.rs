//! The training step: deform, render, compare, differentiate, update.

use super::growth::Growth;
use super::motion::{MotionStart, MotionTrainer};
use super::optimiser::GaussianOptimiser;
use super::photographs::{DeviceView, Studios};
use super::settings::TrainSettings;
use crate::data::View;
use crate::gpu::{Buffer, Device, Readback, Stream, Ticket};
use crate::ops::density;
use crate::ops::gaussians::GaussianBuffers;
use crate::ops::loss::{KnownDisparity, LossSettings, LossValue, Photograph};
use crate::ops::render::FrameCounts;
use crate::types::{Camera, ControlPoints, DeformNet, Gaussians, Image};
use crate::{Error, Result};
use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use serde::Serialize;
use std::collections::VecDeque;

/// A picture to train on.
#[derive(Clone, Debug, Serialize)]
pub struct TrainingView {
    /// Its camera, of the picture's size.
    pub camera: Camera,
    /// In [0, 1].
    pub time: f64,
    /// RGB in [0, 1].
    pub image: Image,
    /// Weight per pixel in [0, 1]; `None` for 1.
    pub weights: Option<Image>,
    /// Disparity (inverse depth) and its weight per pixel, two channels; `None` where unknown.
    pub disparity: Option<Image>,
}

/// A dataset's picture as training wants it; what undistortion left empty has no weight.
impl From<View> for TrainingView {
    fn from(view: View) -> TrainingView {
        let View { camera, time, image, valid, .. } = view;
        TrainingView { camera, time, image, weights: valid, disparity: None }
    }
}

/// How far training is.
#[derive(Clone, Copy, Debug)]
pub struct Progress {
    /// Steps done.
    pub step: u32,
    /// Steps in all.
    pub steps: u32,
    /// Number of Gaussians.
    pub gaussians: usize,
}

/// Steps between points at which the device is waited for, which Gaussians move is listed anew, and
/// these find their control points again. A trainer's state is well defined there: with
/// [`Trainer::state`] it can be put away, and training goes the same way whether it was or not.
pub const SYNC_INTERVAL: u32 = 100;

/// Submissions that may be under way before the host waits for the oldest: enough to keep the device
/// busy while the next one is recorded.
const IN_FLIGHT: usize = 2;

struct Pending {
    ticket: Ticket,
    view: usize,
    counts: Readback<u32>,
}

/// Trains Gaussians on pictures.
pub struct Trainer {
    device: Device,
    pub(super) stream: Stream,
    settings: TrainSettings,
    views: Vec<DeviceView>,
    pub(super) studios: Studios,
    gaussians: GaussianBuffers,
    gradients: GaussianBuffers,
    pub(super) optimiser: GaussianOptimiser,
    growth: Option<Growth>,
    pub(super) motion: Option<MotionTrainer>,
    /// Of the Gaussians, where there is motion.
    motion_logits: Option<Buffer<f32>>,
    extent: f64,
    pub(super) step: u32,
    pub(super) rng: ChaCha8Rng,
    /// Views still to come in this round, last first.
    pub(super) round: Vec<usize>,
    last_view: Option<usize>,
    pending: VecDeque<Pending>,
    idle: Vec<Readback<u32>>,
}

impl Trainer {
    /// Puts pictures and Gaussians on the device. With `motion`, Gaussians whose motion logit is
    /// above 0 follow the control points, and these are trained along; without, everything is
    /// static.
    ///
    /// # Errors
    /// [`Error::Input`] without views or Gaussians; [`Error::OutOfMemory`]; [`Error::Shape`] when a
    /// picture and its camera, weights or disparity differ in size.
    pub fn new(
        device: &Device,
        views: &[TrainingView],
        gaussians: &Gaussians,
        motion: Option<&MotionStart>,
        settings: TrainSettings,
    ) -> Result<Trainer> {
        if views.is_empty() || gaussians.is_empty() {
            return Err(Error::Input(
                "training needs at least one picture and one Gaussian".into(),
            ));
        }
        let mut stream = device.stream()?;
        let capacity = settings.max_gaussians.max(gaussians.len());
        let degree = settings.sh_degree;
        let mut buffers = GaussianBuffers::new(device, capacity, degree)?;
        buffers.upload(&mut stream, gaussians)?;
        let (mut motion_trainer, mut motion_logits) = (None, None);
        if let Some(start) = motion {
            let mut trainer = MotionTrainer::new(&mut stream, start, settings.motion, capacity)?;
            let mut logits = gaussians.motion_logits.clone();
            logits.resize(gaussians.len(), -1.0);
            trainer.set_dynamic(&mut stream, &logits, &buffers)?;
            let mut buffer = device.buffer("motion logits", capacity)?;
            stream.upload(&mut buffer, &logits)?;
            (motion_trainer, motion_logits) = (Some(trainer), Some(buffer));
        }
        let growth = match settings.growth {
            Some(growth) => Some(Growth::new(device, growth, capacity, settings.seed)?),
            None => None,
        };
        let device_views =
            views.iter().map(|view| upload(device, view)).collect::<Result<Vec<_>>>()?;
        Ok(Trainer {
            device: device.clone(),
            views: device_views,
            studios: Studios::new(capacity, settings.render),
            gaussians: buffers,
            gradients: GaussianBuffers::new(device, capacity, degree)?,
            optimiser: GaussianOptimiser::new(&mut stream, capacity, degree)?,
            growth,
            motion: motion_trainer,
            motion_logits,
            extent: extent(views.iter().map(|view| &view.camera)),
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

    /// How far training is.
    pub fn progress(&self) -> Progress {
        Progress { step: self.step, steps: self.settings.steps, gaussians: self.gaussians.len }
    }

    /// Does one step on the next picture of the round; each round shuffles anew. Returns before the
    /// device is done.
    ///
    /// # Errors
    /// [`Error::OutOfMemory`], [`Error::DeviceLost`], or another failed Vulkan call.
    pub fn step(&mut self) -> Result<()> {
        while self.pending.len() >= IN_FLIGHT {
            self.retire()?;
        }
        let view = self.next_view();
        self.submit(view)?;
        self.last_view = Some(view);
        self.step += 1;
        let grows = self.growth.as_ref().is_some_and(|g| g.due(self.step, self.settings.steps));
        let syncs = self.step.is_multiple_of(SYNC_INTERVAL);
        if syncs {
            self.finish()?;
        }
        if grows {
            self.grow()?;
        }
        if grows || syncs {
            self.list_dynamic()?;
        }
        Ok(())
    }

    /// Lets only some Gaussians train; the others stay bit for bit as they are. Growth must be off.
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

    /// A round of density control.
    fn grow(&mut self) -> Result<()> {
        let Some(growth) = &mut self.growth else { return Ok(()) };
        growth.round(
            &mut self.stream,
            self.step,
            &mut self.gaussians,
            self.motion_logits.as_mut(),
            &mut self.optimiser,
        )
    }

    /// Lists which Gaussians move, and finds what they follow.
    fn list_dynamic(&mut self) -> Result<()> {
        if let (Some(motion), Some(logits)) = (&mut self.motion, &self.motion_logits) {
            let mut logits = self.stream.download(logits)?;
            logits.truncate(self.gaussians.len);
            motion.set_dynamic(&mut self.stream, &logits, &self.gaussians)?;
        }
        Ok(())
    }

    /// Waits for the steps under way; a step whose frame did not fit is done again with more room.
    ///
    /// # Errors
    /// As for [`step`](Self::step).
    pub fn finish(&mut self) -> Result<()> {
        while !self.pending.is_empty() {
            self.retire()?;
        }
        Ok(())
    }

    /// Waits and reads the last step's loss; none before the first step, and where the last one has
    /// to be done again.
    ///
    /// # Errors
    /// As for [`step`](Self::step).
    pub fn loss(&mut self) -> Result<Option<LossValue>> {
        let Some(view) = self.last_view else { return Ok(None) };
        let view = &self.views[view];
        let size = (view.camera.intrinsics.width, view.camera.intrinsics.height);
        let studio = self.studios.for_size(&self.device, size)?;
        let value = studio.loss.value(
            &mut self.stream,
            &view.photograph,
            view.disparity.as_ref(),
            &studio.loss_scratch,
        );
        value.map(Some)
    }

    /// Waits and reads the Gaussians.
    ///
    /// # Errors
    /// As for [`step`](Self::step).
    pub fn gaussians(&mut self) -> Result<Gaussians> {
        self.finish()?;
        let mut gaussians = self.gaussians.download(&mut self.stream)?;
        if let Some(logits) = &self.motion_logits {
            gaussians.motion_logits = self.stream.download(logits)?;
            gaussians.motion_logits.truncate(gaussians.len());
        }
        Ok(gaussians)
    }

    /// Waits and reads control points and network, where there is motion.
    ///
    /// # Errors
    /// As for [`step`](Self::step).
    pub fn motion(&mut self) -> Result<Option<(ControlPoints, DeformNet)>> {
        self.finish()?;
        self.motion.as_ref().map(|motion| motion.download(&mut self.stream)).transpose()
    }

    fn next_view(&mut self) -> usize {
        if self.round.is_empty() {
            self.round = (0..self.views.len()).collect();
            self.round.shuffle(&mut self.rng);
        }
        self.round.pop().expect("there is at least one view")
    }

    fn submit(&mut self, index: usize) -> Result<()> {
        let view = &self.views[index];
        let size = (view.camera.intrinsics.width, view.camera.intrinsics.height);
        let studio = self.studios.for_size(&self.device, size)?;
        let degree = self.settings.sh_degree_at(self.step);
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
                motion.forward(&mut recorder, &canonical, view.time, &mut self.rng)?;
                motion.motion.moved(canonical)
            }
            None => canonical,
        };
        studio.render.forward(
            &mut recorder,
            &view.camera,
            scene,
            &mut studio.scratch,
            &mut studio.pixels,
        )?;
        studio.loss.record(
            &mut recorder,
            &loss,
            &studio.pixels,
            &view.photograph,
            view.disparity.as_ref(),
            &mut studio.pixel_gradients,
            &mut studio.loss_scratch,
        )?;
        studio.render.backward(
            &mut recorder,
            scene,
            &studio.scratch,
            &studio.pixels,
            &studio.pixel_gradients,
            &mut studio.backward,
            &mut self.gradients,
            false,
        )?;
        if let Some(motion) = &mut self.motion {
            motion.backward(
                &mut recorder,
                &canonical,
                &mut self.gradients,
                self.step,
                self.settings.steps,
                studio.scratch.fits(),
            )?;
        }
        if let Some(growth) = &self.growth {
            let n = canonical.len;
            density::regularise(
                &mut recorder,
                canonical.opacity_logits,
                canonical.log_scales,
                self.gradients.opacity_logits.range_mut(0..n),
                self.gradients.log_scales.range_mut(0..3 * n),
                growth.settings().opacity_weight,
                growth.settings().scale_weight,
            )?;
        }
        self.optimiser.record(
            &mut recorder,
            &self.settings,
            self.step,
            self.extent,
            degree,
            studio.scratch.fits(),
            &mut self.gaussians,
            &self.gradients,
        )?;
        if let Some(growth) = &self.growth {
            let n = self.gaussians.len;
            let size = self.settings.position_rate_at(self.step) * self.extent;
            density::jitter(
                &mut recorder,
                self.gaussians.positions.range_mut(0..3 * n),
                self.gaussians.log_scales.range(0..3 * n),
                self.gaussians.rotations.range(0..n),
                self.gaussians.opacity_logits.range(0..n),
                (size * growth.settings().noise) as f32,
                self.settings.seed as u32,
                self.step,
            )?;
        }
        recorder.read_back(studio.scratch.device_counts(), &counts);
        let ticket = self.stream.submit(recorder)?;
        self.pending.push_back(Pending { ticket, view: index, counts });
        Ok(())
    }

    /// Waits for the oldest step under way.
    fn retire(&mut self) -> Result<()> {
        let Some(pending) = self.pending.pop_front() else { return Ok(()) };
        self.stream.wait(pending.ticket)?;
        let words = pending.counts.read();
        let counts = FrameCounts::from_device([words[0], words[1]]);
        self.idle.push(pending.counts);
        let k = self.views[pending.view].camera.intrinsics;
        let size = (k.width, k.height);
        let studio = self.studios.for_size(&self.device, size)?;
        if counts.intersections > studio.render.intersection_capacity() {
            // The device has left the parameters alone; the picture comes again.
            self.studios.grow(&self.device, size, counts.intersections)?;
            self.round.push(pending.view);
            self.last_view = None;
        }
        Ok(())
    }
}

fn upload(device: &Device, view: &TrainingView) -> Result<DeviceView> {
    let k = view.camera.intrinsics;
    if (k.width, k.height) != (view.image.width, view.image.height) {
        return Err(Error::Shape {
            op: "training view",
            arg: "camera",
            expected: format!("{}×{} pixels", view.image.width, view.image.height),
            actual: (k.width * k.height) as usize,
        });
    }
    let disparity = match &view.disparity {
        None => None,
        Some(known) => {
            if known.pixels.len() != 2 * view.image.pixels.len() / 3 {
                return Err(Error::Shape {
                    op: "training view",
                    arg: "disparity",
                    expected: format!("{}", 2 * view.image.pixels.len() / 3),
                    actual: known.pixels.len(),
                });
            }
            Some(KnownDisparity::new(device, bytemuck::cast_slice(&known.pixels))?)
        }
    };
    Ok(DeviceView {
        camera: view.camera,
        time: view.time,
        photograph: Photograph::new(device, &view.image, view.weights.as_ref())?,
        disparity,
    })
}

/// 1.1 times the largest distance of a camera from their mean: the unit of the positions' learning
/// rate. Cameras in one place give 1.
fn extent<'a>(cameras: impl Iterator<Item = &'a Camera> + Clone) -> f64 {
    let centres: Vec<_> = cameras.map(Camera::centre).collect();
    let mean = centres.iter().copied().sum::<glam::DVec3>() / centres.len().max(1) as f64;
    let largest = centres.iter().map(|c| c.distance(mean)).fold(0.0, f64::max);
    if largest > 1e-6 { 1.1 * largest } else { 1.0 }
}
