//! Skinning and nearest control points against their oracle.

mod common;

#[test]
fn cases() {
    common::run("deform");
}
