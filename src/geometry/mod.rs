//! SE(3), Sim(3), PnP, RANSAC, two-view geometry and bundle adjustment, in f64.
//!
//! | module | contents |
//! |---|---|
//! | [`se3`], [`sim3`] | perturbation of poses; alignment of point sets and trajectories |
//! | [`epipolar`], [`five_point`], [`relative`], [`homography`], [`two_view`] | two images, from pixel pairs |
//! | [`focal`] | focal length of a set of fundamental matrices, and its uncertainty |
//! | [`triangulate`] | points seen by known cameras |
//! | [`p3p`], [`pnp`], [`sampling`] | pose of a camera that sees known points |
//! | [`mod@look_at`] | the point that cameras look at, and cameras that look at a point |
//! | [`bundle`] | bundle adjustment of all poses, one focal length and all inverse depths |
//!
//! Perturbations are left-multiplied, `exp(ξ) · pose`, with ξ = (translation, rotation). All randomised
//! functions take a seed and give bit-identical results for the same seed, whatever the number of threads.

pub mod bundle;
pub(crate) mod envelope;
pub mod epipolar;
pub mod five_point;
pub mod focal;
pub mod homography;
pub mod look_at;
pub mod p3p;
pub mod pnp;
pub mod polynomial;
pub mod ransac;
pub mod relative;
pub mod sampling;
pub mod se3;
pub mod sim3;
pub mod triangulate;
pub mod two_view;

pub use bundle::{DepthPrior, FocalMode, Kernel, Observation, Point};
pub use look_at::{look_at, look_at_point};
pub use pnp::{PnpOptions, PnpResult, pnp_ransac};
pub use sim3::Sim3;
pub use two_view::{Motion, TwoView, TwoViewOptions};
