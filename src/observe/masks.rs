//! Segmentation masks from point prompts: the query, the result and the source.

use glam::DVec2;

use crate::Result;
use crate::types::Image;

/// A point of a frame that marks an object or its background.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Prompt {
    /// Position in pixels of the frame; the centre of the first pixel is at 0.5.
    pub pixel: DVec2,
    /// Whether the point is on the object; otherwise it is on the background.
    pub inside: bool,
}

/// A query for the mask of one object.
#[derive(Clone, Debug, PartialEq)]
pub struct MaskQuery {
    /// Points on the object and on the background; at least one is on the object.
    pub prompts: Vec<Prompt>,
    /// An initial mask: log odds, one channel at the size of the frame.
    pub before: Option<Image>,
}

/// A mask that answers a query.
#[derive(Clone, Debug, PartialEq)]
pub struct FoundMask {
    /// Log odds that a pixel shows the object, one channel at the size of the frame.
    pub odds: Image,
    /// The source's own estimate of the mask's quality.
    pub score: f32,
}

/// A source of masks from point prompts, such as a promptable segmentation network.
pub trait MaskSource {
    /// Returns one or more masks for each queried object in frame `number`. `frame` is the image as it is
    /// tracked: undistorted and with even exposure.
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
