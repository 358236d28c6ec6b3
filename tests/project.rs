//! Projection on the device.

mod common;

#[test]
fn cases() {
    common::run("project");
}

/// 47 blocks of Gaussians, with a limit of 40 workgroups along an axis.
#[test]
fn folded_grids() {
    common::run_folded("project", 40);
}
