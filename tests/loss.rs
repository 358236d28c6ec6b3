//! The loss on the device.

mod common;

#[test]
fn cases() {
    common::run("loss");
}
