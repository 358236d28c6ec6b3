//! Check cases of prefix sums.

use super::{Case, Harness};
use crate::error::Result;
use crate::ops::scan::{Scan, ScanArgs};
use crate::oracle::scan;
use rand::RngExt;

/// The family's cases.
pub const CASES: &[Case] = &[
    Case { id: "scan/sizes", run: sizes },
    Case { id: "scan/wraps", run: wraps },
    Case { id: "scan/count_below_capacity", run: count_below_capacity },
];

/// Scans `count` of the values and compares; the elements after them must stay unchanged.
fn compare(harness: &mut Harness, what: &str, values: &[u32], count: usize) -> Result<()> {
    let capacity = values.len();
    let counts = harness.device.upload("count", &[7, count as u32])?;
    let input = harness.device.upload("values", values)?;
    let mut prefix = harness.output::<u32>("prefix", capacity)?;
    let mut total = harness.output::<u32>("total", 2)?;
    let op = Scan::plan(&harness.device, capacity)?;
    let mut scratch = op.scratch(&harness.device)?;
    let mut recorder = harness.stream.record()?;
    op.record(
        &mut recorder,
        ScanArgs {
            count: counts.view(),
            count_at: 1,
            values: input.view(),
            prefix: prefix.view_mut(),
            total: total.view_mut(),
            total_at: 1,
        },
        &mut scratch,
    )?;
    harness.stream.submit(recorder)?;
    let scanned = count.min(capacity);
    let mut truth = scan::exclusive(&values[..scanned]);
    truth.resize(capacity, u32::MAX);
    let (prefix, total) = (harness.read(&prefix)?, harness.read(&total)?);
    harness.exact(&format!("{what}: prefix"), &prefix, &truth);
    harness.exact(&format!("{what}: total"), &total, &[u32::MAX, scan::sum(&values[..scanned])]);
    Ok(())
}

fn sizes(harness: &mut Harness) -> Result<()> {
    for n in [
        0, 1, 2, 255, 256, 257, 4095, 4096, 4097, 8192, 8193, 65_535, 131_071, 131_072, 131_073,
        300_001,
    ] {
        let values: Vec<u32> = (0..n).map(|_| harness.rng.random_range(0..1000)).collect();
        compare(harness, &format!("{n} values"), &values, n)?;
    }
    Ok(())
}

fn wraps(harness: &mut Harness) -> Result<()> {
    let values: Vec<u32> = (0..10_000).map(|_| harness.rng.random()).collect();
    compare(harness, "random words", &values, values.len())?;
    compare(harness, "all ones", &[u32::MAX; 5000], 5000)
}

fn count_below_capacity(harness: &mut Harness) -> Result<()> {
    let values: Vec<u32> = (0..20_000).map(|_| harness.rng.random_range(0..9)).collect();
    for count in [0, 1, 4096, 4097, 19_999, 20_000, 50_000] {
        compare(harness, &format!("{count} of 20,000"), &values, count)?;
    }
    Ok(())
}
