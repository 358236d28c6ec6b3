//! Two runs of two hundred training steps give the same bits.

mod common;

#[test]
fn cases() {
    common::run("determinism");
}
