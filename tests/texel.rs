//! Pictures in the formats of textures.

mod common;

#[test]
fn cases() {
    common::run("texel");
}

#[test]
fn folded_grids() {
    common::run_folded("texel", 4);
}
