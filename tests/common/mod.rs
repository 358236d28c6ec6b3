//! The device that the tests run on, and the execution of a kernel family's cases.
//!
//! `SPLAT4D_DEVICE` selects the device (an index, a kind or part of a name; default: a software driver,
//! so that results do not depend on the GPU). `SPLAT4D_VALIDATION=1` enables the validation layer; any
//! message of it then fails the test. Set `RUST_TEST_THREADS=1` with it, since the layer is not safe when
//! one thread creates devices while another uses its device. A missing driver fails.
#![allow(dead_code, unused_imports, reason = "each test binary uses its own part")]

// A test binary may also include `support`, which has the same module.
#[allow(clippy::duplicate_mod)]
#[path = "../support/data.rs"]
mod data;

pub use data::shared_data;

use splat4d::check;
use splat4d::gpu::{Device, Request, Selector};
use splat4d::vk::{DeviceKind, Limits};

/// Opens the device under test.
pub fn device() -> Device {
    open(None)
}

fn open(limits: Option<Limits>) -> Device {
    let selector = match std::env::var("SPLAT4D_DEVICE") {
        Ok(text) => Selector::from(text.as_str()),
        Err(_) => Selector::Kind(DeviceKind::Software),
    };
    let validation = std::env::var("SPLAT4D_VALIDATION").is_ok_and(|value| value == "1");
    Device::open(&Request { selector, validation, limits, profile: None })
        .expect("the tests need a Vulkan driver (Debian: mesa-vulkan-drivers)")
}

/// Fails if the validation layer has reported anything.
pub fn assert_valid(device: &Device) {
    let messages = device.take_validation_messages();
    assert!(messages.is_empty(), "the validation layer complains:\n{}", messages.join("\n"));
}

/// Runs every case of a family; fails with a table of the cases that exceeded their bound.
pub fn run(family: &str) {
    run_on(&device(), family);
}

/// As [`run`], with grids limited to `groups` workgroups along an axis, so that larger grids fold into
/// further axes.
pub fn run_folded(family: &str, groups: u32) {
    let limits = Limits { groups, ..*device().limits() };
    run_on(&open(Some(limits)), family);
}

fn run_on(device: &Device, family: &str) {
    let cases: Vec<_> = check::ALL
        .iter()
        .flat_map(|cases| cases.iter())
        .filter(|case| case.id.split('/').next() == Some(family))
        .collect();
    assert!(!cases.is_empty(), "no case in {family}");
    let mut failures = String::new();
    for case in cases {
        let outcome = check::run(case, device, 1);
        for f in &outcome.findings {
            println!(
                "{} {}: {} values, worst {:.3e} absolute, {:.3e} relative, {:.3} of the bound at \
                 {} (f32 oracle {:?})",
                case.id,
                f.output,
                f.count,
                f.worst_absolute,
                f.worst_relative,
                f.worst_of_bound,
                f.worst_at,
                f.oracle_f32_of_bound
            );
        }
        if !outcome.passed() {
            let findings: Vec<_> = outcome.findings.iter().filter(|f| !f.passed).collect();
            failures += &format!("{}: {:?} {findings:#?}\n", case.id, outcome.error);
        }
    }
    assert_valid(device);
    assert!(failures.is_empty(), "{}: \n{failures}", device.info().name);
}
