//! Cases: one declaration gives test, gradient check, validation and benchmark.
//!
//! A [`Case`] runs kernels on a device and holds every output against the oracle in f64 and, so
//! that a report can tell "this device is wrong" from "f32 is like that", in f32. Outputs are
//! poisoned before a run and lie between guard words ([`Guarded`]); every case runs twice, and the
//! device must answer with the same bits.
//!
//! To add one: write `src/check/FAMILY.rs` with a `pub const CASES: &[Case]`, list it in [`ALL`],
//! and let `tests/FAMILY.rs` call `common::run("FAMILY")`. A family whose op has gradients has a
//! case `FAMILY/central_differences`; a case that covers a hard input of the contract is listed in
//! [`HARD`], and one case per kernel at least in [`QUICK`].

pub mod adam;
pub mod arap;
pub mod bin;
pub mod roofline;
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
mod rounding;
pub mod scan;
mod scene;
pub mod sort;
pub mod texel;

pub use contract::{HARD, QUICK};
pub use expect::{EXPECTED, Expect, Verdict, verdict};
pub use finding::{Bound, Finding};
pub use harness::{Guarded, Harness};

use crate::error::{Error, Result};
use crate::gpu::Device;
use std::panic::{AssertUnwindSafe, catch_unwind};

/// One thing that is checked on a device.
pub struct Case {
    /// `family/what`, unique.
    pub id: &'static str,
    /// The kernels that it covers.
    pub kernels: &'static [&'static str],
    /// Runs it and compares.
    pub run: fn(&mut Harness) -> Result<()>,
}

/// Every family's cases.
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

/// What became of a case.
#[derive(Debug)]
pub struct Outcome {
    /// The case.
    pub id: &'static str,
    /// The seed that repeats it.
    pub seed: u64,
    /// What was compared.
    pub findings: Vec<Finding>,
    /// An error that ended it early.
    pub error: Option<Error>,
}

impl Outcome {
    /// Whether it compared something and all of it passed.
    pub fn passed(&self) -> bool {
        self.error.is_none()
            && !self.findings.is_empty()
            && self.findings.iter().all(|finding| finding.passed)
    }
}

/// Runs a case on a device, twice: the second run must give the first one's bits. A panic counts as
/// an error.
pub fn run(case: &Case, device: &Device, seed: u64) -> Outcome {
    let mut outcome = Outcome { id: case.id, seed, findings: Vec::new(), error: None };
    let mut digests = Vec::new();
    for _ in 0..2 {
        match once(case, device, seed) {
            Ok((findings, digest)) => {
                outcome.findings = findings;
                digests.push(digest);
            }
            Err((findings, error)) => {
                (outcome.findings, outcome.error) = (findings, Some(error));
                return outcome;
            }
        }
    }
    outcome.findings.push(finding::exact("bits of two runs", &digests[1..], &digests[..1]));
    outcome
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

/// What a panic said.
fn words(panic: &(dyn std::any::Any + Send)) -> &str {
    match (panic.downcast_ref::<&str>(), panic.downcast_ref::<String>()) {
        (Some(text), _) => text,
        (_, Some(text)) => text,
        _ => "no words",
    }
}
