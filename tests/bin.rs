//! Binning on the device.

mod common;

#[test]
fn cases() {
    common::run("bin");
}

/// 88 tiles and 63 blocks of Gaussians, with a limit of 40 workgroups along an axis.
#[test]
fn folded_grids() {
    common::run_folded("bin", 40);
}
