//! Masks of things that points of a frame tell: what is asked for, and who answers.

use glam::DVec2;

use crate::Result;
use crate::types::Image;

/// A point of a frame that tells which thing is meant.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Prompt {
    /// Pixels of the frame; the first pixel's centre is at 0.5.
    pub pixel: DVec2,
    /// Whether it is on the thing; else it is beside it.
    pub inside: bool,
}

/// A thing that is asked for.
#[derive(Clone, Debug, PartialEq)]
pub struct MaskQuery {
    /// Points on it and beside it, one on it at least.
    pub prompts: Vec<Prompt>,
    /// A mask to begin with: log odds, one channel at the size of the frame.
    pub before: Option<Image>,
}

/// A mask of what was asked for.
#[derive(Clone, Debug, PartialEq)]
pub struct FoundMask {
    /// Log odds that a pixel shows the thing, one channel at the size of the frame.
    pub odds: Image,
    /// How good the source thinks that it is.
    pub score: f32,
}

/// Something that draws masks by points: a network that segments whatever it is pointed at.
pub trait MaskSource {
    /// For each thing that is asked for in frame `number`, one or more masks. `frame` is its picture as it is
    /// tracked: without the lens's distortion, of even exposure.
    ///
    /// # Errors
    /// Whatever keeps the source from answering.
    fn masks(
        &mut self,
        number: usize,
        frame: &Image,
        asked: &[MaskQuery],
    ) -> Result<Vec<Vec<FoundMask>>>;
}
