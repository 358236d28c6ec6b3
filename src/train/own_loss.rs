//! A training step with the caller's own loss.
//!
//! The caller gets the rendered picture on the device and hands in the loss's gradient by it; the
//! trainer gives the gradients by every parameter and by the camera's pose, and updates where it is
//! asked to. Everything is recorded, on the trainer's stream, on another, or into a host's command
//! buffer, with whatever the caller records of its own in between.
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

use super::motion::MotionStart;
use super::photographs::Room;
use super::settings::TrainSettings;
use super::trainer::Trainer;
use crate::gpu::{Buffer, Device, Readback, Recorder, View};
use crate::ops::gaussians::GaussianBuffers;
use crate::ops::render::{FrameCounts, PixelBuffers, PixelGradientViews};
use crate::types::{Camera, Gaussians, range};
use crate::{Error, Result};

/// A step under way.
pub(super) struct OwnStep {
    size: (u32, u32),
    counts: Readback<u32>,
    stage: Stage,
}

/// What was recorded last.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Stage {
    Forward,
    Backward,
    Update,
}

/// The gradient of the caller's loss by the picture, pixel after pixel, in any buffers of the device.
#[derive(Clone, Copy)]
pub struct OwnGradients<'a> {
    /// By premultiplied colour and by alpha.
    pub rgba: View<'a, [f32; 4]>,
    /// By depth (Σ α · T · z); `None` where the loss does not read it.
    pub depth: Option<View<'a, f32>>,
}

/// Steps with the caller's own loss: [`forward`](Self::forward), [`backward`](Self::backward),
/// [`update`](Self::update) if the trainer is to learn from it, and when the device is done
/// [`conclude`](Self::conclude).
impl Trainer {
    /// A trainer without pictures of its own, as [`new`](Self::new) makes one with them. `extent` is
    /// the unit of the positions' learning rate and of what density control calls large: about the
    /// distance of the outermost camera from the middle of all.
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
        let room = Room::of(&settings, gaussians.len());
        Trainer::build(device, &[], gaussians, motion, settings, (extent, extent), room)
    }

    /// Records the picture that `camera` sees at `time`. The dispatches are those of
    /// [`Renderer::record`](crate::renderer::Renderer::record).
    ///
    /// # Errors
    /// [`Error::Input`] while another step is under way, or for a camera or a time out of
    /// [range]; [`Error::OutOfMemory`]; else as for [`Recorder::dispatch`].
    pub fn forward(&mut self, recorder: &mut Recorder, camera: &Camera, time: f64) -> Result<()> {
        if self.own.is_some() {
            return Err(out_of_turn("forward", "after `conclude`"));
        }
        camera.check().and_then(|()| range::moment(time)).map_err(Error::Input)?;
        self.finish()?;
        let size = (camera.intrinsics.width, camera.intrinsics.height);
        let studio = self.studios.for_size(&self.device, size)?;
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
        let (scratch, pixels) = (&mut studio.scratch, &mut studio.pixels);
        studio.render.forward(recorder, camera, scene, scratch, pixels)?;
        let counts = match self.idle.pop() {
            Some(readback) => readback,
            None => self.device.readback(2)?,
        };
        recorder.read_back(studio.scratch.device_counts(), &counts);
        self.own = Some(OwnStep { size, counts, stage: Stage::Forward });
        Ok(())
    }

    /// The picture of the step under way, on the device.
    ///
    /// # Errors
    /// [`Error::Input`] outside of a step.
    pub fn pixels(&mut self) -> Result<&PixelBuffers> {
        let size = self.under_way("pixels", &[Stage::Forward, Stage::Backward, Stage::Update])?;
        Ok(&self.studios.for_size(&self.device, size)?.pixels)
    }

    /// Whether the frame of the step under way fitted, when the device is known to be done with
    /// [`forward`](Self::forward). Where it did not, the farthest splats are missing in its picture;
    /// [`conclude`](Self::conclude) then makes more room.
    ///
    /// # Errors
    /// [`Error::Input`] outside of a step, and while the device is not known to be done.
    pub fn fits(&mut self) -> Result<bool> {
        let size = self.under_way("fits", &[Stage::Forward, Stage::Backward, Stage::Update])?;
        let mut words = [0; 2];
        if let Some(own) = &mut self.own {
            own.counts.read_into(&mut words)?;
        }
        let room = self.studios.for_size(&self.device, size)?.render.intersection_capacity();
        Ok(FrameCounts::from_device(words).intersections <= room)
    }

    /// Records the gradients by every parameter and by the camera's pose, given those by the picture.
    /// The settings' rigidity term ([`MotionSettings`](super::MotionSettings)) counts as part of the
    /// loss; with a weight of 0 the gradients are those of the caller's loss alone.
    ///
    /// # Errors
    /// [`Error::Input`] where [`forward`](Self::forward) was not the last; [`Error::Shape`] for
    /// gradients that are too short; else as for [`Recorder::dispatch`].
    pub fn backward(&mut self, recorder: &mut Recorder, by: OwnGradients<'_>) -> Result<()> {
        let size = self.under_way("backward", &[Stage::Forward])?;
        let studio = self.studios.for_size(&self.device, size)?;
        let canonical = self.gaussians.views().at_degree(self.settings.sh_degree_at(self.step));
        let scene = match &self.motion {
            Some(motion) => motion.motion.moved(canonical),
            None => canonical,
        };
        if by.depth.is_none() {
            recorder.fill(studio.pixel_gradients.depth.view_mut(), 0);
        }
        let depth = by.depth.unwrap_or(studio.pixel_gradients.depth.view());
        studio.render.backward_from(
            recorder,
            scene,
            &studio.scratch,
            &studio.pixels,
            PixelGradientViews { rgba: by.rgba, depth },
            &mut studio.backward,
            &mut self.gradients,
            true,
        )?;
        self.gather(recorder, size)?;
        self.reach_stage(Stage::Backward);
        Ok(())
    }

    /// Gradients of the last [`backward`](Self::backward) by the Gaussians in the canonical frame.
    pub fn gradients(&self) -> &GaussianBuffers {
        &self.gradients
    }

    /// That by the camera's pose, for a left perturbation of `view_from_world`: translation,
    /// rotation.
    ///
    /// # Errors
    /// [`Error::Input`] outside of a step.
    pub fn pose_gradient(&mut self) -> Result<&Buffer<f32>> {
        let size = self.under_way("pose gradient", &[Stage::Backward, Stage::Update])?;
        Ok(self.studios.for_size(&self.device, size)?.backward.pose())
    }

    /// Those by the network's parameters and by the logarithms of the control points' radii, where
    /// there is motion.
    pub fn motion_gradients(&self) -> Option<(&Buffer<f32>, &Buffer<f32>)> {
        self.motion.as_ref().map(|motion| motion.gradients())
    }

    /// Records the update of every parameter by these gradients, with the settings' rates and
    /// regularisers. A frame that did not fit changes nothing.
    ///
    /// # Errors
    /// [`Error::Input`] where [`backward`](Self::backward) was not the last; else as for
    /// [`Recorder::dispatch`].
    pub fn update(&mut self, recorder: &mut Recorder) -> Result<()> {
        let size = self.under_way("update", &[Stage::Backward])?;
        self.learn(recorder, size, None)?;
        self.reach_stage(Stage::Update);
        Ok(())
    }

    /// Ends the step when the device is known to be done with what was recorded: after
    /// [`Stream::wait`](crate::gpu::Stream::wait) for the submissions, or when the guards of the host's
    /// recordings are dropped. After an update whatever is due between steps is done then: density control, control
    /// points, lists of who moves. False where the frame did not fit: nothing was learnt, there is
    /// more room now, and the step should be done again.
    ///
    /// # Errors
    /// [`Error::Input`] outside of a step, and earlier than that: the step is still under way then; else
    /// as for [`step`](Self::step).
    pub fn conclude(&mut self) -> Result<bool> {
        let Some(mut own) = self.own.take() else {
            return Err(out_of_turn("conclude", "after `forward`"));
        };
        let mut words = [0; 2];
        if let Err(error) = own.counts.read_into(&mut words) {
            self.own = Some(own);
            return Err(error);
        }
        let OwnStep { size, counts, stage } = own;
        self.idle.push(counts);
        let counts = FrameCounts::from_device(words);
        let studio = self.studios.for_size(&self.device, size)?;
        if counts.intersections > studio.render.intersection_capacity() {
            self.studios.grow(&self.device, size, counts.intersections)?;
            return Ok(false);
        }
        if stage == Stage::Update {
            self.step += 1;
            self.rounds()?;
        }
        Ok(true)
    }

    /// The size of the picture under way, where the last thing recorded is one of these.
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
