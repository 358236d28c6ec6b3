//! Grids from counts on the device, against what the host would dispatch.

mod common;

#[test]
fn cases() {
    common::run("indirect");
}
