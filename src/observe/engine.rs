//! Flow that the engine computes.

use super::flow::{FlowPair, FlowSource, neighbours};
use crate::gpu::{Device, Footprint, Rehearsal};
use crate::ops::flow::{FlowEngine, FlowImages};
use crate::types::{FlowSettings, Image};
use crate::{Error, Result};

/// The engine's own flow between the frames of a clip: [`crate::ops::flow`], with the pair before
/// as a guess, since motion goes on.
pub struct EngineFlow<'a> {
    frames: &'a [Image],
    engine: FlowEngine,
    /// The pyramid of the frame that the next pair begins with.
    ahead: Option<(usize, crate::ops::flow::FlowFrame)>,
    last: Option<(usize, FlowImages)>,
}

impl<'a> EngineFlow<'a> {
    /// For frames of one size.
    ///
    /// # Errors
    /// No frames, frames that flow cannot be planned for, a failed allocation.
    pub fn new(device: &Device, frames: &'a [Image], settings: &FlowSettings) -> Result<Self> {
        let Some(first) = frames.first() else {
            return Err(Error::Input("a clip without frames has no flow".into()));
        };
        let engine = FlowEngine::new(device, first.width, first.height, settings)?;
        Ok(EngineFlow { frames, engine, ahead: None, last: None })
    }

    /// What the flow between frames of a size takes of a device's memory at most, before it begins.
    ///
    /// # Errors
    /// [`Error::RangeLimit`] for a buffer larger than one binding of the device may be; frames that
    /// flow cannot be planned for.
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
        // The next pair's guess; confidences are not used there.
        let (forward, backward) = (pair.forward.clone(), pair.backward.clone());
        let unused = |image: &Image| Image::new(image.width, image.height, 1);
        let (forward_confidence, backward_confidence) = (unused(&forward), unused(&backward));
        let images = FlowImages { forward, backward, forward_confidence, backward_confidence };
        self.last = Some((first, images));
    }
}
