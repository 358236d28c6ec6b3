//! Check cases of the radix sort, against a stable comparison sort.

use super::{Case, Harness};
use crate::error::Result;
use crate::ops::sort::{RadixSort, SortArgs};
use crate::oracle::sort;
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

/// Sorts `count` of the pairs (key, index) and compares; the elements after them must stay
/// unchanged.
fn compare(
    harness: &mut Harness,
    what: &str,
    keys: &[u32],
    count: usize,
    bits: Range<u32>,
) -> Result<()> {
    let capacity = keys.len();
    let op = RadixSort::plan(&harness.device, capacity, bits.clone())?;
    let payload: Vec<u32> = (0..capacity as u32).collect();
    let counts = harness.device.upload("count", &[7, count as u32])?;
    let input = (harness.device.upload("keys", keys)?, harness.device.upload("payload", &payload)?);
    let mut sorted_keys = harness.output::<u32>("sorted keys", capacity)?;
    let mut sorted_payload = harness.output::<u32>("sorted payload", capacity)?;
    let mut scratch = op.scratch(&harness.device)?;
    let mut recorder = harness.stream.record()?;
    op.record(
        &mut recorder,
        SortArgs {
            count: counts.view(),
            count_at: 1,
            keys: input.0.view(),
            payload: input.1.view(),
            sorted_keys: sorted_keys.view_mut(),
            sorted_payload: sorted_payload.view_mut(),
        },
        &mut scratch,
    )?;
    harness.stream.submit(recorder)?;
    let sorted = count.min(capacity);
    let mut truth = sort::by_bits(&keys[..sorted], &payload[..sorted], bits);
    truth.0.resize(capacity, u32::MAX);
    truth.1.resize(capacity, u32::MAX);
    let (sorted_keys, sorted_payload) =
        (harness.read(&sorted_keys)?, harness.read(&sorted_payload)?);
    harness.exact(&format!("{what}: keys"), &sorted_keys, &truth.0);
    harness.exact(&format!("{what}: payload"), &sorted_payload, &truth.1);
    let input = harness.stream.download(&input.0)?;
    harness.exact(&format!("{what}: input"), &input, keys);
    Ok(())
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
