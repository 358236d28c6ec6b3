//! Blending on the device.

mod common;

#[test]
fn cases() {
    common::run("raster");
}

/// 257 tiles at a limit of 40: what 65,536 tiles are to a real device.
#[test]
fn folded_grids() {
    common::run_folded("raster", 40);
}
