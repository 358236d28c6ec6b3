//! Binning on the device.

mod common;

// 88 tiles and 63 blocks of Gaussians, with a limit of 40 workgroups along an axis.
common::cases! { "bin", folded to 40:
    lists, equal_depths, depth_bits, image_sizes, overflow, saturation,
}
