//! Density control: relocation (3DGS-MCMC) and the classical decisions with their compaction.

use super::{sizes, thousands};
use crate::Result;
use crate::bench::job::{Entry, Job};
use crate::bench::scenes::rng;
use crate::bench::verify::Check;
use crate::check::Bound;
use crate::gpu::Device;
use crate::ops::density::{Adaptation, AdaptationArgs, Relocation, RelocationArgs};
use crate::oracle::density;
use crate::report::{Place, Work};
use crate::types::{AdaptSettings, MotionClass};
use rand::RngExt;
use std::cell::RefCell;
use std::rc::Rc;

const SEED: u32 = 11;
const STEP: u32 = 2;

pub(super) fn entries(quick: bool) -> Vec<Entry> {
    let mut all = Vec::new();
    for n in sizes(quick, &[10_000usize, 200_000]) {
        let size = format!("{} Gaussians", thousands(n));
        all.push(Entry::new("density/relocate", size.clone(), move |d, s| relocate(d, s, n)));
        all.push(Entry::new("density/adapt", size, move |d, s| adapt(d, s, n)));
    }
    all
}

fn relocate(device: &Device, seed: u64, n: usize) -> Result<Job> {
    let mut rng = rng(seed);
    // A tenth is dead, as in a round of training.
    let logits: Vec<f32> = (0..n).map(|_| rng.random_range(-6.2f32..5.0)).collect();
    let scales: Vec<f32> = (0..3 * n).map(|_| rng.random_range(-5.0f32..0.0)).collect();
    let mut logit_buffer = device.upload("logits", &logits)?;
    let mut scale_buffer = device.upload("scales", &scales)?;
    let mut op = Relocation::new(device, n)?;
    let mut stream = device.stream()?;
    let class = MotionClass::Any;
    macro_rules! args {
        ($logits:expr, $scales:expr) => {
            RelocationArgs {
                opacity_logits: $logits,
                log_scales: $scales,
                motion_logits: None,
                class,
                seed: SEED,
                step: STEP,
            }
        };
    }
    let mut weights = device.buffer::<u32>("weights", n)?;
    let mut targets = device.buffer::<u32>("targets", n)?;
    let mut recorder = stream.record()?;
    op.relocate(&mut recorder, args!(logit_buffer.view_mut(), scale_buffer.view_mut()))?;
    op.copy(&mut recorder, logit_buffer.view_mut(), 1)?;
    op.copy(&mut recorder, scale_buffer.view_mut(), 3)?;
    recorder.copy(op.weights(), weights.view_mut());
    recorder.copy(op.target_from_slot(), targets.view_mut());
    stream.submit(recorder)?;

    let mut check = Check::new();
    let got = stream.download(&weights)?;
    let slots = density::dead::<f32>(&logits, &[], class);
    let drawn = density::draw(&got, slots.len(), SEED, STEP);
    check.exact("targets", &stream.download(&targets)?[..slots.len()], &drawn);
    let mut exact: Vec<f64> = logits.iter().map(|&l| f64::from(l)).collect();
    let mut exact_scales: Vec<[f64; 3]> =
        scales.chunks_exact(3).map(|s| [s[0], s[1], s[2]].map(f64::from)).collect();
    density::relocate(&drawn, &mut exact, &mut exact_scales);
    for (&slot, &target) in slots.iter().zip(&drawn).filter(|(_, t)| **t != u32::MAX) {
        exact[slot as usize] = exact[target as usize];
        exact_scales[slot as usize] = exact_scales[target as usize];
    }
    // As the cases of `density`.
    let bound = Bound { absolute: 5e-6, relative: 2e-6 };
    check.close("opacity logits", &stream.download(&logit_buffer)?, &exact, bound);
    let got = stream.download(&scale_buffer)?;
    check.close("log-scales", &got, exact_scales.as_flattened(), bound);

    // Weights and flags are written, summed and looked up; every dead row is copied.
    let dead = slots.len() as u64;
    let work = Work { bytes: n as u64 * 40 + dead * 64, operations: n as u64 * 12 + dead * 60 };
    let (mut upload, mut stream) = (device.stream()?, device.stream()?);
    let state = Rc::new(RefCell::new((logit_buffer, scale_buffer)));
    let again = state.clone();
    Ok(Job {
        accuracy: check.accuracy(),
        work,
        place: Place::Device,
        reset: Some(Box::new(move || {
            let (l, s) = &mut *again.borrow_mut();
            upload.upload(l, &logits)?;
            upload.upload(s, &scales)
        })),
        execute: Box::new(move || {
            let (l, s) = &mut *state.borrow_mut();
            let mut recorder = stream.record()?;
            op.relocate(&mut recorder, args!(l.view_mut(), s.view_mut()))?;
            op.copy(&mut recorder, l.view_mut(), 1)?;
            op.copy(&mut recorder, s.view_mut(), 3)?;
            let ticket = stream.submit(recorder)?;
            stream.wait(ticket)?;
            Ok(None)
        }),
    })
}

fn adapt(device: &Device, seed: u64, n: usize) -> Result<Job> {
    let settings = AdaptSettings { gradient: 2e-4, small: 0.05, opacity: 0.005, large: 0.9 };
    let mut rng = rng(seed);
    let statistics: Vec<f32> = (0..n)
        .flat_map(|_| {
            let views = rng.random_range(1..5u32) as f32;
            [rng.random_range(0.0f32..3e-4) * views, views]
        })
        .collect();
    let logits: Vec<f32> = (0..n).map(|_| rng.random_range(-6.0f32..3.0)).collect();
    let scales: Vec<f32> = (0..3 * n).map(|_| rng.random_range(-6.0f32..0.0)).collect();
    let capacity = 2 * n;
    let statistics_buffer = device.upload("statistics", &statistics)?;
    let logit_buffer = device.upload("logits", &logits)?;
    let scale_buffer = device.upload("scales", &scales)?;
    let mut gathered = device.buffer::<f32>("gathered", 3 * capacity)?;
    let mut op = Adaptation::new(device, capacity)?;
    let mut rows = device.buffer::<u32>("rows", capacity)?;
    macro_rules! args {
        () => {
            AdaptationArgs {
                statistics: statistics_buffer.view(),
                opacity_logits: logit_buffer.view(),
                log_scales: scale_buffer.view(),
            }
        };
    }
    let mut stream = device.stream()?;
    let mut recorder = stream.record()?;
    op.plan(&mut recorder, &settings, args!())?;
    op.gather(&mut recorder, scale_buffer.view(), gathered.view_mut(), 3, false)?;
    recorder.copy(op.source_from_row(), rows.view_mut());
    stream.submit(recorder)?;
    let triples: Vec<[f32; 3]> = bytemuck::cast_slice(&scales).to_vec();
    let pairs: Vec<[f32; 2]> = bytemuck::cast_slice(&statistics).to_vec();
    let actions = density::decide::<f32>(&settings, &pairs, &logits, &triples);
    let layout = density::layout(&actions, capacity);
    let codes: Vec<u32> =
        layout.iter().map(|&(source, origin)| source | (origin as u32) << 30).collect();
    let mut check = Check::new();
    check.exact("rows", &stream.download(&rows)?[..codes.len()], &codes);
    let truth = density::gather::<f32>(&layout, 3, &scales, false);
    check.exact("gathered", &stream.download(&gathered)?[..truth.len()], &truth);
    let (n, kept) = (n as u64, layout.len() as u64);
    let work = Work { bytes: n * (24 + 40) + kept * 28, operations: n * 20 };
    Job::recorded(device, check.accuracy(), work, move |recorder| {
        op.plan(recorder, &settings, args!())?;
        op.gather(recorder, scale_buffer.view(), gathered.view_mut(), 3, false)
    })
}
