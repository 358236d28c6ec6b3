//! The as-rigid-as-possible energy against its oracle.

mod common;

#[test]
fn cases() {
    common::run("arap");
}
