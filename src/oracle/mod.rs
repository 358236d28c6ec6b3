//! The oracle: a CPU twin of every kernel, as pure functions over slices, generic over f32 and f64.
//!
//! In f64 the oracle is the reference. In f32 it shows whether an error is a fault of the device or
//! a limit of f32. The oracle does not depend on Vulkan, buffers or workgroups: it implements the
//! mathematics independently of the shaders' loops.

pub mod adam;
pub mod arap;
pub mod bin;
pub mod deform;
pub mod density;
pub mod flow;
pub mod half;
pub mod linear;
pub mod loss;
pub mod mask;
pub mod mlp;
pub mod path;
pub mod project;
pub mod project_backward;
pub mod raster;
mod real;
pub mod render;
#[cfg(test)]
mod render_hard_cases;
#[cfg(test)]
mod render_tests;
pub mod roofline;
pub mod rotation;
pub mod scan;
pub mod sh;
pub mod sort;
pub mod ssim;
pub mod texel;
pub mod tiles;
pub mod view;

pub use real::Real;
