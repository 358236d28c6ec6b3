//! Check cases of the kernels that measure peak bandwidth and peak arithmetic.

use super::{Bound, Case, Guarded, Harness, Workload};
use crate::error::Result;
use crate::gpu::{Buffer, Groups, Recorder};
use crate::kernels::roofline::{
    COPY_PER_GROUP, Copy, CopyArgs, CopyParams, FMA_OPERATIONS, Fma, FmaArgs, FmaParams,
};
use crate::oracle::roofline;
use crate::types::Work;
use rand::RngExt;

/// The family's cases.
pub const CASES: &[Case] =
    &[Case { id: "roofline/copy", run: copy }, Case { id: "roofline/fma", run: fma }];

/// A copy of random vectors.
pub(crate) struct CopyWorkload {
    values: Vec<[f32; 4]>,
    groups: Groups,
    source: Buffer<[f32; 4]>,
    target: Guarded<[f32; 4]>,
}

impl CopyWorkload {
    /// Draws and uploads the vectors.
    pub(crate) fn new(h: &mut Harness, count: usize) -> Result<CopyWorkload> {
        let values: Vec<[f32; 4]> =
            (0..count).map(|_| std::array::from_fn(|_| h.rng.random())).collect();
        Ok(CopyWorkload {
            groups: Groups::linear(count, COPY_PER_GROUP, h.device.limits())?,
            source: h.device.upload("source", &values)?,
            target: h.output("target", count)?,
            values,
        })
    }
}

impl Workload for CopyWorkload {
    fn record(&mut self, recorder: &mut Recorder) -> Result<()> {
        let params = CopyParams { count: self.values.len() as u32 };
        let args = CopyArgs { source: self.source.view(), target: self.target.view_mut() };
        recorder.dispatch::<Copy>(self.groups, params, args)
    }

    fn compare(&self, h: &mut Harness) -> Result<()> {
        let device = h.read(&self.target)?;
        h.exact("copy", &device, &self.values);
        Ok(())
    }

    fn work(&self) -> Work {
        Work { bytes: 32 * self.values.len() as u64, operations: 0 }
    }
}

fn copy(h: &mut Harness) -> Result<()> {
    for count in [1usize, 63, 511, 512, 513, 10_000] {
        let mut workload = CopyWorkload::new(h, count)?;
        h.execute_on(&format!("{count} vectors"), &mut workload)?;
    }
    Ok(())
}

/// Chains of multiplications and additions.
pub(crate) struct FmaWorkload {
    seeds: Vec<f32>,
    rounds: u32,
    groups: Groups,
    source: Buffer<f32>,
    sums: Guarded<f32>,
}

impl FmaWorkload {
    /// Draws and uploads the seeds of the chains.
    pub(crate) fn new(h: &mut Harness, count: usize, rounds: u32) -> Result<FmaWorkload> {
        let seeds: Vec<f32> = (0..count).map(|_| h.rng.random_range(-2.0f32..2.0)).collect();
        Ok(FmaWorkload {
            rounds,
            groups: Groups::linear(count, 64, h.device.limits())?,
            source: h.device.upload("seeds", &seeds)?,
            sums: h.output("sums", count)?,
            seeds,
        })
    }
}

impl Workload for FmaWorkload {
    fn record(&mut self, recorder: &mut Recorder) -> Result<()> {
        let params = FmaParams { count: self.seeds.len() as u32, rounds: self.rounds };
        let args = FmaArgs { seeds: self.source.view(), sums: self.sums.view_mut() };
        recorder.dispatch::<Fma>(self.groups, params, args)
    }

    fn compare(&self, h: &mut Harness) -> Result<()> {
        let device = h.read(&self.sums)?;
        let wide: Vec<f64> = self.seeds.iter().map(|&s| f64::from(s)).collect();
        // The chains have converged after a hundred rounds, so the oracle does not run them all.
        let rounds = self.rounds.min(100);
        let (truth, twin) = (roofline::fma(&wide, rounds), roofline::fma(&self.seeds, rounds));
        // Each step of a chain damps earlier rounding errors to three quarters; the sum adds 16
        // values of one sign.
        let bound = Bound { absolute: 0.0, relative: 1e-6 };
        h.close("sums", &device, &truth, Some(&twin), bound);
        Ok(())
    }

    fn work(&self) -> Work {
        let count = self.seeds.len() as u64;
        Work { bytes: 8 * count, operations: FMA_OPERATIONS * u64::from(self.rounds) * count }
    }
}

fn fma(h: &mut Harness) -> Result<()> {
    for (count, rounds) in [(1usize, 0), (64, 1), (1000, 3), (129, 80)] {
        let mut workload = FmaWorkload::new(h, count, rounds)?;
        h.execute_on(&format!("{count} seeds, {rounds} rounds"), &mut workload)?;
    }
    Ok(())
}
