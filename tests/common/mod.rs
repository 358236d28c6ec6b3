//! The device that the tests run on, and the tests of a kernel family's cases.
//!
//! `SPLAT4D_DEVICE` selects the device (an index, a kind or part of a name; default: a software driver,
//! so that results do not depend on the GPU). `SPLAT4D_VALIDATION=1` enables the validation layer; any
//! message of it then fails the test. Set `RUST_TEST_THREADS=1` with it, since the layer is not safe when
//! one thread creates devices while another uses its device. A missing driver fails.
#![allow(dead_code, unused_imports, unused_macros, reason = "each test binary uses its own part")]

// A test binary may also include `support`, which has the same module.
#[allow(clippy::duplicate_mod)]
#[path = "../support/data.rs"]
mod data;

pub use data::shared_data;

use splat4d::check;
use splat4d::gpu::{Device, Request, Selector};
use splat4d::vk::{DeviceKind, Limits};
use std::sync::{LazyLock, OnceLock};

/// Opens the device under test.
pub fn device() -> Device {
    let selector = match std::env::var("SPLAT4D_DEVICE") {
        Ok(text) => Selector::from(text.as_str()),
        Err(_) => Selector::Kind(DeviceKind::Software),
    };
    let validation = std::env::var("SPLAT4D_VALIDATION").is_ok_and(|value| value == "1");
    Device::open(&Request { selector, validation, ..Request::default() })
        .expect("the tests need a Vulkan driver (Debian: mesa-vulkan-drivers)")
}

/// Fails if the validation layer has reported anything.
pub fn assert_valid(device: &Device) {
    let messages = device.take_validation_messages();
    assert!(messages.is_empty(), "the validation layer complains:\n{}", messages.join("\n"));
}

/// Declares a test for each case of a family, and one that fails if a case has none. With `folded to N`,
/// every case also runs with grids limited to `N` workgroups along an axis, so that larger grids fold into
/// further axes.
macro_rules! cases {
    ($family:literal: $($case:ident),+ $(,)?) => {
        mod cases {
            #[test]
            fn none_is_left_out() {
                $crate::common::assert_all($family, &[$(stringify!($case)),+]);
            }
            $(
                #[test]
                fn $case() {
                    $crate::common::run(concat!($family, "/", stringify!($case)));
                }
            )+
        }
    };
    ($family:literal, folded to $groups:literal: $($case:ident),+ $(,)?) => {
        $crate::common::cases! { $family: $($case),+ }
        mod folded {
            $(
                #[test]
                fn $case() {
                    $crate::common::run_folded(concat!($family, "/", stringify!($case)), $groups);
                }
            )+
        }
    };
}
pub(crate) use cases;

/// The device of the cases. They share it, so that a test for each case opens no device and compiles no
/// pipelines of its own.
static SHARED: LazyLock<Device> = LazyLock::new(device);
/// The same device with the limited grids of the file's family.
static FOLDED: OnceLock<Device> = OnceLock::new();

/// Fails if a family has other cases than these.
pub fn assert_all(family: &str, names: &[&str]) {
    let all: Vec<&str> = check::ALL
        .iter()
        .flat_map(|cases| cases.iter())
        .filter_map(|case| case.id.strip_prefix(family)?.strip_prefix('/'))
        .collect();
    assert_eq!(names, all, "the tests, and the cases of {family} in check::ALL");
}

/// Runs a case; fails with the comparisons that exceeded their bound.
pub fn run(id: &str) {
    run_on(&SHARED, id, 1);
}

/// As [`run`], with grids limited to `groups` workgroups along an axis.
pub fn run_folded(id: &str, groups: u32) {
    let limits = || Limits { groups, ..*SHARED.limits() };
    run_on(FOLDED.get_or_init(|| SHARED.with_limits(limits())), id, 2);
}

fn run_on(device: &Device, id: &str, seed: u64) {
    let mut cases = check::ALL.iter().flat_map(|cases| cases.iter());
    let case = cases.find(|case| case.id == id).expect("a case of check::ALL");
    let outcome = check::run(case, device, seed);
    for f in &outcome.findings {
        println!(
            "{}: {} values, worst {:.3e} absolute, {:.3e} relative, {:.3} of the bound at {} \
             (f32 oracle {:?})",
            f.output,
            f.count,
            f.worst_absolute,
            f.worst_relative,
            f.worst_of_bound,
            f.worst_at,
            f.oracle_f32_of_bound
        );
    }
    assert_valid(device);
    let failures: Vec<_> = outcome.findings.iter().filter(|f| !f.passed).collect();
    assert!(
        outcome.passed(),
        "{} on {}: {:?} {failures:#?}",
        case.id,
        device.info().name,
        outcome.error
    );
}
