//! Optical flow from host images to host images.

use super::{Flow, FlowArgs, FlowFrame, FlowScratch};
use crate::gpu::{Buffer, Device, Stream};
use crate::types::{FlowSettings, Image};
use crate::{Error, Result};

/// Computes the flow of image pairs of one size, waiting for each result.
///
/// ```no_run
/// use splat4d::gpu::{Device, Request};
/// use splat4d::ops::flow::FlowEngine;
/// use splat4d::types::{FlowSettings, Image};
/// # fn main() -> splat4d::Result<()> {
/// # let images = vec![Image::new(320, 180, 3); 3];
/// let device = Device::open(&Request::default())?;
/// let mut engine = FlowEngine::new(&device, 320, 180, &FlowSettings::default())?;
/// let frames: Vec<_> = images.iter().map(|image| engine.frame(image)).collect::<Result<_, _>>()?;
/// let near = engine.pair(&frames[0], &frames[1], None)?;
/// // Twice as far in time: try twice the displacement.
/// let far = engine.pair(&frames[0], &frames[2], Some(&near.scaled(2.0)))?;
/// # Ok(())
/// # }
/// ```
pub struct FlowEngine {
    flow: Flow,
    stream: Stream,
    scratch: FlowScratch,
    pixels: Buffer<f32>,
    /// Flow, guess and confidence, each for the forward and the backward direction.
    flows: [Buffer<[f32; 2]>; 2],
    guesses: [Buffer<[f32; 2]>; 2],
    confidences: [Buffer<f32>; 2],
}

/// Flow of a pair in both directions.
#[derive(Clone, Debug, PartialEq)]
pub struct FlowImages {
    /// From the first image to the second: two channels, u to the right and v down, pixels.
    pub forward: Image,
    /// From the second image to the first.
    pub backward: Image,
    /// Confidence of `forward`: one channel in [0, 1]; 0 where the flow leaves the image.
    pub forward_confidence: Image,
    /// Confidence of `backward`.
    pub backward_confidence: Image,
}

impl FlowImages {
    /// The same with displacements multiplied by `factor`, as a guess for a pair farther apart in time.
    pub fn scaled(&self, factor: f32) -> FlowImages {
        let mut scaled = self.clone();
        for image in [&mut scaled.forward, &mut scaled.backward] {
            image.pixels.iter_mut().for_each(|value| *value *= factor);
        }
        scaled
    }
}

impl FlowEngine {
    /// Creates an engine for images of `width` × `height` pixels.
    ///
    /// # Errors
    /// As for [`Flow::plan`]; [`Error::OutOfMemory`], or a failed Vulkan call.
    pub fn new(
        device: &Device,
        width: u32,
        height: u32,
        settings: &FlowSettings,
    ) -> Result<FlowEngine> {
        let flow = Flow::plan(width, height, settings)?;
        let n = flow.pixels(0);
        let pair = |label: &str| Ok([device.buffer(label, n)?, device.buffer(label, n)?]);
        Ok(FlowEngine {
            stream: device.stream()?,
            scratch: flow.scratch(device)?,
            pixels: device.buffer("flow image", 4 * n)?,
            flows: pair("flow result")?,
            guesses: pair("flow guess")?,
            confidences: [
                device.buffer("flow confidence", n)?,
                device.buffer("flow confidence", n)?,
            ],
            flow,
        })
    }

    /// Builds the pyramid of an image: encoded colours or luminance, as for
    /// [`Flow::record_frame`], of one to four channels.
    ///
    /// # Errors
    /// [`Error::Input`] for an image of another size; [`Error::OutOfMemory`], or a failed
    /// submission.
    pub fn frame(&mut self, image: &Image) -> Result<FlowFrame> {
        self.check("image", image, 1..=4)?;
        let mut frame = self.flow.frame(self.stream.device())?;
        self.stream.upload(&mut self.pixels, &image.pixels)?;
        let mut recorder = self.stream.record()?;
        let pixels = self.pixels.range(0..image.pixels.len());
        self.flow.record_frame(&mut recorder, pixels, image.channels, &mut frame)?;
        self.stream.submit(recorder)?;
        Ok(frame)
    }

    /// Computes the flow between two frames, in both directions. `guess` is tried in addition to the
    /// candidates of the search (its confidences are not used). For large displacements, pass a flow
    /// extrapolated from neighbouring pairs.
    ///
    /// # Errors
    /// [`Error::Input`] for a guess of another size; a failed submission.
    pub fn pair(
        &mut self,
        first: &FlowFrame,
        second: &FlowFrame,
        guess: Option<&FlowImages>,
    ) -> Result<FlowImages> {
        if let Some(guess) = guess {
            for (image, buffer) in [(&guess.forward, 0), (&guess.backward, 1)] {
                self.check("guess", image, 2..=2)?;
                let vectors = bytemuck::cast_slice(&image.pixels);
                self.stream.upload(&mut self.guesses[buffer], vectors)?;
            }
        }
        let [forward, backward] = &mut self.flows;
        let [sure_forward, sure_backward] = &mut self.confidences;
        let mut recorder = self.stream.record()?;
        self.flow.record(
            &mut recorder,
            FlowArgs {
                first,
                second,
                guess: guess.map(|_| [self.guesses[0].view(), self.guesses[1].view()]),
                flow: [forward.view_mut(), backward.view_mut()],
                confidence: [sure_forward.view_mut(), sure_backward.view_mut()],
            },
            &mut self.scratch,
        )?;
        self.stream.submit(recorder)?;
        let [width, height] = self.flow.size();
        let image = |channels, pixels| Image { width, height, channels, pixels };
        Ok(FlowImages {
            forward: image(2, self.stream.download(&self.flows[0])?.into_flattened()),
            backward: image(2, self.stream.download(&self.flows[1])?.into_flattened()),
            forward_confidence: image(1, self.stream.download(&self.confidences[0])?),
            backward_confidence: image(1, self.stream.download(&self.confidences[1])?),
        })
    }

    fn check(
        &self,
        what: &str,
        image: &Image,
        channels: std::ops::RangeInclusive<u32>,
    ) -> Result<()> {
        let [width, height] = self.flow.size();
        let values = width as usize * height as usize * image.channels as usize;
        let fits = [image.width, image.height] == [width, height]
            && channels.contains(&image.channels)
            && image.pixels.len() == values;
        if fits {
            return Ok(());
        }
        Err(Error::Input(format!(
            "optical flow: the {what} is {}×{} with {} channels and {} values; this engine is for \
             {width}×{height} with {} to {} channels",
            image.width,
            image.height,
            image.channels,
            image.pixels.len(),
            channels.start(),
            channels.end()
        )))
    }
}
