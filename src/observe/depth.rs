//! Depth that a network has estimated from single frames.

use serde::{Deserialize, Serialize};

use crate::types::Image;

/// What a network's depth maps hold.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum EstimatedKind {
    /// Depth (z) up to a factor of each frame; not above 0 where unknown.
    Depth,
    /// Depth (z) up to a factor and a shift of each frame; 0 where unknown.
    ShiftedDepth,
    /// Inverse depth up to a factor and a shift of each frame, as MiDaS and Depth Anything give it.
    ShiftedInverse,
}

/// A network's depth of a clip.
#[derive(Clone, Debug, Serialize)]
pub struct EstimatedDepth {
    /// One channel for each frame, at the size of the frames; not finite where unknown.
    pub maps: Vec<Image>,
    /// What they hold.
    pub kind: EstimatedKind,
}
