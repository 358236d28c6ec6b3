//! Cases: one declaration gives test, gradient check, validation and, later, benchmark.
//!
//! A [`Case`] runs kernels on a device and holds every output against the oracle in f64 and, so
//! that a report can tell "this device is wrong" from "f32 is like that", in f32. Outputs are
//! poisoned before a run and lie between guard words ([`Guarded`]).
//!
//! To add one: write `src/check/FAMILY.rs` with a `pub const CASES: &[Case]`, list it in [`ALL`],
//! and let `tests/FAMILY.rs` call `common::run("FAMILY")`.

pub mod adam;
pub mod arap;
pub mod bin;
pub mod ceiling;
pub mod deform;
pub mod density;
pub mod flow;
mod harness;
pub mod indirect;
pub mod loss;
pub mod mask;
pub mod mlp;
pub mod project;
pub mod raster;
pub mod render;
pub mod scan;
mod scene;
pub mod sort;

pub use harness::{Bound, Finding, Guarded, Harness};

use crate::error::Result;

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
    ceiling::CASES,
    deform::CASES,
    density::CASES,
    flow::CASES,
    indirect::CASES,
    loss::CASES,
    mask::CASES,
    mlp::CASES,
    project::CASES,
    raster::CASES,
    render::CASES,
    scan::CASES,
    sort::CASES,
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
    pub error: Option<crate::Error>,
}

impl Outcome {
    /// Whether it compared something and all of it passed.
    pub fn passed(&self) -> bool {
        self.error.is_none()
            && !self.findings.is_empty()
            && self.findings.iter().all(|finding| finding.passed)
    }
}

/// Runs a case on a device.
pub fn run(case: &Case, device: &crate::gpu::Device, seed: u64) -> Outcome {
    let mut findings = Vec::new();
    let error = Harness::new(device, seed)
        .and_then(|mut harness| {
            let result = (case.run)(&mut harness);
            findings = harness.into_findings();
            result
        })
        .err();
    Outcome { id: case.id, seed, findings, error }
}
