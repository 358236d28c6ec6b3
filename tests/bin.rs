//! Binning on the device.

mod common;

#[test]
fn cases() {
    common::run("bin");
}

/// 88 tiles and 63 blocks of Gaussians at a limit of 40.
#[test]
fn folded_grids() {
    common::run_folded("bin", 40);
}
