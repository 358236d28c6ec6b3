//! The CPU twin of every kernel: pure functions over slices, generic over f32 and f64.
//!
//! In f64 the oracle is the truth; the same oracle in f32 tells "the device is wrong" from "f32 is
//! like that". Nothing here knows Vulkan, buffers or workgroups: it is the mathematics, written
//! independently of the shaders' loops.

pub mod flow;
mod real;

pub use real::Real;
