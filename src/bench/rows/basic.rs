//! Benchmarks of the peak measurements and of the ops on plain arrays: scan, sort, Adam.

use super::{sizes, thousands};
use crate::bench::job::{Entry, Job};
use crate::check::Harness;
use crate::check::adam::{AdamWorkload, BOUND};
use crate::check::roofline::{CopyWorkload, FmaWorkload};
use crate::check::scan::ScanWorkload;
use crate::check::sort::SortWorkload;
use rand::RngExt;

pub(super) fn entries(quick: bool) -> Vec<Entry> {
    let mut all = Vec::new();
    for bytes in sizes(quick, &[1usize << 22, 1 << 25]) {
        let size = format!("{} MiB each way", bytes >> 20);
        all.push(Entry::new("roofline/copy", size, move |d, seed| {
            Job::of(d, seed, |h| CopyWorkload::new(h, bytes / 16))
        }));
    }
    for rounds in if quick { vec![250] } else { vec![1000, 5000] } {
        let size = format!("16,384 × 16 chains × {}", 4 * rounds);
        all.push(Entry::new("roofline/fma", size, move |d, seed| {
            Job::of(d, seed, |h| FmaWorkload::new(h, 1 << 14, rounds))
        }));
    }
    for n in sizes(quick, &[1usize << 14, 1 << 17, 1 << 20]) {
        all.push(Entry::new(
            "scan/exclusive",
            format!("{} words", thousands(n)),
            move |d, seed| {
                Job::of(d, seed, |h| {
                    let values = (0..n).map(|_| h.rng.random_range(0..1000)).collect();
                    ScanWorkload::new(h, values, n)
                })
            },
        ));
    }
    for n in sizes(quick, &[1usize << 14, 1 << 17, 1 << 20]) {
        all.push(Entry::new("sort/pairs", format!("{} pairs", thousands(n)), move |d, seed| {
            Job::of(d, seed, |h| {
                let keys = (0..n).map(|_| h.rng.random()).collect();
                SortWorkload::new(h, keys, n, 0..32)
            })
        }));
    }
    for n in sizes(quick, &[59_000usize, 590_000, 5_900_000]) {
        let size = format!("{} parameters", thousands(n));
        all.push(Entry::new("adam/step", size, move |d, seed| {
            Job::of(d, seed, |h| {
                let (start, gradients) = (floats(h, n), [floats(h, n)]);
                AdamWorkload::new(h, &start, &gradients, None, 1e-2, BOUND)
            })
        }));
    }
    all
}

fn floats(h: &mut Harness, n: usize) -> Vec<f32> {
    (0..n).map(|_| h.rng.random_range(-1.0f32..1.0)).collect()
}
