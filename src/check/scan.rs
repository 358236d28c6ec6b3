//! Check cases of prefix sums.

use super::{Case, Guarded, Harness, Workload};
use crate::error::Result;
use crate::gpu::{Buffer, Recorder};
use crate::ops::scan::{Scan, ScanArgs, ScanScratch};
use crate::oracle::scan;
use crate::types::Work;
use rand::RngExt;

/// The family's cases.
pub const CASES: &[Case] = &[
    Case { id: "scan/sizes", run: sizes },
    Case { id: "scan/wraps", run: wraps },
    Case { id: "scan/count_below_capacity", run: count_below_capacity },
];

/// A scan of `count` of the values; the elements after them must stay unchanged.
pub(crate) struct ScanWorkload {
    values: Vec<u32>,
    count: usize,
    op: Scan,
    scratch: ScanScratch,
    counts: Buffer<u32>,
    input: Buffer<u32>,
    prefix: Guarded<u32>,
    total: Guarded<u32>,
}

impl ScanWorkload {
    /// Uploads the values.
    pub(crate) fn new(h: &mut Harness, values: Vec<u32>, count: usize) -> Result<ScanWorkload> {
        let op = Scan::plan(&h.device, values.len())?;
        Ok(ScanWorkload {
            scratch: op.scratch(&h.device)?,
            op,
            counts: h.device.upload("count", &[7, count as u32])?,
            input: h.device.upload("values", &values)?,
            prefix: h.output("prefix", values.len())?,
            total: h.output("total", 2)?,
            values,
            count,
        })
    }
}

impl Workload for ScanWorkload {
    fn record(&mut self, recorder: &mut Recorder) -> Result<()> {
        let args = ScanArgs {
            count: self.counts.view(),
            count_at: 1,
            values: self.input.view(),
            prefix: self.prefix.view_mut(),
            total: self.total.view_mut(),
            total_at: 1,
        };
        self.op.record(recorder, args, &mut self.scratch)
    }

    fn compare(&self, h: &mut Harness) -> Result<()> {
        let scanned = &self.values[..self.count.min(self.values.len())];
        let mut truth = scan::exclusive(scanned);
        truth.resize(self.values.len(), u32::MAX);
        let (prefix, total) = (h.read(&self.prefix)?, h.read(&self.total)?);
        h.exact("prefix", &prefix, &truth);
        h.exact("total", &total, &[u32::MAX, scan::sum(scanned)]);
        Ok(())
    }

    /// The reduction and the sweep each read the values and add; the sweep writes them once.
    fn work(&self) -> Work {
        let n = self.values.len() as u64;
        Work { bytes: 12 * n, operations: 2 * n }
    }
}

fn compare(h: &mut Harness, what: &str, values: Vec<u32>, count: usize) -> Result<()> {
    let mut workload = ScanWorkload::new(h, values, count)?;
    h.execute_on(what, &mut workload)
}

fn sizes(harness: &mut Harness) -> Result<()> {
    for n in [
        0, 1, 2, 255, 256, 257, 4095, 4096, 4097, 8192, 8193, 65_535, 131_071, 131_072, 131_073,
        300_001,
    ] {
        let values: Vec<u32> = (0..n).map(|_| harness.rng.random_range(0..1000)).collect();
        compare(harness, &format!("{n} values"), values, n)?;
    }
    Ok(())
}

fn wraps(harness: &mut Harness) -> Result<()> {
    let values: Vec<u32> = (0..10_000).map(|_| harness.rng.random()).collect();
    compare(harness, "random words", values, 10_000)?;
    compare(harness, "all ones", vec![u32::MAX; 5000], 5000)
}

fn count_below_capacity(harness: &mut Harness) -> Result<()> {
    let values: Vec<u32> = (0..20_000).map(|_| harness.rng.random_range(0..9)).collect();
    for count in [0, 1, 4096, 4097, 19_999, 20_000, 50_000] {
        compare(harness, &format!("{count} of 20,000"), values.clone(), count)?;
    }
    Ok(())
}
