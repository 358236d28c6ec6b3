//! Dense optical flow of image pairs in both directions, with confidence.
//!
//! [`FlowEngine`] takes and returns host images; [`Flow`] records into a recorder. Both build a frame's
//! pyramid once, however many pairs the frame is part of.

mod engine;
mod pair;

pub use engine::{FlowEngine, FlowImages};
pub use pair::{FlowArgs, FlowScratch};

use crate::gpu::{Buffer, Device, Groups, Recorder, View};
use crate::kernels::flow::{
    Census, CensusArgs, CensusParams, Derivatives, DerivativesArgs, DerivativesParams, Halve,
    HalveArgs, HalveParams, Luma, LumaArgs, LumaParams,
};
use crate::types::FlowSettings;
use crate::{Error, Result};

/// The workgroup of kernels with an invocation per pixel.
const TILE: [u32; 2] = [16, 4];

/// Dense optical flow between images of one size.
///
/// ```no_run
/// use splat4d::gpu::{Buffer, Device, Recorder};
/// use splat4d::ops::flow::{Flow, FlowArgs};
/// # fn flow(
/// #     device: &Device, recorder: &mut Recorder, images: [&Buffer<f32>; 2], width: u32, height: u32,
/// # ) -> splat4d::Result<()> {
/// let flow = Flow::plan(width, height, &Default::default())?;
/// let (mut first, mut second) = (flow.frame(device)?, flow.frame(device)?);
/// flow.record_frame(recorder, images[0].view(), 3, &mut first)?;
/// flow.record_frame(recorder, images[1].view(), 3, &mut second)?;
///
/// let pixels = (width * height) as usize;
/// let mut there = device.buffer("first to second", pixels)?;
/// let mut back = device.buffer("second to first", pixels)?;
/// let [mut sure, mut sure_back] = [device.buffer("sure", pixels)?, device.buffer("sure", pixels)?];
/// let args = FlowArgs {
///     first: &first,
///     second: &second,
///     guess: None,
///     flow: [there.view_mut(), back.view_mut()],
///     confidence: [sure.view_mut(), sure_back.view_mut()],
/// };
/// flow.record(recorder, args, &mut flow.scratch(device)?)?;
/// # Ok(())
/// # }
/// ```
#[derive(Clone, Debug)]
pub struct Flow {
    settings: FlowSettings,
    /// Width and height of every level, the finest first.
    levels: Vec<[u32; 2]>,
}

/// An image's pyramid on the device.
pub struct FlowFrame {
    levels: Vec<FrameLevel>,
    /// The census transform of the coarsest level.
    census: Buffer<u32>,
}

struct FrameLevel {
    luma: Buffer<f32>,
    derivatives: Buffer<f32>,
}

impl Flow {
    /// Plans the flow between images of `width` × `height` pixels.
    ///
    /// # Errors
    /// [`Error::Input`] for an empty image, one beyond 16,384 pixels a side, or settings out of
    /// their range.
    pub fn plan(width: u32, height: u32, settings: &FlowSettings) -> Result<Flow> {
        if width == 0 || height == 0 || width.max(height) > 16_384 {
            return Err(Error::Input(format!(
                "optical flow of {width}×{height} images: sides must be 1 to 16384 pixels; resize \
                 them first"
            )));
        }
        settings.check()?;
        let mut levels = vec![[width, height]];
        loop {
            let [w, h] = levels[levels.len() - 1];
            let next = [w.div_ceil(2), h.div_ceil(2)];
            if next[0].min(next[1]) < settings.coarsest_side.max(1) || next == [w, h] {
                return Ok(Flow { settings: *settings, levels });
            }
            levels.push(next);
        }
    }

    /// Width and height in pixels.
    pub fn size(&self) -> [u32; 2] {
        self.levels[0]
    }

    /// Allocates the pyramid of one image.
    ///
    /// # Errors
    /// [`Error::OutOfMemory`].
    pub fn frame(&self, device: &Device) -> Result<FlowFrame> {
        let level = |&[w, h]: &[u32; 2]| {
            let n = w as usize * h as usize;
            Ok(FrameLevel {
                luma: device.buffer("flow luminance", n)?,
                derivatives: device.buffer("flow derivatives", 5 * n)?,
            })
        };
        Ok(FlowFrame {
            levels: self.levels.iter().map(level).collect::<Result<_>>()?,
            census: device.buffer("flow census", self.pixels(self.levels.len() - 1))?,
        })
    }

    /// Records the pyramid of an image of `channels` interleaved values per pixel: encoded red, green,
    /// blue in [0, 1] (further channels are ignored), or luminance where there are fewer than three.
    /// Values outside [0, 1] are clamped, NaN becomes 0. Dispatches: `flow/luma`; `flow/halve` for each
    /// level but the first; `flow/derivatives` for each; `flow/census`.
    ///
    /// # Errors
    /// [`Error::Shape`] when `pixels` is too short; else as for [`Recorder::dispatch`].
    pub fn record_frame(
        &self,
        recorder: &mut Recorder,
        pixels: View<'_, f32>,
        channels: u32,
        frame: &mut FlowFrame,
    ) -> Result<()> {
        let needed = self.pixels(0) * channels.max(1) as usize;
        super::at_least("flow", &[("pixels", needed, pixels.len())])?;
        let count = self.pixels(0) as u32;
        let groups = Groups::linear(count as usize, 64, recorder.device().limits())?;
        recorder.dispatch::<Luma>(
            groups,
            LumaParams { count, channels: channels.max(1) },
            LumaArgs { pixels, luma: frame.levels[0].luma.view_mut() },
        )?;
        for l in 1..self.levels.len() {
            let [width, height] = self.levels[l - 1].map(|n| n as i32);
            let (fine, coarse) = frame.levels.split_at_mut(l);
            recorder.dispatch::<Halve>(
                self.pixel_groups(l),
                HalveParams { width, height },
                HalveArgs { luma: fine[l - 1].luma.view(), halved: coarse[0].luma.view_mut() },
            )?;
        }
        for (l, level) in frame.levels.iter_mut().enumerate() {
            let [width, height] = self.levels[l].map(|n| n as i32);
            recorder.dispatch::<Derivatives>(
                self.pixel_groups(l),
                DerivativesParams { width, height },
                DerivativesArgs {
                    luma: level.luma.view(),
                    derivatives: level.derivatives.view_mut(),
                },
            )?;
        }
        let l = self.levels.len() - 1;
        let [width, height] = self.levels[l].map(|n| n as i32);
        recorder.dispatch::<Census>(
            self.pixel_groups(l),
            CensusParams { width, height },
            CensusArgs { luma: frame.levels[l].luma.view(), census: frame.census.view_mut() },
        )
    }

    fn pixels(&self, level: usize) -> usize {
        let [w, h] = self.levels[level];
        w as usize * h as usize
    }

    fn pixel_groups(&self, level: usize) -> Groups {
        let [w, h] = self.levels[level];
        Groups::grid(w, h, TILE)
    }
}
