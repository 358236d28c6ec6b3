//! The deformation network against its oracle.

mod common;

#[test]
fn cases() {
    common::run("mlp");
}
