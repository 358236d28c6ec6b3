//! Images in texture formats.

mod common;

#[test]
fn cases() {
    common::run("texel");
}

#[test]
fn folded_grids() {
    common::run_folded("texel", 4);
}
