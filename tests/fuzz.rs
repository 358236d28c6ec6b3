//! A little fuzzing, and the scenes that failed once.

mod common;

#[test]
fn cases() {
    common::run("fuzz");
}
