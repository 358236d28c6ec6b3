//! A training step with the caller's own loss.
//!
//! The caller reads the rendered image on the device and supplies the gradient of the loss with respect
//! to it. The trainer computes the gradients with respect to every parameter and to the camera's pose,
//! and updates the parameters if asked to. Everything is recorded, on the trainer's stream, on another,
//! or into a command buffer of a host application; the caller may record other work in between.
//!
//! ```no_run
//! use splat4d::gpu::Device;
//! use splat4d::train::{TrainSettings, Trainer, own_loss::OwnGradients};
//! use splat4d::types::{Camera, Gaussians};
//! # fn gradient_of_my_loss(picture: &[[f32; 4]]) -> Vec<[f32; 4]> { picture.to_vec() }
//!
//! fn fit(device: &Device, start: &Gaussians, camera: &Camera) -> splat4d::Result<Gaussians> {
//!     let settings = TrainSettings { steps: 100, ..Default::default() };
//!     let mut trainer = Trainer::without_pictures(device, start, None, 1.0, settings)?;
//!     let mut stream = device.stream()?;
//!     for _ in 0..100 {
//!         let mut recorder = stream.record()?;
//!         trainer.forward(&mut recorder, camera, 0.0)?;
//!         stream.submit(recorder)?;
//!         let picture = stream.download(&trainer.pixels()?.rgba)?;
//!         let by_rgba = device.upload("my gradient", &gradient_of_my_loss(&picture))?;
//!
//!         let mut recorder = stream.record()?;
//!         trainer.backward(&mut recorder, OwnGradients { rgba: by_rgba.view(), depth: None })?;
//!         trainer.update(&mut recorder)?;
//!         let ticket = stream.submit(recorder)?;
//!         stream.wait(ticket)?;
//!         trainer.conclude()?;
//!     }
//!     trainer.gaussians()
//! }
//! ```

use super::frame_pool::Capacity;
use super::motion::MotionStart;
use super::settings::TrainSettings;
use super::trainer::Trainer;
use crate::gpu::{Buffer, Device, Readback, Recorder, View};
use crate::ops::gaussians::GaussianBuffers;
use crate::ops::render::{FrameCounts, PixelBuffers, PixelGradientViews, PixelViews};
use crate::types::{Camera, Gaussians, range};
use crate::{Error, Result};

/// A step in progress.
pub(super) struct OwnStep {
    size: (u32, u32),
    counts: Readback<u32>,
    stage: Stage,
}

/// The part of the step that was recorded last.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Stage {
    Forward,
    Backward,
    Update,
}

/// The gradient of the caller's loss with respect to the image, in pixel order (row by row), in
/// arbitrary buffers of the device.
#[derive(Clone, Copy)]
pub struct OwnGradients<'a> {
    /// With respect to premultiplied colour and alpha.
    pub rgba: View<'a, [f32; 4]>,
    /// With respect to depth (Σ α · T · z); `None` where the loss does not read it.
    pub depth: Option<View<'a, f32>>,
}

/// Steps with the caller's own loss. Call [`forward`](Self::forward), [`backward`](Self::backward),
/// optionally [`update`](Self::update), and [`conclude`](Self::conclude) when the device has finished.
impl Trainer {
    /// Creates a trainer without training views; otherwise as [`new`](Self::new). `extent` is the unit
    /// of the positions' learning rate and of density control's scale limits: about the distance of the
    /// outermost camera from the cameras' mean, world units.
    ///
    /// # Errors
    /// [`Error::Input`] without Gaussians or for an extent that is not positive; else as for `new`.
    pub fn without_pictures(
        device: &Device,
        gaussians: &Gaussians,
        motion: Option<&MotionStart>,
        extent: f64,
        settings: TrainSettings,
    ) -> Result<Trainer> {
        if !(extent > 0.0 && extent <= f64::from(range::REACH)) {
            let most = range::REACH;
            let what =
                format!("a scene of extent {extent:?}: it must be positive, at most {most:e}");
            return Err(Error::Input(what));
        }
        let capacity = Capacity::of(&settings, gaussians.len());
        Trainer::build(device, &[], gaussians, motion, settings, (extent, extent), capacity)
    }

    /// Records the render of the scene from `camera` at `time`, in [0, 1]. The dispatches are those of
    /// [`Renderer::record`](crate::renderer::Renderer::record).
    ///
    /// # Errors
    /// [`Error::Input`] while another step is in progress, or for a camera or a time out of [range];
    /// [`Error::OutOfMemory`]; else as for [`Recorder::dispatch`].
    pub fn forward(&mut self, recorder: &mut Recorder, camera: &Camera, time: f64) -> Result<()> {
        if self.own.is_some() {
            return Err(out_of_turn("forward", "after `conclude`"));
        }
        camera.check().and_then(|()| range::moment(time)).map_err(Error::Input)?;
        self.finish()?;
        let size = (camera.intrinsics.width, camera.intrinsics.height);
        let resources = self.frame_pool.for_size(&self.device, size)?;
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
        resources.frame.forward(recorder, camera, scene, PixelViews::default())?;
        let counts = match self.idle.pop() {
            Some(readback) => readback,
            None => self.device.readback(2)?,
        };
        recorder.read_back(resources.frame.device_counts(), &counts);
        self.own = Some(OwnStep { size, counts, stage: Stage::Forward });
        Ok(())
    }

    /// The rendered image of the step in progress, on the device.
    ///
    /// # Errors
    /// [`Error::Input`] outside of a step.
    pub fn pixels(&mut self) -> Result<&PixelBuffers> {
        let size = self.under_way("pixels", &[Stage::Forward, Stage::Backward, Stage::Update])?;
        Ok(&self.frame_pool.for_size(&self.device, size)?.frame.pixels)
    }

    /// Whether the current step's frame fits the capacity for (splat, tile) pairs. Valid after the device has
    /// finished [`forward`](Self::forward). If it does not fit, the farthest splats are missing in the image, and
    /// [`conclude`](Self::conclude) raises the capacity.
    ///
    /// # Errors
    /// [`Error::Input`] outside of a step, and before the device has finished.
    pub fn fits(&mut self) -> Result<bool> {
        self.under_way("fits", &[Stage::Forward, Stage::Backward, Stage::Update])?;
        Ok(self.excess()?.is_none())
    }

    /// The number of (splat, tile) pairs of the current step's frame if it exceeds the capacity.
    fn excess(&mut self) -> Result<Option<usize>> {
        let Some(own) = &mut self.own else { return Ok(None) };
        let mut words = [0; 2];
        own.counts.read_into(&mut words)?;
        let needed = FrameCounts::from_device(words).intersections;
        let resources = self.frame_pool.for_size(&self.device, own.size)?;
        Ok((needed > resources.frame.plan().intersection_capacity()).then_some(needed))
    }

    /// Records the gradients with respect to every parameter and to the camera's pose, from the gradient
    /// with respect to the image. The settings' rigidity term
    /// ([`MotionSettings`](super::MotionSettings)) counts as part of the loss; with a weight of 0 the
    /// gradients are those of the caller's loss alone.
    ///
    /// # Errors
    /// [`Error::Input`] unless [`forward`](Self::forward) was the last part recorded; [`Error::Shape`]
    /// for gradients that are too short; else as for [`Recorder::dispatch`].
    pub fn backward(&mut self, recorder: &mut Recorder, by: OwnGradients<'_>) -> Result<()> {
        let size = self.under_way("backward", &[Stage::Forward])?;
        let resources = self.frame_pool.for_size(&self.device, size)?;
        let canonical = self.gaussians.views().at_degree(self.settings.sh_degree_at(self.step));
        let scene = match &self.motion {
            Some(motion) => motion.motion.moved(canonical),
            None => canonical,
        };
        if by.depth.is_none() {
            recorder.fill(resources.frame.gradients.pixels.depth.view_mut(), 0);
        }
        let by = PixelGradientViews { rgba: Some(by.rgba), depth: by.depth };
        resources.frame.backward(recorder, scene, by, &mut self.gradients, true)?;
        self.gather(recorder, size)?;
        self.reach_stage(Stage::Backward);
        Ok(())
    }

    /// The gradients of the last [`backward`](Self::backward) with respect to the Gaussians in the
    /// canonical frame.
    pub fn gradients(&self) -> &GaussianBuffers {
        &self.gradients
    }

    /// The gradient with respect to the camera's pose, for a left perturbation of `view_from_world`:
    /// translation, rotation.
    ///
    /// # Errors
    /// [`Error::Input`] outside of a step.
    pub fn pose_gradient(&mut self) -> Result<&Buffer<f32>> {
        let size = self.under_way("pose gradient", &[Stage::Backward, Stage::Update])?;
        Ok(self.frame_pool.for_size(&self.device, size)?.frame.gradients.pose())
    }

    /// The gradients with respect to the parameters of the paths or the network, and to the logarithms
    /// of the control points' radii. `None` where the scene does not move.
    pub fn motion_gradients(&self) -> Option<(&Buffer<f32>, &Buffer<f32>)> {
        self.motion.as_ref().map(|motion| motion.gradients())
    }

    /// Records the update of every parameter by these gradients, with the settings' rates and
    /// regularisers. A frame that did not fit changes nothing.
    ///
    /// # Errors
    /// [`Error::Input`] unless [`backward`](Self::backward) was the last part recorded; else as for
    /// [`Recorder::dispatch`].
    pub fn update(&mut self, recorder: &mut Recorder) -> Result<()> {
        let size = self.under_way("update", &[Stage::Backward])?;
        self.learn(recorder, size, None)?;
        self.reach_stage(Stage::Update);
        Ok(())
    }

    /// Ends the step. Call it when the device has finished what was recorded: after
    /// [`Stream::wait`](crate::gpu::Stream::wait) for the submissions, or when the guards of the host's
    /// recordings are dropped. After an update it also does what is due between steps: density control,
    /// control points, lists of dynamic Gaussians. Returns `false` where the frame did not fit: nothing
    /// was learnt, the capacity has been increased, and the step should be repeated.
    ///
    /// # Errors
    /// [`Error::Input`] outside of a step, or while the device has not finished, in which case the step
    /// stays in progress; else as for [`step`](Self::step).
    pub fn conclude(&mut self) -> Result<bool> {
        let excess = self.excess()?;
        let Some(OwnStep { size, counts, stage }) = self.own.take() else {
            return Err(out_of_turn("conclude", "after `forward`"));
        };
        self.idle.push(counts);
        if let Some(needed) = excess {
            self.frame_pool.grow(&self.device, size, needed)?;
            return Ok(false);
        }
        if stage == Stage::Update {
            self.step += 1;
            self.rounds()?;
        }
        Ok(true)
    }

    /// The image size of the step in progress, if the part recorded last is one of these stages.
    fn under_way(&self, what: &'static str, stages: &[Stage]) -> Result<(u32, u32)> {
        match &self.own {
            Some(own) if stages.contains(&own.stage) => Ok(own.size),
            _ => Err(out_of_turn(what, "in the order forward, backward, update, conclude")),
        }
    }

    fn reach_stage(&mut self, stage: Stage) {
        if let Some(own) = &mut self.own {
            own.stage = stage;
        }
    }
}

fn out_of_turn(what: &str, when: &str) -> Error {
    Error::Input(format!("a step with a loss of your own: `{what}` comes {when}"))
}
