//! Image observations that precede any geometry: dense optical flow between neighbouring frames, its
//! confidence, and point tracks chained through it.
//!
//! | module | contents |
//! |---|---|
//! | [`alignment`] | cameras and depth from pointmaps |
//! | [`depth`] | depth that a network has estimated |
//! | [`engine`] | [`EngineFlow`]: flow that the engine computes on the GPU |
//! | [`exposure`] | exposure of each frame relative to the clip |
//! | [`features`] | [`FeatureSource`]: keypoints with descriptors, and tracks of matched ones |
//! | [`flow`] | [`FlowSource`] and user-supplied flow; forward–backward confidence; chaining |
//! | [`masks`] | [`MaskSource`]: segmentation masks from point prompts |
//! | `onnx` | networks run through the ONNX Runtime (feature `onnx`) |
//! | [`pointmaps`] | pointmaps of pairs of frames, gathered over a clip |
//! | [`sift`] | the engine's own [`FeatureSource`] |
//! | [`tracks`] | points followed over many frames |
//! | [`mod@refine`] | tracks re-aligned to the images, which removes drift |
//!
//! Later stages see only [`NeighbourFlow`], so the source of the flow (the engine, a network, a file, a
//! synthetic clip) makes no difference to them.

pub mod alignment;
pub mod depth;
pub mod engine;
pub mod exposure;
pub mod features;
pub mod flow;
pub(crate) mod luminance;
pub mod masks;
#[cfg(feature = "onnx")]
pub mod onnx;
pub mod pointmaps;
pub mod refine;
pub mod sift;
pub mod tracks;

pub use depth::{EstimatedDepth, EstimatedKind};
pub use engine::EngineFlow;
pub use exposure::Exposure;
pub use features::{FeatureSource, Features};
pub use flow::{Chain, FlowPair, FlowSource, NeighbourFlow, SuppliedFlow, observe_flow};
pub use masks::{FoundMask, MaskQuery, MaskSource, Prompt};
pub use refine::refine;
pub use sift::Sift;
pub(crate) use tracks::supplied_tracks;
pub use tracks::{PointTrack, TrackOptions, follow};
