//! Check cases: one declaration serves as test, gradient check and validation.
//!
//! A [`Case`] runs kernels on a device and compares every output with the oracle in f64. It also
//! compares with the oracle in f32, so that a report can distinguish a device fault from the limits
//! of f32. Outputs are poisoned before a run and lie between guard words ([`Guarded`]). Every case
//! runs under each [`Profile`], so that the variants of kernels for GPUs are checked on software drivers
//! too, and with each subgroup size that the driver lets kernels require. Under each it runs twice, and
//! both runs must give the same bits. What a case covers is what it was seen to dispatch:
//! [`Outcome::dispatched`].
//!
//! A family whose op is benchmarked declares it as a [`Workload`], which case and benchmark share.
//!
//! To add one: write `src/check/FAMILY.rs` with a `pub const CASES: &[Case]`, list it in [`ALL`],
//! and name it in `common::cases!` in `tests/FAMILY.rs`, which makes it a test of its own. A family whose
//! op has gradients has a case `FAMILY/central_differences`; a case that covers a hard input of the
//! contract is listed in [`HARD`], and one case at least for each variant of each kernel in [`QUICK`].

pub mod adam;
pub mod arap;
pub mod bin;
mod contract;
pub mod deform;
pub mod density;
pub mod determinism;
mod expect;
mod finding;
pub mod flow;
pub mod fuzz;
pub mod geometry;
mod harness;
pub mod indirect;
pub mod loss;
pub mod mask;
pub mod mlp;
pub mod path;
pub mod project;
pub mod raster;
pub mod render;
pub mod roofline;
mod rounding;
pub mod scan;
mod scene;
pub mod sort;
pub mod texel;
mod workload;

pub use contract::{HARD, QUICK};
pub use expect::{EXPECTED, Expect, Verdict, verdict};
pub use finding::{Bound, Finding};
pub use harness::{Guarded, Harness};
pub(crate) use workload::Pass;
pub use workload::Workload;

use crate::error::{Error, Result};
use crate::gpu::{Device, Dispatched, Profile};
use std::collections::BTreeSet;
use std::panic::{AssertUnwindSafe, catch_unwind};

/// A check that runs on a device.
pub struct Case {
    /// Unique identifier, `family/what`.
    pub id: &'static str,
    /// Runs the kernels and compares the outputs.
    pub run: fn(&mut Harness) -> Result<()>,
}

/// The cases of every family.
pub const ALL: &[&[Case]] = &[
    adam::CASES,
    arap::CASES,
    bin::CASES,
    roofline::CASES,
    deform::CASES,
    density::CASES,
    flow::CASES,
    geometry::CASES,
    indirect::CASES,
    loss::CASES,
    mask::CASES,
    mlp::CASES,
    path::CASES,
    project::CASES,
    raster::CASES,
    render::CASES,
    scan::CASES,
    sort::CASES,
    texel::CASES,
    fuzz::CASES,
    determinism::CASES,
];

/// The result of a case.
#[derive(Debug)]
pub struct Outcome {
    /// The case.
    pub id: &'static str,
    /// The random seed that reproduces it.
    pub seed: u64,
    /// What was compared.
    pub findings: Vec<Finding>,
    /// The kernels that ran, in their variants: what the case covers. Empty for a case of the host.
    pub dispatched: BTreeSet<Dispatched>,
    /// An error that ended the case early.
    pub error: Option<Error>,
}

impl Outcome {
    /// Whether the case made at least one comparison and all comparisons passed.
    pub fn passed(&self) -> bool {
        self.error.is_none()
            && !self.findings.is_empty()
            && self.findings.iter().all(|finding| finding.passed)
    }
}

/// Runs a case on a device under the device's own profile and, if it runs kernels, under every other
/// one, and with every other subgroup size that kernels can require. Under each it runs twice; both runs
/// must give the same bits. A panic counts as an error.
pub fn run(case: &Case, device: &Device, seed: u64) -> Outcome {
    let device = &device.tracing();
    let (findings, error) = twice(case, device, seed);
    let dispatched = device.dispatched();
    let mut outcome = Outcome { id: case.id, seed, findings, dispatched, error };
    for (name, device) in others(device) {
        if outcome.dispatched.is_empty() || outcome.error.is_some() {
            return outcome;
        }
        let (findings, error) = twice(case, &device, seed);
        outcome.findings.extend(
            findings.into_iter().map(|finding| Finding {
                output: format!("{name}: {}", finding.output),
                ..finding
            }),
        );
        outcome.error = error.map(|error| match error {
            Error::DeviceLost { .. } => error,
            other => Error::Failed(format!("{name}: {other}")),
        });
        outcome.dispatched = device.dispatched();
    }
    outcome
}

/// The same device under every other profile, and with every other subgroup size that kernels can require,
/// each with its name.
fn others(device: &Device) -> Vec<(String, Device)> {
    let (profile, size) = (*device.profile(), device.subgroup_size());
    let profiles = Profile::ALL.into_iter().filter(|&other| other != profile);
    let sizes = device.subgroup_sizes().iter().copied().filter(|&other| other != size);
    let under = |other: Profile| (format!("profile {}", other.name()), device.with_profile(other));
    let with = |other| {
        let device = device.with_subgroup_size(other).expect("one of the device's own sizes");
        (format!("subgroups of {other}"), device)
    };
    profiles.map(under).chain(sizes.map(with)).collect()
}

/// Runs a case twice on a device: the findings of the second run, or those up to the error that ended a
/// run early.
fn twice(case: &Case, device: &Device, seed: u64) -> (Vec<Finding>, Option<Error>) {
    let mut findings = Vec::new();
    let mut digests = Vec::new();
    for _ in 0..2 {
        match once(case, device, seed) {
            Ok((found, digest)) => {
                findings = found;
                digests.push(digest);
            }
            Err((found, error)) => return (found, Some(error)),
        }
    }
    findings.push(finding::exact("bits of two runs", &digests[1..], &digests[..1]));
    (findings, None)
}

type Once = std::result::Result<(Vec<Finding>, u64), (Vec<Finding>, Error)>;

fn once(case: &Case, device: &Device, seed: u64) -> Once {
    let mut harness = Harness::new(device, seed).map_err(|error| (Vec::new(), error))?;
    let ended = catch_unwind(AssertUnwindSafe(|| (case.run)(&mut harness)));
    let (findings, digest) = harness.finish();
    match ended {
        Ok(Ok(())) => Ok((findings, digest)),
        Ok(Err(error)) => Err((findings, error)),
        Err(panic) => Err((findings, Error::Failed(format!("panicked: {}", words(&*panic))))),
    }
}

/// The message of a panic.
fn words(panic: &(dyn std::any::Any + Send)) -> &str {
    match (panic.downcast_ref::<&str>(), panic.downcast_ref::<String>()) {
        (Some(text), _) => text,
        (_, Some(text)) => text,
        _ => "no words",
    }
}
