//! The optimiser against its oracle.

mod common;

#[test]
fn cases() {
    common::run("adam");
}
