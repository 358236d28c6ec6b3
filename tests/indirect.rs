//! Indirect dispatch grids from counts on the device, compared with the host's.

mod common;

#[test]
fn cases() {
    common::run("indirect");
}
