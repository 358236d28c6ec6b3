//! SE(3), Sim(3), PnP, RANSAC, two-view geometry and bundle adjustment, in f64.
//!
//! | module | what it answers |
//! |---|---|
//! | [`se3`], [`sim3`] | how to perturb a pose; how two point sets or two trajectories lie to each other |
//! | [`epipolar`], [`five_point`], [`relative`], [`homography`], [`two_view`] | how two images lie to each other, from pixel pairs alone |
//! | [`focal`] | which focal length a set of fundamental matrices speaks for, and how loudly |
//! | [`triangulate`] | where a point lies that known cameras saw |
//! | [`p3p`], [`pnp`], [`sampling`] | where a camera lies that saw known points |
//! | [`mod@look_at`] | where cameras look, and cameras that look somewhere |
//! | [`bundle`] | all poses, one focal length and all inverse depths at once |
//!
//! Perturbations are left-multiplied, `exp(ξ) · pose`, with ξ = (translation, rotation). Everything
//! random takes a seed and gives the same bits for the same seed, whatever the number of threads.

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
