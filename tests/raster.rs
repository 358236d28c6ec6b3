//! Blending on the device.

mod common;

#[test]
fn cases() {
    common::run("raster");
}

/// 257 tiles, with a limit of 40 workgroups along an axis: the equivalent of 65,536 tiles on a real
/// device.
#[test]
fn folded_grids() {
    common::run_folded("raster", 40);
}
