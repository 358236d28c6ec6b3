//! Projection on the device.

mod common;

#[test]
fn cases() {
    common::run("project");
}

/// 47 blocks of Gaussians at a limit of 40.
#[test]
fn folded_grids() {
    common::run_folded("project", 40);
}
