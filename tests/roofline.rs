//! The kernels that measure what a device can do at most.

mod common;

#[test]
fn cases() {
    common::run("roofline");
}
