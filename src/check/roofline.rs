//! Check cases of the kernels that measure peak bandwidth and peak arithmetic.

use super::{Bound, Case, Harness};
use crate::error::Result;
use crate::gpu::Groups;
use crate::kernels::roofline::{
    COPY_PER_GROUP, Copy, CopyArgs, CopyParams, Fma, FmaArgs, FmaParams,
};
use crate::oracle::roofline;
use rand::RngExt;

/// The family's cases.
pub const CASES: &[Case] =
    &[Case { id: "roofline/copy", run: copy }, Case { id: "roofline/fma", run: fma }];

fn copy(harness: &mut Harness) -> Result<()> {
    for count in [1usize, 63, 511, 512, 513, 10_000] {
        let values: Vec<[f32; 4]> =
            (0..count).map(|_| std::array::from_fn(|_| harness.rng.random())).collect();
        let source = harness.device.upload("source", &values)?;
        let mut target = harness.output::<[f32; 4]>("target", count)?;
        let mut recorder = harness.stream.record()?;
        recorder.dispatch::<Copy>(
            Groups::linear(count, COPY_PER_GROUP, harness.device.limits())?,
            CopyParams { count: count as u32 },
            CopyArgs { source: source.view(), target: target.view_mut() },
        )?;
        harness.stream.submit(recorder)?;
        let got = harness.read(&target)?;
        harness.exact(&format!("{count} vectors"), &got, &values);
    }
    Ok(())
}

fn fma(harness: &mut Harness) -> Result<()> {
    for (count, rounds) in [(1usize, 0), (64, 1), (1000, 3), (129, 80)] {
        let seeds: Vec<f32> = (0..count).map(|_| harness.rng.random_range(-2.0f32..2.0)).collect();
        let source = harness.device.upload("seeds", &seeds)?;
        let mut sums = harness.output::<f32>("sums", count)?;
        let mut recorder = harness.stream.record()?;
        recorder.dispatch::<Fma>(
            Groups::linear(count, 64, harness.device.limits())?,
            FmaParams { count: count as u32, rounds },
            FmaArgs { seeds: source.view(), sums: sums.view_mut() },
        )?;
        harness.stream.submit(recorder)?;
        let got = harness.read(&sums)?;
        let wide: Vec<f64> = seeds.iter().map(|&s| f64::from(s)).collect();
        let truth = roofline::fma(&wide, rounds);
        let twin = roofline::fma(&seeds, rounds);
        // Each step of a chain damps earlier rounding errors to three quarters; the sum adds 16
        // values of one sign.
        let bound = Bound { absolute: 0.0, relative: 1e-6 };
        let what = format!("{count} seeds, {rounds} rounds");
        harness.close(&what, &got, &truth, Some(&twin), bound);
    }
    Ok(())
}
