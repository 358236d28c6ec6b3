//! What a video shows before any geometry: dense optical flow between neighbouring frames, how far
//! it is to be believed, and point tracks chained through it.
//!
//! | module | what it holds |
//! |---|---|
//! | [`flow`] | [`FlowSource`] and flow that the user supplies; forward–backward confidence; chaining |
//! | [`tracks`] | points followed over many frames |
//!
//! Everything after this stage sees only [`NeighbourFlow`]: where a flow came from (the engine, a
//! network, a file, a synthetic clip) makes no difference to it.

pub mod flow;
pub mod tracks;

pub use flow::{Chain, FlowSource, NeighbourFlow, SuppliedFlow, observe_flow};
pub use tracks::{PointTrack, TrackOptions, follow};
