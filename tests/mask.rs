//! Rendered motion against motion masks, on the device.

mod common;

#[test]
fn cases() {
    common::run("mask");
}

#[test]
fn folded_grids() {
    common::run_folded("mask", 20);
}
