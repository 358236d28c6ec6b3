//! splat4d: a Vulkan compute engine that turns one ordinary video of a moving scene, camera poses
//! unknown, into a 4D Gaussian-splat scene that renders in real time.
#![deny(unsafe_code)]

pub mod check;
pub mod data;
pub mod error;
pub mod eval;
pub mod geometry;
pub mod gpu;
pub mod io;
pub mod kernels;
pub mod observe;
pub mod ops;
pub mod oracle;
pub mod renderer;
pub mod scene;
pub mod track;
pub mod train;
pub mod types;
pub mod vk;

pub use error::{Error, Result};
