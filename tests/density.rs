//! Density control against its oracle.

mod common;

#[test]
fn cases() {
    common::run("density");
}
