//! Two hundred steps of training, twice, to the same bits.

mod common;

#[test]
fn cases() {
    common::run("determinism");
}
