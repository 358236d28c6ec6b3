//! The radix sort on the device.

mod common;

use splat4d::check;
use splat4d::gpu::{Device, Request};
use splat4d::ops::sort::RadixSort;

#[test]
fn cases() {
    common::run("sort");
}

/// 16 workgroups for the values and 32 blocks of the table, with a limit of 6 workgroups along an axis.
#[test]
fn folded_grids() {
    let mut limits = *common::device().limits();
    limits.groups = 6;
    let device = Device::open(&Request { limits: Some(limits), ..Request::software() }).unwrap();
    for case in check::sort::CASES {
        let outcome = check::run(case, &device, 2);
        assert!(outcome.passed(), "{outcome:#?}");
    }
}

#[test]
fn bits_past_the_key_are_refused() {
    let device = common::device();
    for bits in [0..33, std::ops::Range { start: 5, end: 4 }] {
        let error = RadixSort::plan(&device, 10, bits).unwrap_err();
        assert!(error.to_string().contains("bits within 0..32"), "{error}");
    }
}
