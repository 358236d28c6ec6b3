//! The paths of control points against their oracle.

mod common;

use splat4d::check;
use splat4d::gpu::{Device, Request};

#[test]
fn cases() {
    common::run("path");
}

/// Grids that exceed a limit of 40 workgroups along an axis.
#[test]
fn folded_grids() {
    let mut limits = *common::device().limits();
    limits.groups = 40;
    let device = Device::open(&Request { limits: Some(limits), ..Request::software() }).unwrap();
    for case in check::path::CASES {
        let outcome = check::run(case, &device, 2);
        assert!(outcome.passed(), "{outcome:#?}");
    }
}
