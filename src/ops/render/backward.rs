//! The backward pass: from the gradient with respect to an image to the gradients with respect to the
//! Gaussians and the camera.

use super::{Frame, Render};
use crate::gpu::{Buffer, Device, Groups, Kernel, Profile, Recorder, View, ViewMut};
use crate::kernels::{project, raster};
use crate::ops::at_least;
use crate::ops::gaussians::{GaussianBuffers, GaussianViews};
use crate::{Error, Result};

/// The buffers of a frame's backward pass: its input, and the gradients with respect to the splats and
/// the pose.
pub struct FrameGradients {
    /// The loss's gradient with respect to the image.
    pub pixels: PixelGradients,
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
    /// Allocates a frame that can be differentiated.
    ///
    /// # Errors
    /// [`Error::OutOfMemory`].
    pub fn differentiable(&self, device: &Device) -> Result<Frame<FrameGradients>> {
        let (n, m) = (self.gaussians, self.intersections);
        let gradients = FrameGradients {
            pixels: self.pixel_gradients(device)?,
            slots_a: device.buffer("gradient slots a", m)?,
            slots_b: device.buffer("gradient slots b", m)?,
            slots_c: device.buffer("gradient slots c", m)?,
            means: device.buffer("mean gradients", n)?,
            covariances: device.buffer("covariance gradients", n)?,
            colours: device.buffer("colour gradients", n)?,
            pose_partials: device.buffer("pose partials", 8 * n.div_ceil(64))?,
            pose: device.buffer("pose gradient", 6)?,
        };
        let Frame { plan, scratch, pixels, gradients: () } = self.frame(device)?;
        Ok(Frame { plan, scratch, pixels, gradients })
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
}

impl Frame<FrameGradients> {
    /// Records the gradients of a loss with respect to every parameter. Their input is the gradient with
    /// respect to the image that [`forward`](Self::forward) has just rendered from the same Gaussians into
    /// the frame's own pixels. Dispatches: those of [`blend_backward`](Self::blend_backward),
    /// `project/backward`, and with a pose `project/pose`.
    ///
    /// Culled Gaussians get zeros. `with_pose` adds the gradient with respect to a left perturbation of
    /// `view_from_world` (translation, rotation): [`FrameGradients::pose`].
    ///
    /// # Errors
    /// [`Error::Shape`] when `gradients` is too small; else as for [`Recorder::dispatch`].
    pub fn backward(
        &mut self,
        recorder: &mut Recorder,
        gaussians: GaussianViews<'_>,
        by: PixelGradientViews<'_>,
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
        self.blend_backward(recorder, None, gaussians.len, by)?;
        let Frame { plan, scratch: s, gradients: b, .. } = self;
        let groups = Groups::linear(gaussians.len, 64, recorder.device().limits())?;
        let [sh0, sh1, sh2, sh3] = gradients.sh.each_mut().map(Buffer::view_mut);
        let [band1, band2, band3] = gaussians.bands();
        recorder.dispatch_specialised::<project::Backward>(
            project::BackwardConstants { band1, band2, band3, with_pose },
            groups,
            project::BackwardParams {
                count: gaussians.len as u32,
                width: plan.width,
                height: plan.height,
                near: plan.settings.near,
                dilation: plan.settings.dilation,
                tangent_clamp: plan.settings.tangent_clamp,
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
    /// [`blend`](Self::blend) has rendered into the frame's own pixels with these colours. The results
    /// are [`FrameGradients::colours`] and [`FrameGradients::means`]. Dispatches: `raster/backward` or
    /// `raster/backward_narrow`, `raster/gather`.
    ///
    /// # Errors
    /// As for [`backward`](Self::backward).
    pub fn blend_backward(
        &mut self,
        recorder: &mut Recorder,
        colours: Option<View<'_, [f32; 4]>>,
        count: usize,
        by: PixelGradientViews<'_>,
    ) -> Result<()> {
        let Frame { plan, scratch: s, pixels, gradients: b } = self;
        plan.check_count(count)?;
        let area = plan.width as usize * plan.height as usize;
        let rgba_gradient = by.rgba.unwrap_or(b.pixels.rgba.view());
        let depth_gradient = by.depth.unwrap_or(b.pixels.depth.view());
        at_least(
            "render backward",
            &[
                ("rgba", area, pixels.rgba.len()),
                ("depth", area, pixels.depth.len()),
                ("rgba gradients", area, rgba_gradient.len()),
                ("depth gradients", area, depth_gradient.len()),
            ],
        )?;
        let limits = *recorder.device().limits();
        let groups = Groups::linear(count, 64, &limits)?;
        let tiles = plan.tile_groups(recorder.device())?;
        let params = raster::BackwardParams {
            width: plan.width,
            height: plan.height,
            alpha_cut: plan.settings.alpha_cut,
            alpha_cap: plan.settings.alpha_cap,
        };
        let args = raster::BackwardArgs {
            ranges: s.ranges.view(),
            emitted_from_sorted: s.emitted_from_sorted.view(),
            splat_from_emitted: s.splat_from_emitted.view(),
            means: s.means.view(),
            conics: s.conics.view(),
            colours: colours.unwrap_or(s.colours.view()),
            rgba: pixels.rgba.view(),
            depth: pixels.depth.view(),
            last: pixels.last.view(),
            rgba_gradient,
            depth_gradient,
            slots_a: b.slots_a.view_mut(),
            slots_b: b.slots_b.view_mut(),
            slots_c: b.slots_c.view_mut(),
        };
        let Profile { shuffles, spread, narrow_tiles, .. } = plan.profile;
        let constants = raster::BackwardConstants { shuffles, several: true, spread };
        if narrow_tiles {
            let several = plan.subgroup_size < raster::BackwardNarrow::WORKGROUP[0];
            let constants = raster::BackwardConstants { several, ..constants };
            recorder
                .dispatch_specialised::<raster::BackwardNarrow>(constants, tiles, params, args)?;
        } else {
            recorder.dispatch_specialised::<raster::Backward>(constants, tiles, params, args)?;
        }
        recorder.dispatch_specialised::<raster::Gather>(
            raster::GatherConstants { spread: plan.profile.spread },
            groups,
            raster::GatherParams { count: count as u32, capacity: plan.intersections as u32 },
            raster::GatherArgs {
                visible_count: s.visible_count.view(),
                splat_from_rank: s.splat_from_rank.view(),
                counts: s.rank_counts.view(),
                emitted_from_rank: s.emitted_from_rank.view(),
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

impl FrameGradients {
    /// The gradient with respect to the camera's pose: translation, rotation (6 values).
    pub fn pose(&self) -> &Buffer<f32> {
        &self.pose
    }

    /// Gradients of the last frame with respect to the projected splats: mean x, mean y (pixels), depth,
    /// opacity. Values of culled Gaussians are undefined.
    pub fn means(&self) -> View<'_, [f32; 4]> {
        self.means.view()
    }

    /// Gradients of the last frame with respect to the colours of the first `count` Gaussians: red,
    /// green, blue, unused. Values of culled Gaussians are undefined.
    pub fn colours(&self, count: usize) -> View<'_, [f32; 4]> {
        self.colours.range(0..count)
    }
}

/// The gradient of a loss with respect to a rendered image, in pixel order (row by row), as views of
/// arbitrary buffers, including those of a host application. A part that is `None` is read from the
/// frame's own [`FrameGradients::pixels`].
#[derive(Clone, Copy, Default)]
pub struct PixelGradientViews<'a> {
    /// With respect to premultiplied colour and alpha.
    pub rgba: Option<View<'a, [f32; 4]>>,
    /// With respect to depth.
    pub depth: Option<View<'a, f32>>,
}

impl PixelGradients {
    /// Read-only views of all of it.
    pub fn views(&self) -> PixelGradientViews<'_> {
        PixelGradientViews { rgba: Some(self.rgba.view()), depth: Some(self.depth.view()) }
    }

    /// The gradient with respect to depth. A loss without a depth term fills it with zeros.
    pub fn depth_mut(&mut self) -> ViewMut<'_, f32> {
        self.depth.view_mut()
    }
}
