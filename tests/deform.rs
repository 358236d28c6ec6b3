//! The deform family against its oracle.

mod common;

#[test]
fn cases() {
    common::run("deform");
}
