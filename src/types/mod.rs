//! Plain data types shared by kernels and oracle. This module does not depend on Vulkan.
//!
//! Conventions of the whole crate: camera axes are OpenCV's (x right, y down, z forward);
//! transforms are named `a_from_b` and map a point of b to a; pixel centres lie at +0.5; depth is
//! the z coordinate in the camera; quaternions are (w, x, y, z) in storage; scales are stored as
//! logarithms, opacity and motion as logits; colours are the image's own encoded values in [0, 1].

mod adam;
mod camera;
mod control;
mod density;
mod flow;
mod gaussians;
mod image;
pub mod range;
mod settings;
mod tracks;
mod work;

pub use adam::AdamSettings;
pub use camera::{Camera, Intrinsics, Pose};
pub use control::{ControlPoints, DeformNet, MotionScale, NetShape};
pub use density::{AdaptSettings, MotionClass};
pub use flow::FlowSettings;
pub use gaussians::{Gaussians, SH_C0, sh_coefficients};
pub use image::Image;
pub use settings::{DEPTH_BITS, RasterKind, RenderSettings, Tuning};
pub use tracks::{PointPath, Tracks};
pub use work::Work;
