//! A training step with the caller's own loss.
//!
//! The caller reads the rendered image on the device and supplies the gradient of the loss with respect
//! to it. The optimiser computes the gradients with respect to every parameter and to the camera's pose,
//! and updates the parameters if asked to. Everything is recorded, on a stream or into a command buffer
//! of a host application; the caller may record other work in between.
//!
//! A step is a [`Pass`], which each part takes and gives back in its next stage.
//!
//! ```no_run
//! use splat4d::gpu::Device;
//! use splat4d::train::{SceneOptimiser, TrainSettings, own_loss::OwnGradients};
//! use splat4d::types::{Camera, Gaussians};
//! # fn gradient_of_my_loss(picture: &[[f32; 4]]) -> Vec<[f32; 4]> { picture.to_vec() }
//!
//! fn fit(device: &Device, start: &Gaussians, camera: &Camera) -> splat4d::Result<Gaussians> {
//!     let settings = TrainSettings { steps: 100, ..Default::default() };
//!     let mut scene = SceneOptimiser::new(device, start, None, 1.0, settings)?;
//!     let mut stream = device.stream()?;
//!     for _ in 0..100 {
//!         let mut recorder = stream.record()?;
//!         let pass = scene.forward(&mut recorder, camera, 0.0)?;
//!         stream.submit(recorder)?;
//!         let picture = stream.download(&scene.pixels(&pass)?.rgba)?;
//!         let by_rgba = device.upload("my gradient", &gradient_of_my_loss(&picture))?;
//!
//!         let mut recorder = stream.record()?;
//!         let by = OwnGradients { rgba: by_rgba.view(), depth: None };
//!         let pass = scene.backward(&mut recorder, pass, by)?;
//!         let pass = scene.update(&mut recorder, pass)?;
//!         let ticket = stream.submit(recorder)?;
//!         stream.wait(ticket)?;
//!         scene.conclude(pass)?;
//!     }
//!     scene.gaussians()
//! }
//! ```

use super::scene_optimiser::SceneOptimiser;
use crate::gpu::{Buffer, Readback, Recorder, View};
use crate::ops::gaussians::GaussianBuffers;
use crate::ops::render::{FrameCounts, PixelBuffers, PixelGradientViews};
use crate::types::{Camera, range};
use crate::{Error, Result};
use std::marker::PhantomData;
use std::sync::Arc;

/// A step in progress, at a [`Stage`]. [Conclude](SceneOptimiser::conclude) it when the device has
/// finished what was recorded. To drop it ends the step too, without increasing the capacity or the
/// number of steps.
#[must_use = "`conclude` ends the step"]
pub struct Pass<S> {
    size: (u32, u32),
    counts: Readback<u32>,
    of: Arc<()>,
    stage: PhantomData<S>,
}

/// The part of a step that was recorded last: [`Rendered`], [`Differentiated`] or [`Updated`].
pub trait Stage {
    /// Whether the parameters have been updated.
    const IS_UPDATED: bool;
}

/// The image is rendered.
pub enum Rendered {}

/// The gradients are computed.
pub enum Differentiated {}

/// The parameters are updated.
pub enum Updated {}

impl Stage for Rendered {
    const IS_UPDATED: bool = false;
}

impl Stage for Differentiated {
    const IS_UPDATED: bool = false;
}

impl Stage for Updated {
    const IS_UPDATED: bool = true;
}

impl Pass<Rendered> {
    pub(super) fn new(size: (u32, u32), counts: Readback<u32>, of: Arc<()>) -> Pass<Rendered> {
        Pass { size, counts, of, stage: PhantomData }
    }
}

impl<S> Pass<S> {
    /// The pass in its next stage.
    pub(super) fn reach<T>(self) -> Pass<T> {
        let Pass { size, counts, of, .. } = self;
        Pass { size, counts, of, stage: PhantomData }
    }

    /// Width and height of the image, pixels.
    pub fn size(&self) -> (u32, u32) {
        self.size
    }

    /// The readback of the frame's counts.
    pub(super) fn into_counts(self) -> Readback<u32> {
        self.counts
    }
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

/// The gradients of the caller's loss, on the device.
#[derive(Clone, Copy)]
pub struct SceneGradients<'a> {
    /// With respect to the Gaussians in the canonical frame.
    pub gaussians: &'a GaussianBuffers,
    /// With respect to the camera's pose, for a left perturbation of `view_from_world`: translation,
    /// rotation.
    pub pose: &'a Buffer<f32>,
    /// With respect to the parameters of the paths or the network, and to the logarithms of the control
    /// points' radii. `None` where the scene does not move.
    pub motion: Option<(&'a Buffer<f32>, &'a Buffer<f32>)>,
}

/// Steps with the caller's own loss. Call [`forward`](Self::forward), [`backward`](Self::backward),
/// optionally [`update`](Self::update), and [`conclude`](Self::conclude) when the device has finished.
/// Where a part fails, the step has ended.
impl SceneOptimiser {
    /// Records the render of the scene from `camera` at `time`, in [0, 1]. The dispatches are those of
    /// [`Renderer::record`](crate::renderer::Renderer::record).
    ///
    /// # Errors
    /// [`Error::Input`] while another pass exists, or for a camera or a time out of [range];
    /// [`Error::OutOfMemory`]; else as for [`Recorder::dispatch`].
    pub fn forward(
        &mut self,
        recorder: &mut Recorder,
        camera: &Camera,
        time: f64,
    ) -> Result<Pass<Rendered>> {
        self.check_free()?;
        camera.check().and_then(|()| range::moment(time)).map_err(Error::Input)?;
        self.render(recorder, camera, time)
    }

    /// The rendered image of the step in progress, on the device.
    ///
    /// # Errors
    /// [`Error::Input`] for a pass of another optimiser.
    pub fn pixels<S>(&mut self, pass: &Pass<S>) -> Result<&PixelBuffers> {
        self.check_own(pass)?;
        Ok(&self.frame_pool.for_size(&self.device, pass.size)?.frame.pixels)
    }

    /// Whether the step's frame fits the capacity for (splat, tile) pairs. Valid after the device has
    /// finished [`forward`](Self::forward). If it does not fit, the farthest splats are missing in the
    /// image, and [`conclude`](Self::conclude) raises the capacity.
    ///
    /// # Errors
    /// [`Error::Input`] for a pass of another optimiser, and before the device has finished.
    pub fn fits<S>(&mut self, pass: &mut Pass<S>) -> Result<bool> {
        Ok(self.excess(pass)?.is_none())
    }

    /// The number of (splat, tile) pairs of the step's frame if it exceeds the capacity.
    fn excess<S>(&mut self, pass: &mut Pass<S>) -> Result<Option<usize>> {
        self.check_own(pass)?;
        let mut words = [0; 2];
        pass.counts.read_into(&mut words)?;
        let needed = FrameCounts::from_device(words).intersections;
        let frame = &self.frame_pool.for_size(&self.device, pass.size)?.frame;
        Ok((needed > frame.plan().intersection_capacity()).then_some(needed))
    }

    /// Records the gradients with respect to every parameter and to the camera's pose, from the gradient
    /// with respect to the image. The settings' rigidity term
    /// ([`MotionSettings`](super::MotionSettings)) counts as part of the loss; with a weight of 0 the
    /// gradients are those of the caller's loss alone.
    ///
    /// # Errors
    /// [`Error::Input`] for a pass of another optimiser; [`Error::Shape`] for gradients that are too
    /// short; else as for [`Recorder::dispatch`].
    pub fn backward(
        &mut self,
        recorder: &mut Recorder,
        pass: Pass<Rendered>,
        by: OwnGradients<'_>,
    ) -> Result<Pass<Differentiated>> {
        self.check_own(&pass)?;
        let frame = &mut self.frame_pool.for_size(&self.device, pass.size)?.frame;
        if by.depth.is_none() {
            recorder.fill(frame.gradients.pixels.depth.view_mut(), 0);
        }
        let by = PixelGradientViews { rgba: Some(by.rgba), depth: by.depth };
        self.differentiate(recorder, pass, by, true, None)
    }

    /// The gradients of a step.
    ///
    /// # Errors
    /// [`Error::Input`] for a pass of another optimiser.
    pub fn gradients(&mut self, pass: &Pass<Differentiated>) -> Result<SceneGradients<'_>> {
        self.check_own(pass)?;
        Ok(SceneGradients {
            pose: self.frame_pool.for_size(&self.device, pass.size)?.frame.gradients.pose(),
            gaussians: &self.gradients,
            motion: self.motion.as_ref().map(|motion| motion.gradients()),
        })
    }

    /// The gradients' buffers with respect to the Gaussians, at any time.
    #[cfg(feature = "capi")]
    pub(crate) fn gradient_buffers(&self) -> &GaussianBuffers {
        &self.gradients
    }

    /// The gradient with respect to the camera's pose of a step that has been updated.
    #[cfg(feature = "capi")]
    pub(crate) fn pose_gradient(&mut self, pass: &Pass<Updated>) -> Result<&Buffer<f32>> {
        self.check_own(pass)?;
        Ok(self.frame_pool.for_size(&self.device, pass.size)?.frame.gradients.pose())
    }

    /// Records the update of every parameter by these gradients, with the settings' rates and
    /// regularisers. A frame that did not fit changes nothing.
    ///
    /// # Errors
    /// [`Error::Input`] for a pass of another optimiser; else as for [`Recorder::dispatch`].
    pub fn update(
        &mut self,
        recorder: &mut Recorder,
        pass: Pass<Differentiated>,
    ) -> Result<Pass<Updated>> {
        self.check_own(&pass)?;
        self.learn(recorder, pass)
    }

    /// Ends the step. Call it when the device has finished what was recorded: after
    /// [`Stream::wait`](crate::gpu::Stream::wait) for the submissions, or when the guards of the host's
    /// recordings are dropped. After an update it also does what is due between steps: density control,
    /// control points, lists of dynamic Gaussians. Returns `false` where the frame did not fit: nothing
    /// was learnt, the capacity has been increased, and the step should be repeated.
    ///
    /// # Errors
    /// [`Error::Input`] for a pass of another optimiser, or while the device has not finished (which
    /// [`fits`](Self::fits) tells without ending the step); [`Error::OutOfMemory`],
    /// [`Error::DeviceLost`], or another failed Vulkan call.
    pub fn conclude<S: Stage>(&mut self, mut pass: Pass<S>) -> Result<bool> {
        let excess = self.excess(&mut pass)?;
        let Pass { size, counts, .. } = pass;
        self.idle.push(counts);
        if let Some(needed) = excess {
            self.frame_pool.grow(&self.device, size, needed)?;
            return Ok(false);
        }
        if S::IS_UPDATED {
            self.step += 1;
            self.rounds()?;
        }
        Ok(true)
    }

    /// An error where a pass exists.
    pub(super) fn check_free(&self) -> Result<()> {
        match Arc::strong_count(&self.identity) {
            1 => Ok(()),
            _ => {
                let what = "a step with a loss of your own is in progress: conclude it, or drop \
                            its pass, before the next step";
                Err(Error::Input(what.into()))
            }
        }
    }

    fn check_own<S>(&self, pass: &Pass<S>) -> Result<()> {
        match Arc::ptr_eq(&self.identity, &pass.of) {
            true => Ok(()),
            false => Err(Error::Input("the pass is of another optimiser".into())),
        }
    }
}
