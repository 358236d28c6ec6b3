//! The kernels that measure a device's peak bandwidth and arithmetic throughput.

mod common;

#[test]
fn cases() {
    common::run("roofline");
}
