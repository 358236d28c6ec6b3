//! A short fuzz run, and scenes that failed before.

mod common;

#[test]
fn cases() {
    common::run("fuzz");
}
