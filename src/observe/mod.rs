//! What a video shows before any geometry: dense optical flow between neighbouring frames, how far
//! it is to be believed, and point tracks chained through it.
//!
//! | module | what it holds |
//! |---|---|
//! | [`alignment`] | cameras and depth from pointmaps |
//! | [`depth`] | depth that a network has estimated |
//! | [`engine`] | [`EngineFlow`]: flow that the engine computes |
//! | [`exposure`] | how bright each frame is |
//! | [`features`] | [`FeatureSource`]: points told apart by descriptors, and tracks of those that are found again |
//! | [`flow`] | [`FlowSource`] and flow that the user supplies; forward–backward confidence; chaining |
//! | [`masks`] | [`MaskSource`]: masks of what points tell |
//! | `onnx` | networks run through the ONNX Runtime (feature `onnx`) |
//! | [`pointmaps`] | points that pairs of frames show, gathered over a clip |
//! | [`sift`] | the engine's own [`FeatureSource`] |
//! | [`tracks`] | points followed over many frames |
//! | [`mod@refine`] | tracks aligned with the pictures, so that they do not drift |
//!
//! Everything after this stage sees only [`NeighbourFlow`]: where a flow came from (the engine, a
//! network, a file, a synthetic clip) makes no difference to it.

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
