//! Check cases of the radix sort, against a stable comparison sort.

use super::{Case, Guarded, Harness, Workload};
use crate::error::Result;
use crate::gpu::{Buffer, Recorder};
use crate::ops::sort::{RadixSort, SortArgs, SortScratch};
use crate::oracle::sort;
use crate::types::Work;
use rand::RngExt;
use std::ops::Range;

/// The family's cases.
pub const CASES: &[Case] = &[
    Case { id: "sort/sizes", run: sizes },
    Case { id: "sort/powers_of_two", run: powers_of_two },
    Case { id: "sort/bit_ranges", run: bit_ranges },
    Case { id: "sort/orders", run: orders },
    Case { id: "sort/count_below_capacity", run: count_below_capacity },
];

/// A sort of `count` of the pairs (key, index); the elements after them must stay unchanged.
pub(crate) struct SortWorkload {
    keys: Vec<u32>,
    payload: Vec<u32>,
    count: usize,
    bits: Range<u32>,
    op: RadixSort,
    scratch: SortScratch,
    counts: Buffer<u32>,
    key_buffer: Buffer<u32>,
    payload_buffer: Buffer<u32>,
    sorted_keys: Guarded<u32>,
    sorted_payload: Guarded<u32>,
}

impl SortWorkload {
    /// Uploads the pairs.
    pub(crate) fn new(
        h: &mut Harness,
        keys: Vec<u32>,
        count: usize,
        bits: Range<u32>,
    ) -> Result<SortWorkload> {
        let op = RadixSort::plan(&h.device, keys.len(), bits.clone())?;
        let payload: Vec<u32> = (0..keys.len() as u32).collect();
        Ok(SortWorkload {
            scratch: op.scratch(&h.device)?,
            op,
            counts: h.device.upload("count", &[7, count as u32])?,
            key_buffer: h.device.upload("keys", &keys)?,
            payload_buffer: h.device.upload("payload", &payload)?,
            sorted_keys: h.output("sorted keys", keys.len())?,
            sorted_payload: h.output("sorted payload", keys.len())?,
            keys,
            payload,
            count,
            bits,
        })
    }
}

impl Workload for SortWorkload {
    fn record(&mut self, recorder: &mut Recorder) -> Result<()> {
        let args = SortArgs {
            count: self.counts.view(),
            count_at: 1,
            keys: self.key_buffer.view(),
            payload: self.payload_buffer.view(),
            sorted_keys: self.sorted_keys.view_mut(),
            sorted_payload: self.sorted_payload.view_mut(),
        };
        self.op.record(recorder, args, &mut self.scratch)
    }

    fn compare(&self, h: &mut Harness) -> Result<()> {
        let sorted = self.count.min(self.keys.len());
        let (mut keys, mut payload) =
            sort::by_bits(&self.keys[..sorted], &self.payload[..sorted], self.bits.clone());
        keys.resize(self.keys.len(), u32::MAX);
        payload.resize(self.keys.len(), u32::MAX);
        let device = (h.read(&self.sorted_keys)?, h.read(&self.sorted_payload)?);
        h.exact("keys", &device.0, &keys);
        h.exact("payload", &device.1, &payload);
        let input = h.stream.download(&self.key_buffer)?;
        h.exact("input", &input, &self.keys);
        Ok(())
    }

    /// Each pass of 8 bits reads the keys to count them, and reads and writes the pairs to scatter them.
    fn work(&self) -> Work {
        let keys = (self.bits.len().div_ceil(8) * self.keys.len()) as u64;
        Work { bytes: 20 * keys, operations: 2 * keys }
    }
}

fn compare(
    h: &mut Harness,
    what: &str,
    keys: &[u32],
    count: usize,
    bits: Range<u32>,
) -> Result<()> {
    let mut workload = SortWorkload::new(h, keys.to_vec(), count, bits)?;
    h.execute_on(what, &mut workload)
}

fn random(harness: &mut Harness, n: usize) -> Vec<u32> {
    (0..n).map(|_| harness.rng.random()).collect()
}

fn sizes(harness: &mut Harness) -> Result<()> {
    for n in [
        0, 1, 2, 7, 255, 256, 257, 511, 513, 1023, 1024, 1025, 8191, 8192, 8193, 65_535, 65_537,
        200_003,
    ] {
        let keys = random(harness, n);
        compare(harness, &format!("{n} pairs"), &keys, n, 0..32)?;
    }
    Ok(())
}

/// Counts of 2^k, and one more and one less, up to several blocks.
fn powers_of_two(harness: &mut Harness) -> Result<()> {
    for n in (0..=17).flat_map(|k| [(1 << k) - 1, 1 << k, (1 << k) + 1]) {
        let keys = random(harness, n);
        compare(harness, &format!("{n} pairs"), &keys, n, 0..32)?;
    }
    Ok(())
}

/// One, two, three and four passes; ranges inside the key; bits that do not divide evenly.
fn bit_ranges(harness: &mut Harness) -> Result<()> {
    let keys = random(harness, 20_001);
    let ranges = [
        0..1,
        0..5,
        0..8,
        0..9,
        0..13,
        0..16,
        0..17,
        0..24,
        0..31,
        3..11,
        8..32,
        24..32,
        31..32,
        9..22,
        7..7,
        32..32,
    ];
    for bits in ranges {
        compare(harness, &format!("bits {bits:?}"), &keys, keys.len(), bits.clone())?;
    }
    Ok(())
}

fn orders(harness: &mut Harness) -> Result<()> {
    let n = 33_000;
    let ascending: Vec<u32> = (0..n as u32).map(|i| i * 100_003).collect();
    let descending: Vec<u32> = ascending.iter().rev().copied().collect();
    let few = (0..n).map(|_| harness.rng.random_range(0..3) * 0x0101_0101).collect::<Vec<u32>>();
    compare(harness, "sorted", &ascending, n, 0..32)?;
    compare(harness, "reversed", &descending, n, 0..32)?;
    compare(harness, "all equal", &vec![0x8000_0001; n], n, 0..32)?;
    compare(harness, "all ones", &vec![u32::MAX; n], n, 0..32)?;
    compare(harness, "three values", &few, n, 0..32)
}

fn count_below_capacity(harness: &mut Harness) -> Result<()> {
    let keys = random(harness, 10_000);
    for count in [0, 1, 257, 9999, 10_000, 1_000_000] {
        for bits in [0..16, 0..0, 7..7, 32..32] {
            compare(harness, &format!("{count} of 10,000, bits {bits:?}"), &keys, count, bits)?;
        }
    }
    Ok(())
}
