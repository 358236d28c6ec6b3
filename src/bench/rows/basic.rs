//! Benchmarks of the peak measurements and of the ops on plain arrays: scan, sort, Adam.

use super::{sizes, thousands};
use crate::Result;
use crate::bench::job::{Entry, Job};
use crate::bench::scenes::rng;
use crate::bench::verify::Check;
use crate::check::Bound;
use crate::gpu::{Device, Groups};
use crate::kernels::roofline::{
    COPY_PER_GROUP, Copy, CopyArgs, CopyParams, FMA_OPERATIONS, Fma, FmaArgs, FmaParams,
};
use crate::ops::adam::{Adam, AdamArgs};
use crate::ops::scan::{Scan, ScanArgs};
use crate::ops::sort::{RadixSort, SortArgs};
use crate::oracle;
use crate::report::Work;
use crate::types::AdamSettings;
use rand::RngExt;

pub(super) fn entries(quick: bool) -> Vec<Entry> {
    let mut all = Vec::new();
    for bytes in sizes(quick, &[1usize << 22, 1 << 25]) {
        let size = format!("{} MiB each way", bytes >> 20);
        all.push(Entry::new("roofline/copy", size, move |d, seed| copy(d, seed, bytes / 16)));
    }
    for rounds in if quick { vec![250] } else { vec![1000, 5000] } {
        let size = format!("16,384 × 16 chains × {}", 4 * rounds);
        all.push(Entry::new("roofline/fma", size, move |d, seed| fma(d, seed, 1 << 14, rounds)));
    }
    for n in sizes(quick, &[1usize << 14, 1 << 17, 1 << 20]) {
        let size = format!("{} words", thousands(n));
        all.push(Entry::new("scan/exclusive", size, move |d, seed| scan(d, seed, n)));
    }
    for n in sizes(quick, &[1usize << 14, 1 << 17, 1 << 20]) {
        let size = format!("{} pairs", thousands(n));
        all.push(Entry::new("sort/pairs", size, move |d, seed| sort(d, seed, n)));
    }
    for n in sizes(quick, &[59_000usize, 590_000, 5_900_000]) {
        let size = format!("{} parameters", thousands(n));
        all.push(Entry::new("adam/step", size, move |d, seed| adam(d, seed, n)));
    }
    all
}

fn floats(seed: u64, n: usize) -> Vec<f32> {
    let mut rng = rng(seed);
    (0..n).map(|_| rng.random_range(-1.0f32..1.0)).collect()
}

fn copy(device: &Device, seed: u64, vectors: usize) -> Result<Job> {
    let values: Vec<[f32; 4]> = bytemuck::cast_slice(&floats(seed, 4 * vectors)).to_vec();
    let source = device.upload("copy source", &values)?;
    let mut target = device.buffer::<[f32; 4]>("copy target", vectors)?;
    let groups = Groups::linear(vectors, COPY_PER_GROUP, device.limits())?;
    let params = CopyParams { count: vectors as u32 };
    let mut stream = device.stream()?;
    let mut recorder = stream.record()?;
    let args = CopyArgs { source: source.view(), target: target.view_mut() };
    recorder.dispatch::<Copy>(groups, params, args)?;
    stream.submit(recorder)?;
    let mut check = Check::new();
    check.exact("copy", &stream.download(&target)?, &values);
    let work = Work { bytes: 32 * vectors as u64, operations: 0 };
    Job::recorded(device, check.accuracy(), work, move |recorder| {
        let args = CopyArgs { source: source.view(), target: target.view_mut() };
        recorder.dispatch::<Copy>(groups, params, args)
    })
}

fn fma(device: &Device, seed: u64, count: usize, rounds: u32) -> Result<Job> {
    let values = floats(seed, count);
    let seeds = device.upload("seeds", &values)?;
    let mut sums = device.buffer::<f32>("sums", count)?;
    let groups = Groups::linear(count, 64, device.limits())?;
    let params = FmaParams { count: count as u32, rounds };
    let mut stream = device.stream()?;
    let mut recorder = stream.record()?;
    let args = FmaArgs { seeds: seeds.view(), sums: sums.view_mut() };
    recorder.dispatch::<Fma>(groups, params, args)?;
    stream.submit(recorder)?;
    // The chains have converged after a hundred rounds, so the oracle does not run them all.
    let wide: Vec<f64> = values.iter().map(|&v| f64::from(v)).collect();
    let truth = oracle::roofline::fma(&wide, rounds.min(100));
    let mut check = Check::new();
    // As the case `roofline/fma`.
    let bound = Bound { absolute: 0.0, relative: 1e-6 };
    check.close("sums", &stream.download(&sums)?, &truth, bound);
    let work = Work {
        bytes: 8 * count as u64,
        operations: FMA_OPERATIONS * u64::from(rounds) * count as u64,
    };
    Job::recorded(device, check.accuracy(), work, move |recorder| {
        let args = FmaArgs { seeds: seeds.view(), sums: sums.view_mut() };
        recorder.dispatch::<Fma>(groups, params, args)
    })
}

fn scan(device: &Device, seed: u64, n: usize) -> Result<Job> {
    let mut rng = rng(seed);
    let values: Vec<u32> = (0..n).map(|_| rng.random_range(0..1000)).collect();
    let count = device.upload("count", &[n as u32])?;
    let input = device.upload("values", &values)?;
    let mut prefix = device.buffer::<u32>("prefix", n)?;
    let mut total = device.buffer::<u32>("total", 1)?;
    let op = Scan::plan(device, n)?;
    let mut scratch = op.scratch(device)?;
    macro_rules! args {
        () => {
            ScanArgs {
                count: count.view(),
                count_at: 0,
                values: input.view(),
                prefix: prefix.view_mut(),
                total: total.view_mut(),
                total_at: 0,
            }
        };
    }
    let mut stream = device.stream()?;
    let mut recorder = stream.record()?;
    op.record(&mut recorder, args!(), &mut scratch)?;
    stream.submit(recorder)?;
    let mut check = Check::new();
    check.exact("prefix", &stream.download(&prefix)?, &oracle::scan::exclusive(&values));
    check.exact("total", &stream.download(&total)?, &[oracle::scan::sum(&values)]);
    // The reduction and the sweep each read the values and add; the sweep writes them once.
    let work = Work { bytes: 12 * n as u64, operations: 2 * n as u64 };
    Job::recorded(device, check.accuracy(), work, move |recorder| {
        op.record(recorder, args!(), &mut scratch)
    })
}

fn sort(device: &Device, seed: u64, n: usize) -> Result<Job> {
    let mut rng = rng(seed);
    let keys: Vec<u32> = (0..n).map(|_| rng.random()).collect();
    let payload: Vec<u32> = (0..n as u32).collect();
    let count = device.upload("count", &[n as u32])?;
    let input = (device.upload("keys", &keys)?, device.upload("payload", &payload)?);
    let mut sorted_keys = device.buffer::<u32>("sorted keys", n)?;
    let mut sorted_payload = device.buffer::<u32>("sorted payload", n)?;
    let op = RadixSort::plan(device, n, 0..32)?;
    let mut scratch = op.scratch(device)?;
    macro_rules! args {
        () => {
            SortArgs {
                count: count.view(),
                count_at: 0,
                keys: input.0.view(),
                payload: input.1.view(),
                sorted_keys: sorted_keys.view_mut(),
                sorted_payload: sorted_payload.view_mut(),
            }
        };
    }
    let mut stream = device.stream()?;
    let mut recorder = stream.record()?;
    op.record(&mut recorder, args!(), &mut scratch)?;
    stream.submit(recorder)?;
    let truth = oracle::sort::by_bits(&keys, &payload, 0..32);
    let mut check = Check::new();
    check.exact("keys", &stream.download(&sorted_keys)?, &truth.0);
    check.exact("payload", &stream.download(&sorted_payload)?, &truth.1);
    // Four passes; each reads the keys to count them, and reads and writes the pairs to scatter
    // them.
    let work = Work { bytes: 4 * 20 * n as u64, operations: 4 * 2 * n as u64 };
    Job::recorded(device, check.accuracy(), work, move |recorder| {
        op.record(recorder, args!(), &mut scratch)
    })
}

fn adam(device: &Device, seed: u64, n: usize) -> Result<Job> {
    let (start, gradients) = (floats(seed, n), floats(seed + 1, n));
    let mut op = Adam::new(device)?;
    let settings = AdamSettings { rate: 1e-2, ..AdamSettings::default() };
    let source = device.upload("gradients", &gradients)?;
    let mut parameters = device.upload("parameters", &start)?;
    let zeros = vec![0.0f32; n];
    let mut first = device.upload("first moments", &zeros)?;
    let mut second = device.upload("second moments", &zeros)?;
    macro_rules! args {
        () => {
            AdamArgs {
                gradients: source.view(),
                parameters: parameters.view_mut(),
                first: first.view_mut(),
                second: second.view_mut(),
                visible: None,
            }
        };
    }
    let mut stream = device.stream()?;
    let mut recorder = stream.record()?;
    op.record(&mut recorder, &settings, args!())?;
    stream.submit(recorder)?;
    let wide = |values: &[f32]| -> Vec<f64> { values.iter().map(|&v| f64::from(v)).collect() };
    let (mut truth, mut m, mut v) = (wide(&start), vec![0.0; n], vec![0.0; n]);
    let by = wide(&gradients);
    oracle::adam::step(&settings, 1, None, &by, &mut truth, &mut m, &mut v);
    let mut check = Check::new();
    // As the cases of `adam`.
    let bound = Bound { absolute: 1e-6, relative: 0.0 };
    check.close("parameters", &stream.download(&parameters)?, &truth, bound);
    // Reads four arrays, writes three; multiplications, additions, a root and a quotient.
    let work = Work { bytes: 28 * n as u64, operations: 14 * n as u64 };
    Job::recorded(device, check.accuracy(), work, move |recorder| {
        op.record(recorder, &settings, args!())
    })
}
