//! The photometric loss of a rendered image and its gradient.
//!
//! The loss is `(1 − λ) · mean |x − y| + λ · mean (1 − SSIM(x, y))`, where x is the rendered image over
//! its background and y the reference image. Every mean is weighted by the reference's fourth byte.
//! Where a disparity is known, `scale · mean |alpha / depth − disparity|` is added. References stay on
//! the device as packed bytes.

use super::render::{PixelBuffers, PixelGradients};
use crate::gpu::{Buffer, Device, Groups, Recorder, Stream};
use crate::kernels::loss::{
    Columns, ColumnsArgs, ColumnsParams, Depth, DepthArgs, DepthParams, Gradient, GradientArgs,
    GradientParams, Ssim, SsimArgs, SsimParams, Total, TotalArgs, TotalParams,
};
use crate::types::Image;
use crate::{Error, Result};

/// The shortest run of pixels that one invocation processes. Beside its own pixels it loads 10 to 20
/// around them; longer runs load less in total, shorter ones occupy the device better.
const LEAST_RUN: usize = 16;
/// Alpha below which a pixel has no depth to compare.
const LEAST_ALPHA: f32 = 0.5;

/// A reference image on the device: packed red, green, blue and weight, one byte each.
pub struct Reference {
    pixels: Buffer<u32>,
    width: u32,
    height: u32,
    weight: f64,
}

/// A known disparity (inverse depth) per pixel, with a weight.
pub struct KnownDisparity {
    values: Buffer<[f32; 2]>,
    weight: f64,
}

impl Reference {
    /// Uploads an RGB image with values in [0, 1], and a weight per pixel in [0, 1] (1 everywhere
    /// without one). Both are rounded to 8 bits.
    ///
    /// # Errors
    /// [`Error::Shape`] when the sizes differ, or a failed upload.
    pub fn new(device: &Device, image: &Image, weights: Option<&Image>) -> Result<Reference> {
        let count = image.width as usize * image.height as usize;
        let shape = |arg, expected: usize, actual| Error::Shape {
            op: "reference",
            arg,
            expected: expected.to_string(),
            actual,
        };
        if image.channels != 3 || image.pixels.len() != 3 * count {
            return Err(shape("image", 3 * count, image.pixels.len()));
        }
        if let Some(weights) = weights
            && weights.pixels.len() != count
        {
            return Err(shape("weights", count, weights.pixels.len()));
        }
        let byte = |value: f32| (value.clamp(0.0, 1.0) * 255.0).round() as u32;
        let mut weight = 0.0;
        let packed: Vec<u32> = image
            .pixels
            .chunks_exact(3)
            .enumerate()
            .map(|(i, rgb)| {
                let w = weights.map_or(255, |weights| byte(weights.pixels[i]));
                weight += f64::from(w) / 255.0;
                byte(rgb[0]) | byte(rgb[1]) << 8 | byte(rgb[2]) << 16 | w << 24
            })
            .collect();
        let pixels = device.upload("reference", &packed)?;
        Ok(Reference { pixels, width: image.width, height: image.height, weight })
    }

    /// The PSNR in dB of a rendered image (premultiplied, 4 channels) over a background against this
    /// reference, with every pixel weighted. Infinite for equal images, `None` where all weights are 0.
    /// Waits for the device.
    ///
    /// # Errors
    /// [`Error::Shape`] for a rendered image of another size, or a failed submission.
    pub fn psnr(
        &self,
        stream: &mut Stream,
        picture: &PixelBuffers,
        background: [f32; 3],
    ) -> Result<Option<f64>> {
        let (reference, picture) =
            (stream.download(&self.pixels)?, stream.download(&picture.rgba)?);
        if reference.len() != picture.len() {
            let (expected, actual) = (reference.len().to_string(), picture.len());
            return Err(Error::Shape { op: "PSNR", arg: "picture", expected, actual });
        }
        let (mut sum, mut weights) = (0.0f64, 0.0f64);
        for (packed, rgba) in reference.iter().zip(&picture) {
            let [r, g, b, weight] = packed.to_le_bytes().map(|byte| f64::from(byte) / 255.0);
            for (c, truth) in [r, g, b].into_iter().enumerate() {
                let shown =
                    f64::from(rgba[c]) + (1.0 - f64::from(rgba[3])) * f64::from(background[c]);
                sum += weight * (shown.clamp(0.0, 1.0) - truth).powi(2);
            }
            weights += 3.0 * weight;
        }
        Ok((weights > 0.0).then(|| -10.0 * (sum / weights).log10()))
    }
}

impl KnownDisparity {
    /// Uploads `[disparity, weight]` per pixel; weight 0 where nothing is known.
    ///
    /// # Errors
    /// A failed upload.
    pub fn new(device: &Device, values: &[[f32; 2]]) -> Result<KnownDisparity> {
        let weight = values.iter().map(|v| f64::from(v[1])).sum();
        Ok(KnownDisparity { values: device.upload("known disparity", values)?, weight })
    }
}

/// The weights of the loss terms, and the background.
#[derive(Clone, Copy, Debug)]
pub struct LossSettings {
    /// λ, the share of D-SSIM.
    pub ssim_share: f32,
    /// Background colour behind the rendered image.
    pub background: [f32; 3],
    /// Factor of the depth term.
    pub depth_scale: f32,
}

impl Default for LossSettings {
    fn default() -> Self {
        LossSettings { ssim_share: 0.2, background: [0.0; 3], depth_scale: 0.0 }
    }
}

/// Inputs and outputs of the loss.
pub struct LossArgs<'a> {
    /// The rendered image.
    pub rendered: &'a PixelBuffers,
    /// The image that it should equal.
    pub reference: &'a Reference,
    /// Known disparity; without it, the gradient with respect to depth is zero.
    pub disparity: Option<&'a KnownDisparity>,
    /// Receives the gradient with respect to the rendered image.
    pub gradients: &'a mut PixelGradients,
}

/// The photometric loss for images of one size.
///
/// ```no_run
/// use splat4d::gpu::{Device, Recorder};
/// use splat4d::ops::loss::{Loss, LossArgs, LossSettings, Reference};
/// use splat4d::ops::render::{PixelBuffers, PixelGradients};
/// use splat4d::types::Image;
/// # fn compare(
/// #     device: &Device, recorder: &mut Recorder, image: &Image, rendered: &PixelBuffers,
/// #     gradients: &mut PixelGradients,
/// # ) -> splat4d::Result<()> {
/// let reference = Reference::new(device, image, None)?;
/// let loss = Loss::plan(device, image.width, image.height);
/// let mut scratch = loss.scratch(device)?;
/// let settings = LossSettings::default();
/// let args = LossArgs { rendered, reference: &reference, disparity: None, gradients };
/// loss.record(recorder, &settings, args, &mut scratch)?;
/// # Ok(())
/// # }
/// ```
#[derive(Clone, Copy, Debug)]
pub struct Loss {
    width: u32,
    height: u32,
    /// Number of invocations that occupy the device.
    occupancy: usize,
}

/// Intermediate buffers of a loss.
pub struct LossScratch {
    /// One buffer per channel: x, y, x² + y², x·y, windowed along columns.
    pub(crate) windowed: [Buffer<[f32; 4]>; 3],
    /// One buffer per channel: derivatives with respect to the windowed x, x², x·y.
    pub(crate) derivatives: [Buffer<[f32; 3]>; 3],
    pub(crate) partials: Buffer<f32>,
    pub(crate) totals: Buffer<f32>,
}

/// The values of the loss terms, before their factors.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LossValue {
    /// Weighted mean of the absolute differences.
    pub l1: f64,
    /// Weighted mean of SSIM.
    pub ssim: f64,
    /// Weighted mean of the disparities' absolute differences; 0 without a depth term.
    pub disparity: f64,
}

impl Loss {
    /// Plans a loss for images of this size, pixels.
    pub fn plan(device: &Device, width: u32, height: u32) -> Loss {
        Loss { width, height, occupancy: device.profile().occupancy }
    }

    fn pixels(&self) -> usize {
        self.width as usize * self.height as usize
    }

    /// Allocates the intermediate buffers of [`record`](Self::record).
    ///
    /// # Errors
    /// [`Error::OutOfMemory`].
    pub fn scratch(&self, device: &Device) -> Result<LossScratch> {
        let pixels = self.pixels();
        let windowed = || device.buffer("windowed", pixels);
        let derivatives = || device.buffer("derivatives of SSIM", pixels);
        let partials = (3 * self.by_rows().1.div_ceil(64)).max(pixels.div_ceil(64));
        Ok(LossScratch {
            windowed: [windowed()?, windowed()?, windowed()?],
            derivatives: [derivatives()?, derivatives()?, derivatives()?],
            partials: device.buffer("loss partials", partials)?,
            totals: device.buffer("loss totals", 3)?,
        })
    }

    /// Number of pixels per run where `lines` lines of `length` pixels are processed. Each line is cut
    /// evenly into as many runs as occupy the device.
    fn run(&self, lines: usize, length: usize) -> usize {
        let runs = self.occupancy.div_ceil(lines.max(1));
        length.div_ceil(runs.min(length.div_ceil(LEAST_RUN)).max(1)).max(1)
    }

    /// Runs along rows, for one channel: pixels in a run, and number of runs.
    fn by_rows(&self) -> (usize, usize) {
        let (rows, length) = (self.height as usize, self.width as usize);
        let run = self.run(3 * rows, length);
        (run, rows * length.div_ceil(run))
    }

    /// Runs along columns, for all channels together: pixels in a run, and number of runs.
    fn by_columns(&self) -> (usize, usize) {
        let (lines, length) = (self.width as usize, self.height as usize);
        let run = self.run(lines, length);
        (run, lines * length.div_ceil(run))
    }

    /// Records the loss, and its gradient with respect to the image. Dispatches: `loss/columns`,
    /// `loss/ssim` for each channel, `loss/total`, `loss/gradient`, `loss/total`; with a disparity
    /// `loss/depth`, `loss/total`.
    ///
    /// # Errors
    /// [`Error::Shape`] when the images' sizes differ; else as for [`Recorder::dispatch`].
    pub fn record(
        &self,
        recorder: &mut Recorder,
        settings: &LossSettings,
        mut args: LossArgs<'_>,
        scratch: &mut LossScratch,
    ) -> Result<()> {
        self.check(&args, scratch)?;
        self.ssim(recorder, settings, &args, scratch)?;
        self.photometric(recorder, settings, &mut args, scratch)?;
        match args.disparity {
            Some(known) => self.disparity(recorder, settings, known, args, scratch),
            None => {
                recorder.fill(args.gradients.depth_mut(), 0);
                Ok(())
            }
        }
    }

    fn check(&self, args: &LossArgs<'_>, scratch: &LossScratch) -> Result<()> {
        for (arg, size) in [
            ("rendered", (args.rendered.width, args.rendered.height)),
            ("reference", (args.reference.width, args.reference.height)),
        ] {
            if size != (self.width, self.height) {
                return Err(Error::Shape {
                    op: "loss",
                    arg,
                    expected: format!("{}×{} pixels", self.width, self.height),
                    actual: (size.0 * size.1) as usize,
                });
            }
        }
        let known = args.disparity.map_or(self.pixels(), |known| known.values.len());
        super::at_least(
            "loss",
            &[
                ("rgba gradients", self.pixels(), args.gradients.rgba.len()),
                ("depth gradients", self.pixels(), args.gradients.depth.len()),
                ("known disparities", self.pixels(), known),
                ("scratch's pixels", self.pixels(), scratch.windowed[0].len()),
            ],
        )
    }

    /// Records SSIM, and its derivatives with respect to the windowed moments.
    fn ssim(
        &self,
        recorder: &mut Recorder,
        settings: &LossSettings,
        LossArgs { rendered, reference, .. }: &LossArgs<'_>,
        scratch: &mut LossScratch,
    ) -> Result<()> {
        let limits = *recorder.device().limits();
        let (width, height) = (self.width as i32, self.height as i32);
        let [background_red, background_green, background_blue] = settings.background;
        let (column_run, by_columns) = self.by_columns();
        let (row_run, by_rows) = self.by_rows();
        let LossScratch { windowed, derivatives, partials, totals } = scratch;
        let [reds, greens, blues] = windowed;
        recorder.dispatch::<Columns>(
            Groups::linear(by_columns, 64, &limits)?,
            ColumnsParams {
                width,
                height,
                run: column_run as i32,
                background_red,
                background_green,
                background_blue,
            },
            ColumnsArgs {
                rgba: rendered.rgba.view(),
                reference: reference.pixels.view(),
                windowed_reds: reds.view_mut(),
                windowed_greens: greens.view_mut(),
                windowed_blues: blues.view_mut(),
            },
        )?;
        let row_groups = by_rows.div_ceil(64);
        for (channel, (windowed, derivatives)) in windowed.iter().zip(&mut *derivatives).enumerate()
        {
            recorder.dispatch::<Ssim>(
                Groups::linear(by_rows, 64, &limits)?,
                SsimParams {
                    width,
                    height,
                    run: row_run as i32,
                    partials_at: (channel * row_groups) as i32,
                },
                SsimArgs {
                    windowed: windowed.view(),
                    reference: reference.pixels.view(),
                    derivatives: derivatives.view_mut(),
                    partials: partials.view_mut(),
                },
            )?;
        }
        total(recorder, partials, 3 * row_groups, totals, 1)
    }

    /// Records L1, and the gradient of L1 and SSIM with respect to the image.
    fn photometric(
        &self,
        recorder: &mut Recorder,
        settings: &LossSettings,
        LossArgs { rendered, reference, gradients, .. }: &mut LossArgs<'_>,
        scratch: &mut LossScratch,
    ) -> Result<()> {
        let limits = *recorder.device().limits();
        let [background_red, background_green, background_blue] = settings.background;
        let (column_run, by_columns) = self.by_columns();
        let LossScratch { derivatives, partials, totals, .. } = scratch;
        let per_weight = share_of(3.0 * reference.weight);
        let share = f64::from(settings.ssim_share);
        recorder.dispatch::<Gradient>(
            Groups::linear(by_columns, 64, &limits)?,
            GradientParams {
                width: self.width as i32,
                height: self.height as i32,
                run: column_run as i32,
                background_red,
                background_green,
                background_blue,
                l1_factor: ((1.0 - share) * per_weight) as f32,
                ssim_factor: (share * per_weight) as f32,
            },
            GradientArgs {
                rgba: rendered.rgba.view(),
                reference: reference.pixels.view(),
                by_reds: derivatives[0].view(),
                by_greens: derivatives[1].view(),
                by_blues: derivatives[2].view(),
                rgba_gradient: gradients.rgba.view_mut(),
                partials: partials.view_mut(),
            },
        )?;
        total(recorder, partials, by_columns.div_ceil(64), totals, 0)
    }

    /// Records the loss of the disparity, and adds its gradient.
    fn disparity(
        &self,
        recorder: &mut Recorder,
        settings: &LossSettings,
        disparity: &KnownDisparity,
        LossArgs { rendered, gradients, .. }: LossArgs<'_>,
        LossScratch { partials, totals, .. }: &mut LossScratch,
    ) -> Result<()> {
        let limits = *recorder.device().limits();
        let pixels = self.pixels();
        let per_weight = share_of(disparity.weight);
        recorder.dispatch::<Depth>(
            Groups::linear(pixels, 64, &limits)?,
            DepthParams {
                pixels: pixels as u32,
                factor: (f64::from(settings.depth_scale) * per_weight) as f32,
                least_alpha: LEAST_ALPHA,
            },
            DepthArgs {
                rgba: rendered.rgba.view(),
                depth: rendered.depth.view(),
                known: disparity.values.view(),
                rgba_gradient: gradients.rgba.view_mut(),
                depth_gradient: gradients.depth.view_mut(),
                partials: partials.view_mut(),
            },
        )?;
        total(recorder, partials, pixels.div_ceil(64), totals, 2)
    }

    /// Waits for the submitted work and reads the last loss recorded with this scratch.
    ///
    /// # Errors
    /// A failed submission.
    pub fn value(
        &self,
        stream: &mut Stream,
        reference: &Reference,
        disparity: Option<&KnownDisparity>,
        scratch: &LossScratch,
    ) -> Result<LossValue> {
        let totals = stream.download(&scratch.totals)?;
        let mean = |total: f32, weight: f64| f64::from(total) * share_of(weight);
        Ok(LossValue {
            l1: mean(totals[0], 3.0 * reference.weight),
            ssim: mean(totals[1], 3.0 * reference.weight),
            disparity: disparity.map_or(0.0, |known| mean(totals[2], known.weight)),
        })
    }
}

/// The factor of a weight of 1 in a mean; 0 where all weights are 0.
fn share_of(weight: f64) -> f64 {
    if weight > 0.0 { 1.0 / weight } else { 0.0 }
}

/// Records the sum of the partial sums of `groups` workgroups.
fn total(
    recorder: &mut Recorder,
    partials: &Buffer<f32>,
    groups: usize,
    totals: &mut Buffer<f32>,
    slot: u32,
) -> Result<()> {
    recorder.dispatch::<Total>(
        Groups([1, 1, 1]),
        TotalParams { count: groups as u32, slot },
        TotalArgs { partials: partials.view(), totals: totals.view_mut() },
    )
}
