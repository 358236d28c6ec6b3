//! The backward pass: from the gradient with respect to an image to the gradients with respect to the
//! Gaussians and the camera.

use super::{PixelBuffers, Render, RenderScratch};
use crate::gpu::{Buffer, Device, Groups, Kernel, Profile, Recorder, View, ViewMut};
use crate::kernels::{project, raster};
use crate::ops::at_least;
use crate::ops::gaussians::{GaussianBuffers, GaussianViews};
use crate::{Error, Result};

/// Intermediate buffers of the backward pass.
pub struct BackwardScratch {
    pub(crate) slots_a: Buffer<[f32; 4]>,
    pub(crate) slots_b: Buffer<[f32; 4]>,
    pub(crate) slots_c: Buffer<[f32; 2]>,
    pub(crate) means: Buffer<[f32; 4]>,
    pub(crate) covariances: Buffer<[f32; 4]>,
    pub(crate) colours: Buffer<[f32; 4]>,
    pub(crate) pose_partials: Buffer<f32>,
    pub(crate) pose: Buffer<f32>,
}

/// The gradient of a loss with respect to a rendered image.
pub struct PixelGradients {
    /// With respect to premultiplied colour and alpha.
    pub rgba: Buffer<[f32; 4]>,
    /// With respect to depth.
    pub depth: Buffer<f32>,
}

impl Render {
    /// Allocates the intermediate buffers of [`backward`](Self::backward).
    ///
    /// # Errors
    /// [`Error::OutOfMemory`].
    pub fn backward_scratch(&self, device: &Device) -> Result<BackwardScratch> {
        let (n, m) = (self.gaussians, self.intersections);
        Ok(BackwardScratch {
            slots_a: device.buffer("gradient slots a", m)?,
            slots_b: device.buffer("gradient slots b", m)?,
            slots_c: device.buffer("gradient slots c", m)?,
            means: device.buffer("mean gradients", n)?,
            covariances: device.buffer("covariance gradients", n)?,
            colours: device.buffer("colour gradients", n)?,
            pose_partials: device.buffer("pose partials", 8 * n.div_ceil(64))?,
            pose: device.buffer("pose gradient", 6)?,
        })
    }

    /// Allocates the gradient with respect to an image of this renderer's size.
    ///
    /// # Errors
    /// [`Error::OutOfMemory`].
    pub fn pixel_gradients(&self, device: &Device) -> Result<PixelGradients> {
        let pixels = self.width as usize * self.height as usize;
        Ok(PixelGradients {
            rgba: device.buffer("rgba gradient", pixels)?,
            depth: device.buffer("depth gradient", pixels)?,
        })
    }

    /// Records the gradients of a loss with respect to every parameter. Their input is the gradient with
    /// respect to the image that [`forward`](Self::forward) has just rendered with the same camera,
    /// Gaussians and scratch. Dispatches: `raster/backward`, `raster/gather`, `project/backward`, and
    /// with a pose `project/pose`.
    ///
    /// Culled Gaussians get zeros. `with_pose` adds the gradient with respect to a left perturbation of
    /// `view_from_world` (translation, rotation): [`BackwardScratch::pose`].
    ///
    /// # Errors
    /// [`Error::Shape`] when `gradients` is too small; else as for [`Recorder::dispatch`].
    pub fn backward(
        &self,
        recorder: &mut Recorder,
        gaussians: GaussianViews<'_>,
        scratch: &RenderScratch,
        pixels: &PixelBuffers,
        pixel_gradients: &PixelGradients,
        backward: &mut BackwardScratch,
        gradients: &mut GaussianBuffers,
        with_pose: bool,
    ) -> Result<()> {
        let given = pixel_gradients.views();
        self.backward_from(
            recorder, gaussians, scratch, pixels, given, backward, gradients, with_pose,
        )
    }

    /// As [`backward`](Self::backward), with image gradients in arbitrary buffers.
    ///
    /// # Errors
    /// As for [`backward`](Self::backward).
    pub fn backward_from(
        &self,
        recorder: &mut Recorder,
        gaussians: GaussianViews<'_>,
        scratch: &RenderScratch,
        pixels: &PixelBuffers,
        pixel_gradients: PixelGradientViews<'_>,
        backward: &mut BackwardScratch,
        gradients: &mut GaussianBuffers,
        with_pose: bool,
    ) -> Result<()> {
        gaussians.check("render backward")?;
        if gaussians.is_half() {
            let what = "gradients need every attribute in f32; 16 bits are for rendering";
            return Err(Error::Input(what.into()));
        }
        gradients.len = gaussians.len;
        gradients.views().at_degree(gaussians.sh_degree).check("render backward gradients")?;
        let colours = scratch.colours.view();
        let n = gaussians.len;
        let given = pixel_gradients;
        self.blend_backward_from(recorder, colours, n, scratch, pixels, given, backward)?;
        let groups = Groups::linear(gaussians.len, 64, recorder.device().limits())?;
        let (s, b) = (scratch, backward);
        let [sh0, sh1, sh2, sh3] = gradients.sh.each_mut().map(Buffer::view_mut);
        let [band1, band2, band3] = gaussians.bands();
        recorder.dispatch_specialised::<project::Backward>(
            project::BackwardConstants { band1, band2, band3, with_pose },
            groups,
            project::BackwardParams {
                count: gaussians.len as u32,
                width: self.width,
                height: self.height,
                near: self.settings.near,
                dilation: self.settings.dilation,
                tangent_clamp: self.settings.tangent_clamp,
            },
            project::BackwardArgs {
                camera: s.camera.view(),
                positions: gaussians.positions,
                log_scales: gaussians.log_scales,
                rotations: gaussians.rotations,
                sh1: gaussians.sh[1],
                sh2: gaussians.sh[2],
                sh3: gaussians.sh[3],
                visible: s.visible.view(),
                opacity_logits: gaussians.opacity_logits,
                colours: s.colours.view(),
                mean_gradients: b.means.view(),
                covariance_gradients: b.covariances.view(),
                colour_gradients: b.colours.view(),
                position_gradients: gradients.positions.view_mut(),
                log_scale_gradients: gradients.log_scales.view_mut(),
                rotation_gradients: gradients.rotations.view_mut(),
                opacity_gradients: gradients.opacity_logits.view_mut(),
                sh0_gradients: sh0,
                sh1_gradients: sh1,
                sh2_gradients: sh2,
                sh3_gradients: sh3,
                pose_partials: b.pose_partials.view_mut(),
            },
        )?;
        if !with_pose {
            return Ok(());
        }
        recorder.dispatch::<project::Pose>(
            Groups([1, 1, 1]),
            project::PoseParams { groups: gaussians.len.div_ceil(64) as u32 },
            project::PoseArgs { pose_partials: b.pose_partials.view(), pose: b.pose.view_mut() },
        )
    }

    /// Records the gradients of a loss with respect to the projected splats and their colours, for the
    /// first `count` Gaussians. Their input is the gradient with respect to the image that
    /// [`blend`](Self::blend) (or [`forward`](Self::forward)) has rendered with these colours. The
    /// results are [`BackwardScratch::colour_gradients`] and [`BackwardScratch::mean_gradients`].
    ///
    /// # Errors
    /// As for [`backward`](Self::backward).
    pub fn blend_backward(
        &self,
        recorder: &mut Recorder,
        colours: View<'_, [f32; 4]>,
        count: usize,
        scratch: &RenderScratch,
        pixels: &PixelBuffers,
        pixel_gradients: &PixelGradients,
        backward: &mut BackwardScratch,
    ) -> Result<()> {
        let given = pixel_gradients.views();
        self.blend_backward_from(recorder, colours, count, scratch, pixels, given, backward)
    }

    fn blend_backward_from(
        &self,
        recorder: &mut Recorder,
        colours: View<'_, [f32; 4]>,
        count: usize,
        scratch: &RenderScratch,
        pixels: &PixelBuffers,
        pixel_gradients: PixelGradientViews<'_>,
        backward: &mut BackwardScratch,
    ) -> Result<()> {
        self.check_scratch(scratch)?;
        self.check_size("render backward", pixels.width, pixels.height)?;
        let area = self.width as usize * self.height as usize;
        at_least(
            "render backward",
            &[
                ("Gaussians of the scratch", count, backward.means.len()),
                ("intersections of the scratch", self.intersections, backward.slots_a.len()),
                ("rgba gradients", area, pixel_gradients.rgba.len()),
                ("depth gradients", area, pixel_gradients.depth.len()),
            ],
        )?;
        let limits = *recorder.device().limits();
        let groups = Groups::linear(count, 64, &limits)?;
        let (s, b) = (scratch, backward);
        let tiles = self.tile_groups(recorder.device())?;
        let params = raster::BackwardParams {
            width: self.width,
            height: self.height,
            alpha_cut: self.settings.alpha_cut,
            alpha_cap: self.settings.alpha_cap,
        };
        let args = raster::BackwardArgs {
            ranges: s.ranges.view(),
            emitted_from_sorted: s.emitted_from_sorted.view(),
            splat_from_emitted: s.splat_from_emitted.view(),
            means: s.means.view(),
            conics: s.conics.view(),
            colours,
            rgba: pixels.rgba.view(),
            depth: pixels.depth.view(),
            last: pixels.last.view(),
            rgba_gradient: pixel_gradients.rgba,
            depth_gradient: pixel_gradients.depth,
            slots_a: b.slots_a.view_mut(),
            slots_b: b.slots_b.view_mut(),
            slots_c: b.slots_c.view_mut(),
        };
        let Profile { shuffles, spread, narrow_tiles, .. } = self.profile;
        let constants = raster::BackwardConstants { shuffles, several: true, spread };
        if narrow_tiles {
            let several = self.subgroup_size < raster::BackwardNarrow::WORKGROUP[0];
            let constants = raster::BackwardConstants { several, ..constants };
            recorder
                .dispatch_specialised::<raster::BackwardNarrow>(constants, tiles, params, args)?;
        } else {
            recorder.dispatch_specialised::<raster::Backward>(constants, tiles, params, args)?;
        }
        recorder.dispatch_specialised::<raster::Gather>(
            raster::GatherConstants { spread: self.profile.spread },
            groups,
            raster::GatherParams { count: count as u32, capacity: self.intersections as u32 },
            raster::GatherArgs {
                visible_count: s.visible_count.view(),
                splat_from_rank: s.splat_from_rank.view(),
                counts: s.rank_counts.view(),
                offsets: s.rank_offsets.view(),
                slots_a: b.slots_a.view(),
                slots_b: b.slots_b.view(),
                slots_c: b.slots_c.view(),
                means: s.means.view(),
                conics: s.conics.view(),
                mean_gradients: b.means.view_mut(),
                covariance_gradients: b.covariances.view_mut(),
                colour_gradients: b.colours.view_mut(),
            },
        )
    }
}

impl BackwardScratch {
    /// The gradient with respect to the camera's pose: translation, rotation (6 values).
    pub fn pose(&self) -> &Buffer<f32> {
        &self.pose
    }

    /// Gradients of the last frame with respect to the projected splats: mean x, mean y (pixels), depth,
    /// opacity. Values of culled Gaussians are undefined.
    pub fn mean_gradients(&self) -> View<'_, [f32; 4]> {
        self.means.view()
    }

    /// Gradients of the last frame with respect to the colours of the first `count` Gaussians: red,
    /// green, blue, unused. Values of culled Gaussians are undefined.
    pub fn colour_gradients(&self, count: usize) -> View<'_, [f32; 4]> {
        self.colours.range(0..count)
    }
}

/// The gradient of a loss with respect to a rendered image, in pixel order (row by row), as views of
/// arbitrary buffers, including those of a host application.
#[derive(Clone, Copy)]
pub struct PixelGradientViews<'a> {
    /// With respect to premultiplied colour and alpha.
    pub rgba: View<'a, [f32; 4]>,
    /// With respect to depth.
    pub depth: View<'a, f32>,
}

impl PixelGradients {
    /// Read-only views of all of it.
    pub fn views(&self) -> PixelGradientViews<'_> {
        PixelGradientViews { rgba: self.rgba.view(), depth: self.depth.view() }
    }

    /// The gradient with respect to depth. A loss without a depth term fills it with zeros.
    pub fn depth_mut(&mut self) -> ViewMut<'_, f32> {
        self.depth.view_mut()
    }
}
