//! Blending on the device.

mod common;

// 257 tiles, with a limit of 40 workgroups along an axis: the equivalent of 65,536 tiles on a real
// device.
common::cases! { "raster", folded to 40:
    scenes, image_sizes, shared_memory, layers, blending_constants, decisions, overflow,
    determinism,
}
