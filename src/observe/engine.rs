//! Optical flow computed by the engine.

use super::flow::{FlowPair, FlowSource, neighbours};
use crate::gpu::{Device, Footprint, Rehearsal};
use crate::ops::flow::{FlowEngine, FlowImages};
use crate::types::{FlowSettings, Image};
use crate::{Error, Result};

/// Flow that the engine computes between neighbouring frames of a clip, see [`crate::ops::flow`]. The flow
/// of the previous pair is the initial guess, because motion tends to continue.
pub struct EngineFlow<'a> {
    frames: &'a [Image],
    engine: FlowEngine,
    /// Image pyramid of the first frame of the next pair, kept from the last pair.
    ahead: Option<(usize, crate::ops::flow::FlowFrame)>,
    last: Option<(usize, FlowImages)>,
}

impl<'a> EngineFlow<'a> {
    /// Plans flow for `frames`, which must all have the same size.
    ///
    /// # Errors
    /// No frames, frame sizes that flow cannot be planned for, a failed allocation.
    pub fn new(device: &Device, frames: &'a [Image], settings: &FlowSettings) -> Result<Self> {
        let Some(first) = frames.first() else {
            return Err(Error::Input("a clip without frames has no flow".into()));
        };
        let engine = FlowEngine::new(device, first.width, first.height, settings)?;
        Ok(EngineFlow { frames, engine, ahead: None, last: None })
    }

    /// Upper bound of the device memory that the flow between frames of one size needs, determined before
    /// any work is done.
    ///
    /// # Errors
    /// [`Error::RangeLimit`] if a buffer would exceed the device's largest binding; frame sizes that flow
    /// cannot be planned for.
    pub fn footprint(
        device: &Device,
        (width, height): (u32, u32),
        settings: &FlowSettings,
    ) -> Result<Footprint> {
        let frames = vec![Image::new(width, height, 3); 3];
        Rehearsal::of(device, |rehearsal| {
            let mut flow = EngineFlow::new(rehearsal.device(), &frames, settings)?;
            (0..2).try_for_each(|pair| flow.pair(pair).map(drop))
        })
    }
}

impl FlowSource for EngineFlow<'_> {
    fn pair(&mut self, first: usize) -> Result<FlowPair> {
        let (image, next) = neighbours(self.frames, first)?;
        let here = match self.ahead.take() {
            Some((frame, pyramid)) if frame == first => pyramid,
            _ => self.engine.frame(image)?,
        };
        let there = self.engine.frame(next)?;
        let guess = self.last.as_ref().filter(|(pair, _)| pair + 1 == first).map(|(_, f)| f);
        let found = self.engine.pair(&here, &there, guess)?;
        self.ahead = Some((first + 1, there));
        let pair = FlowPair {
            forward: found.forward.clone(),
            backward: found.backward.clone(),
            forward_confidence: Some(found.forward_confidence.clone()),
            backward_confidence: Some(found.backward_confidence.clone()),
        };
        self.last = Some((first, found));
        Ok(pair)
    }

    fn known(&mut self, first: usize, pair: &FlowPair) {
        // Kept as the next pair's initial guess, which does not use confidences.
        let (forward, backward) = (pair.forward.clone(), pair.backward.clone());
        let unused = |image: &Image| Image::new(image.width, image.height, 1);
        let (forward_confidence, backward_confidence) = (unused(&forward), unused(&backward));
        let images = FlowImages { forward, backward, forward_confidence, backward_confidence };
        self.last = Some((first, images));
    }
}
