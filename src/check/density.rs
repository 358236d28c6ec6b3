//! Check cases of density control.

use super::{Bound, Case, Harness};
use crate::error::Result;
use crate::ops::density::{
    Adaptation, AdaptationArgs, JitterArgs, Relocation, RelocationArgs, accumulate, jitter,
    regularise, reset_opacity,
};
use crate::oracle::{Real, density};
use crate::types::{AdaptSettings, MotionClass};
use rand::RngExt;

/// The family's cases.
pub const CASES: &[Case] = &[
    Case { id: "density/relocate", run: relocate },
    Case { id: "density/grow", run: grow },
    Case { id: "density/shrink", run: shrink },
    Case { id: "density/jitter", run: noise },
    Case { id: "density/adapt", run: adapt },
    Case { id: "density/regularise", run: regularisers },
    Case { id: "density/central_differences", run: central_differences },
    Case { id: "density/statistics", run: statistics },
];

fn reals<R: Real>(values: &[f32]) -> Vec<R> {
    values.iter().map(|&v| R::of(f64::from(v))).collect()
}

fn rows<R: Real, const N: usize>(values: &[f32]) -> Vec<[R; N]> {
    values.chunks(N).map(|row| std::array::from_fn(|c| R::of(f64::from(row[c])))).collect()
}

fn random(h: &mut Harness, count: usize, low: f32, high: f32) -> Vec<f32> {
    (0..count).map(|_| h.rng.random_range(low..high)).collect()
}

/// The input of one round of relocation or growth.
struct Round {
    logits: Vec<f32>,
    scales: Vec<f32>,
    motion: Vec<f32>,
    class: MotionClass,
    grown: usize,
}

const SEED: u32 = 77;
const STEP: u32 = 3;

impl Round {
    fn run(&self, h: &mut Harness) -> Result<()> {
        let (count, after) = (self.logits.len(), self.logits.len() + self.grown);
        let payload: Vec<f32> = (0..5 * after).map(|i| i as f32).collect();
        let device = h.device.clone();
        let motion = device.upload("motion logits", &self.motion)?;
        let (source_logits, source_scales, source_payload) = (
            device.upload("logits", &self.logits)?,
            device.upload("scales", &self.scales)?,
            device.upload("payload", &payload)?,
        );
        let mut logits = h.output::<f32>("opacity logits", after)?;
        let mut scales = h.output::<f32>("log-scales", 3 * after)?;
        let mut values = h.output::<f32>("payload", 5 * after)?;
        let mut moments = h.output::<f32>("moments", 5 * after)?;
        let mut weights = h.output::<u32>("weights", count)?;
        let mut totals = h.output::<u32>("totals", 2)?;
        let mut slots = h.output::<u32>("slots", after)?;
        let mut targets = h.output::<u32>("targets", after)?;
        // The round uses arrays of exact length; growth copies into longer arrays.
        let mut work_logits = device.buffer::<f32>("logits in work", count)?;
        let mut work_scales = device.buffer::<f32>("scales in work", 3 * count)?;
        let mut op = Relocation::new(&device, after)?;
        let mut recorder = h.stream.record()?;
        recorder.copy(source_logits.view(), work_logits.view_mut());
        recorder.copy(source_scales.view(), work_scales.view_mut());
        recorder.copy(source_payload.view(), values.view_mut());
        recorder.copy(source_payload.view(), moments.view_mut());
        let args = RelocationArgs {
            opacity_logits: work_logits.view_mut(),
            log_scales: work_scales.view_mut(),
            motion_logits: (!self.motion.is_empty()).then(|| motion.view()),
            class: self.class,
            seed: SEED,
            step: STEP,
        };
        match self.grown {
            0 => op.relocate(&mut recorder, args)?,
            grown => op.grow(&mut recorder, args, grown)?,
        }
        recorder.copy(work_logits.view(), logits.view_mut().range(0..count));
        recorder.copy(work_scales.view(), scales.view_mut().range(0..3 * count));
        op.copy(&mut recorder, logits.view_mut(), 1)?;
        op.copy(&mut recorder, scales.view_mut(), 3)?;
        op.copy(&mut recorder, values.view_mut(), 5)?;
        op.zero(&mut recorder, moments.view_mut(), 5)?;
        recorder.copy(op.weights().range(0..count), weights.view_mut());
        recorder.copy(op.totals(), totals.view_mut());
        recorder.copy(op.row_from_slot(), slots.view_mut());
        recorder.copy(op.target_from_slot(), targets.view_mut());
        h.stream.submit(recorder)?;

        // Weights are rounded exponentials, so f32 may be off by one.
        let device_weights = h.read(&weights)?;
        let truth =
            density::draw_weights::<f64>(&reals(&self.logits), &reals(&self.motion), self.class);
        let as_float =
            |weights: &[u32]| -> Vec<f32> { weights.iter().map(|&w| w as f32).collect() };
        let truth: Vec<f64> = truth.iter().map(|&w| f64::from(w)).collect();
        let one_off = Bound { absolute: 1.0, relative: 0.0 };
        h.close("weights", &as_float(&device_weights), &truth, None, one_off);

        // Given the device's own weights, all further results are exact.
        let expected_slots: Vec<u32> = match self.grown {
            0 => density::dead::<f32>(&self.logits, &self.motion, self.class),
            _ => (count as u32..after as u32).collect(),
        };
        let mut expected = density::draw(&device_weights, expected_slots.len(), SEED, STEP);
        if self.grown > 0 && device_weights.iter().all(|&w| w == 0) {
            expected.fill(0);
        }
        let device_totals = h.read(&totals)?;
        let sum = device_weights.iter().sum::<u32>();
        h.exact("totals", &device_totals, &[sum, expected_slots.len() as u32]);
        let filled = expected_slots.len();
        let device_slots = h.read(&slots)?;
        h.exact("slots", &device_slots[..filled], &expected_slots);
        let device_targets = h.read(&targets)?;
        h.exact("targets", &device_targets[..filled], &expected);

        let new = self.after::<f64>(&expected_slots, &expected);
        let twin = self.after::<f32>(&expected_slots, &expected);
        // Measured 1e-6: logits of ten and more, and an exponential between.
        let bound = Bound { absolute: 5e-6, relative: 2e-6 };
        let device_logits = h.read(&logits)?;
        h.close("opacity logits", &device_logits, &new.0, Some(&twin.0), bound);
        let device_scales = h.read(&scales)?;
        h.close("log-scales", &device_scales, &new.1, Some(&twin.1), bound);

        let (mut copied, mut zeroed) = (payload.clone(), payload);
        for (&slot, &target) in expected_slots.iter().zip(&expected) {
            if target == u32::MAX {
                continue;
            }
            let (slot, target) = (slot as usize, target as usize);
            for c in 0..5 {
                copied[5 * slot + c] = (5 * target + c) as f32;
                zeroed[5 * slot + c] = 0.0;
                if device_weights[target] > 0 {
                    zeroed[5 * target + c] = 0.0;
                }
            }
        }
        let device_values = h.read(&values)?;
        h.exact("copied rows", &device_values, &copied);
        let device_moments = h.read(&moments)?;
        h.exact("zeroed rows", &device_moments, &zeroed);
        Ok(())
    }

    /// Opacity logits and log-scales after the round.
    fn after<R: Real>(&self, slots: &[u32], targets: &[u32]) -> (Vec<R>, Vec<R>) {
        let mut logits = reals::<R>(&self.logits);
        let mut scales = rows::<R, 3>(&self.scales);
        let drawn: Vec<u32> = match logits.iter().all(|&l| density::is_dead(l)) {
            true => Vec::new(),
            false => targets.to_vec(),
        };
        density::relocate(&drawn, &mut logits, &mut scales);
        logits.resize(logits.len() + self.grown, R::zero());
        scales.resize(scales.len() + self.grown, [R::zero(); 3]);
        for (&slot, &target) in slots.iter().zip(targets) {
            if target != u32::MAX {
                logits[slot as usize] = logits[target as usize];
                scales[slot as usize] = scales[target as usize];
            }
        }
        (logits, scales.concat())
    }
}

fn relocate(h: &mut Harness) -> Result<()> {
    for (count, low) in [(1000, -9.0f32), (65, -6.0), (5000, -30.0), (1, -9.0), (0, 0.0)] {
        for class in [MotionClass::Any, MotionClass::Static, MotionClass::Dynamic] {
            let mut logits = random(h, count, low, low + 12.0);
            for (i, logit) in [40.0, -40.0].into_iter().enumerate() {
                if count > 10 {
                    logits[3 + i] = logit;
                }
            }
            let scales = random(h, 3 * count, -5.0, 0.0);
            let motion = random(h, count, -1.0, 1.0);
            Round { logits, scales, motion, class, grown: 0 }.run(h)?;
        }
    }
    // Opacities near 0.01, where ln(1 + x) of a rounded 1 + x loses most of its digits.
    let logits: Vec<f32> =
        (0..4000).map(|i| if i % 2 == 0 { -8.0 } else { h.rng.random_range(-4.7..-4.4) }).collect();
    let (scales, class) = (vec![0.0; 3 * logits.len()], MotionClass::Any);
    Round { logits, scales, motion: Vec::new(), class, grown: 0 }.run(h)?;
    // If all are dead, or none is, nothing changes.
    for logit in [-8.0, 2.0] {
        let (logits, scales) = (vec![logit; 70], vec![0.5; 210]);
        let class = MotionClass::Any;
        Round { logits, scales, motion: Vec::new(), class, grown: 0 }.run(h)?;
    }
    Ok(())
}

fn grow(h: &mut Harness) -> Result<()> {
    for (count, grown) in [(1000, 50), (64, 64), (3, 40), (1, 200)] {
        let (logits, scales) = (random(h, count, -4.0, 6.0), random(h, 3 * count, -5.0, 0.0));
        let class = MotionClass::Any;
        Round { logits, scales, motion: Vec::new(), class, grown }.run(h)?;
    }
    // All are dead: the first is copied unchanged.
    let (logits, scales) = (vec![-8.0; 5], vec![0.5; 15]);
    Round { logits, scales, motion: Vec::new(), class: MotionClass::Any, grown: 3 }.run(h)
}

/// The integral on the device against the oracle's, which is finer, over all opacities and numbers of
/// copies: one live Gaussian takes every draw.
fn shrink(h: &mut Harness) -> Result<()> {
    for share in [2usize, 3, 5, 10, 25, 51, 80] {
        for logit in [-5.2f32, -3.0, -1.0, 0.0, 1.5, 4.0, 8.0, 15.0, 40.0] {
            let mut logits = vec![-40.0; share];
            logits[share / 2] = logit;
            let scales = vec![-2.0; 3 * share];
            let class = MotionClass::Any;
            Round { logits, scales, motion: Vec::new(), class, grown: 0 }.run(h)?;
        }
    }
    Ok(())
}

fn noise(h: &mut Harness) -> Result<()> {
    let count = 1000;
    let positions = random(h, 3 * count, -1.0, 1.0);
    let mut scales = random(h, 3 * count, -4.0, 0.0);
    let mut quaternions = random(h, 4 * count, -1.0, 1.0);
    let mut logits = random(h, count, -9.0, 3.0);
    scales[0] = 60.0;
    scales[4] = f32::NAN;
    quaternions[8..12].fill(0.0);
    quaternions[13] = f32::NAN;
    (logits[5], logits[6], logits[7]) = (40.0, -40.0, f32::NAN);
    let rotations: Vec<[f32; 4]> = rows(&quaternions);
    let source = h.device.upload("positions", &positions)?;
    let scale_buffer = h.device.upload("scales", &scales)?;
    let rotation_buffer = h.device.upload("rotations", &rotations)?;
    let logit_buffer = h.device.upload("logits", &logits)?;
    let mut moved = h.output::<f32>("positions", 3 * count)?;
    let mut recorder = h.stream.record()?;
    recorder.copy(source.view(), moved.view_mut());
    let size = 0.5;
    jitter(
        &mut recorder,
        JitterArgs {
            positions: moved.view_mut(),
            log_scales: scale_buffer.view(),
            rotations: rotation_buffer.view(),
            opacity_logits: logit_buffer.view(),
            size,
            seed: SEED,
            step: STEP,
        },
    )?;
    h.stream.submit(recorder)?;
    fn oracle<R: Real>(values: [&[f32]; 4], size: f32) -> Vec<R> {
        let [positions, scales, quaternions, logits] = values;
        let mut moved = rows::<R, 3>(positions);
        let (scales, rotations) = (rows::<R, 3>(scales), rows::<R, 4>(quaternions));
        let size = R::of(f64::from(size));
        density::jitter(&mut moved, &scales, &rotations, &reals(logits), size, SEED, STEP);
        moved.concat()
    }
    // In f64 the huge Gaussian's step of e^120 is finite; the range of f32 decides.
    let mut kept = scales.clone();
    kept[..3].fill(f32::NAN);
    let truth = oracle::<f64>([&positions, &kept, &quaternions, &logits], size);
    let twin = oracle::<f32>([&positions, &scales, &quaternions, &logits], size);
    let device = h.read(&moved)?;
    // Steps of up to 1 through a logarithm, a root and a cosine.
    let bound = Bound { absolute: 3e-6, relative: 0.0 };
    h.close("positions", &device, &truth, Some(&twin), bound);
    Ok(())
}

fn adapt(h: &mut Harness) -> Result<()> {
    let settings = AdaptSettings { gradient: 2e-4, small: 0.05, opacity: 0.005, large: 0.9 };
    for (count, capacity) in [(1000, 2000), (1000, 1100), (70, 70), (1, 2), (0, 4)] {
        // Values that straddle every threshold.
        let statistics: Vec<f32> = (0..count)
            .flat_map(|_| {
                let views = h.rng.random_range(0..5u32) as f32;
                [h.rng.random_range(0.0f32..4e-4) * views, views]
            })
            .collect();
        let mut logits = random(h, count, -6.0, 3.0);
        let mut scales = random(h, 3 * count, -6.0, 0.0);
        if count > 20 {
            logits[3] = f32::NAN;
            scales[15] = f32::NAN;
            (logits[9], logits[10]) = (40.0, -40.0);
        }
        let positions = random(h, 3 * count, -1.0, 1.0);
        let quaternions = random(h, 4 * count, -1.0, 1.0);
        adapt_once(
            h,
            &settings,
            capacity,
            [&statistics, &logits, &scales, &positions, &quaternions],
        )?;
    }
    Ok(())
}

fn adapt_once(
    h: &mut Harness,
    settings: &AdaptSettings,
    capacity: usize,
    [statistics, logits, scales, positions, quaternions]: [&[f32]; 5],
) -> Result<()> {
    let device = h.device.clone();
    let statistics_buffer = device.upload("statistics", statistics)?;
    let logit_buffer = device.upload("logits", logits)?;
    let scale_buffer = device.upload("scales", scales)?;
    let position_buffer = device.upload("positions", positions)?;
    let rotation_buffer = device.upload("rotations", quaternions)?;
    let mut new_scales = h.output::<f32>("log-scales", 3 * capacity)?;
    let mut new_positions = h.output::<f32>("positions", 3 * capacity)?;
    let mut moments = h.output::<f32>("moments", 3 * capacity)?;
    let mut new_rotations = device.buffer::<[f32; 4]>("rotations", capacity)?;
    let mut totals = h.output::<u32>("totals", 3)?;
    let mut new_rows = h.output::<u32>("rows", capacity)?;
    let mut op = Adaptation::new(&device, capacity)?;
    let mut recorder = h.stream.record()?;
    op.plan(
        &mut recorder,
        settings,
        AdaptationArgs {
            statistics: statistics_buffer.view(),
            opacity_logits: logit_buffer.view(),
            log_scales: scale_buffer.view(),
        },
    )?;
    op.gather(&mut recorder, scale_buffer.view(), new_scales.view_mut(), 3, false)?;
    op.gather(&mut recorder, position_buffer.view(), new_positions.view_mut(), 3, false)?;
    op.gather(&mut recorder, position_buffer.view(), moments.view_mut(), 3, true)?;
    let turned = new_rotations.view_mut().floats();
    op.gather(&mut recorder, rotation_buffer.view(), turned, 4, false)?;
    op.draw_parts(
        &mut recorder,
        new_positions.view_mut(),
        new_scales.view_mut(),
        new_rotations.view(),
        SEED,
        STEP,
    )?;
    recorder.copy(op.totals(), totals.view_mut());
    recorder.copy(op.source_from_row(), new_rows.view_mut());
    h.stream.submit(recorder)?;

    let actions = density::decide::<f32>(settings, &rows(statistics), logits, &rows(scales));
    let layout = density::layout(&actions, capacity);
    let survivors = actions.iter().filter(|&&a| a != density::Action::Prune).count();
    let growing =
        |a: &&density::Action| matches!(a, density::Action::Clone | density::Action::Split);
    let added = actions.iter().filter(growing).count();
    let device_totals = h.read(&totals)?;
    let expected = [survivors as u32, added as u32, layout.len() as u32];
    h.exact("totals", &device_totals, &expected);
    let codes: Vec<u32> =
        layout.iter().map(|&(source, origin)| source | (origin as u32) << 30).collect();
    let device_rows = h.read(&new_rows)?;
    h.exact("rows", &device_rows[..codes.len()], &codes);
    let kept_moments = density::gather::<f32>(&layout, 3, positions, true);
    let device_moments = h.read(&moments)?;
    h.exact("moments", &device_moments[..3 * layout.len()], &kept_moments);

    fn parts<R: Real>(
        layout: &[(u32, density::Origin)],
        [scales, positions, quaternions]: [&[f32]; 3],
    ) -> (Vec<R>, Vec<R>) {
        let gathered = |values: &[f32], width| density::gather(layout, width, values, false);
        let mut new_positions = rows::<R, 3>(&gathered(positions, 3));
        let mut new_scales = rows::<R, 3>(&gathered(scales, 3));
        let rotations = rows::<R, 4>(&gathered(quaternions, 4));
        density::draw_parts(layout, &mut new_positions, &mut new_scales, &rotations, SEED, STEP);
        (new_positions.concat(), new_scales.concat())
    }
    let truth = parts::<f64>(&layout, [scales, positions, quaternions]);
    let twin = parts::<f32>(&layout, [scales, positions, quaternions]);
    let bound = Bound { absolute: 3e-6, relative: 0.0 };
    let device_positions = h.read(&new_positions)?;
    let written = 3 * layout.len();
    h.close("positions", &device_positions[..written], &truth.0, Some(&twin.0), bound);
    let device_scales = h.read(&new_scales)?;
    h.close("log-scales", &device_scales[..written], &truth.1, Some(&twin.1), bound);
    Ok(())
}

fn statistics(h: &mut Harness) -> Result<()> {
    let count = 500;
    let mut gradients: Vec<[f32; 4]> = rows::<f32, 4>(&random(h, 4 * count, -1e-3, 1e-3));
    gradients[4][0] = f32::NAN;
    gradients[5][1] = f32::INFINITY;
    // Gradients with respect to depth and opacity must not be read.
    gradients[6][2] = f32::NAN;
    let visible: Vec<u32> = (0..count as u32).map(|i| i % 3).collect();
    let start: Vec<f32> = random(h, 2 * count, 0.0, 2.0);
    let mut logits = random(h, count, -9.0, 9.0);
    logits[5] = 40.0;
    let gradient_buffer = h.device.upload("gradients", &gradients)?;
    let visible_buffer = h.device.upload("visible", &visible)?;
    let fits = [h.device.upload("fits", &[1u32])?, h.device.upload("fits", &[0u32])?];
    let start_buffer = h.device.upload("statistics", &start)?;
    let logit_buffer = h.device.upload("logits", &logits)?;
    let mut sums = h.output::<f32>("statistics", 2 * count)?;
    let mut misfit = h.output::<f32>("statistics of a frame that did not fit", 2 * count)?;
    let mut reset = h.output::<f32>("logits", count)?;
    let mut recorder = h.stream.record()?;
    recorder.copy(logit_buffer.view(), reset.view_mut());
    for (fits, to) in fits.iter().zip([&mut sums, &mut misfit]) {
        recorder.copy(start_buffer.view(), to.view_mut());
        let (by_mean, shown) = (gradient_buffer.view(), visible_buffer.view());
        accumulate(&mut recorder, to.view_mut(), by_mean, shown, fits.view(), [640, 358])?;
    }
    reset_opacity(&mut recorder, reset.view_mut(), -4.5)?;
    h.stream.submit(recorder)?;
    let mut truth = rows::<f64, 2>(&start);
    let by_mean: Vec<[f64; 2]> =
        gradients.iter().map(|g| [f64::from(g[0]), f64::from(g[1])]).collect();
    density::accumulate(&mut truth, &by_mean, &visible, [320.0, 179.0]);
    let device = h.read(&sums)?;
    let bound = Bound { absolute: 0.0, relative: 1e-6 };
    h.close("statistics", &device, truth.as_flattened(), None, bound);
    let device = h.read(&misfit)?;
    h.exact("statistics of a frame that did not fit", &device, &start);
    density::reset_opacity(&mut logits, -4.5);
    let device = h.read(&reset)?;
    h.exact("opacity logits", &device, &logits);
    Ok(())
}

fn regularisers(h: &mut Harness) -> Result<()> {
    for count in [0, 1, 64, 65, 1000] {
        let mut logits = random(h, count, -8.0, 8.0);
        let mut scales = random(h, 3 * count, -9.0, 1.0);
        if count > 10 {
            (logits[3], logits[4], scales[5], scales[6]) = (40.0, -40.0, -46.0, 46.0);
        }
        let start = [random(h, count, -1e-3, 1e-3), random(h, 3 * count, -1e-3, 1e-3)];
        let logit_buffer = h.device.upload("logits", &logits)?;
        let scale_buffer = h.device.upload("scales", &scales)?;
        let sources = [h.device.upload("start", &start[0])?, h.device.upload("start", &start[1])?];
        let mut by_logit = h.output::<f32>("opacity gradients", count)?;
        let mut by_scale = h.output::<f32>("log-scale gradients", 3 * count)?;
        let mut recorder = h.stream.record()?;
        recorder.copy(sources[0].view(), by_logit.view_mut());
        recorder.copy(sources[1].view(), by_scale.view_mut());
        let (weight, scale_weight) = (0.01, 0.02);
        regularise(
            &mut recorder,
            logit_buffer.view(),
            scale_buffer.view(),
            by_logit.view_mut(),
            by_scale.view_mut(),
            weight,
            scale_weight,
        )?;
        h.stream.submit(recorder)?;
        let mut truth = (reals::<f64>(&start[0]), reals::<f64>(&start[1]));
        density::regularise(
            &reals(&logits),
            &reals(&scales),
            weight,
            scale_weight,
            &mut truth.0,
            &mut truth.1,
        );
        // An exponential's few last places (e^46 among them) on gradients around 1e-3.
        let bound = Bound { absolute: 1e-9, relative: 2e-5 };
        let device = h.read(&by_logit)?;
        h.close("gradient by opacity logit", &device, &truth.0, None, bound);
        let device = h.read(&by_scale)?;
        h.close("gradient by log-scale", &device, &truth.1, None, bound);
    }
    Ok(())
}

/// The regularisers' gradients against differences of what they are gradients of: the weighted means
/// of opacity and of scale.
fn central_differences(h: &mut Harness) -> Result<()> {
    const STEP: f64 = 1e-6;
    let count = 50;
    let (logits, scales) = (random(h, count, -8.0, 8.0), random(h, 3 * count, -9.0, 1.0));
    let (weight, scale_weight) = (0.01, 0.02);
    let logit_buffer = h.device.upload("logits", &logits)?;
    let scale_buffer = h.device.upload("scales", &scales)?;
    let zeros = h.device.upload("zeros", &vec![0.0f32; 3 * count])?;
    let mut by_logit = h.output::<f32>("opacity gradients", count)?;
    let mut by_scale = h.output::<f32>("log-scale gradients", 3 * count)?;
    let mut recorder = h.stream.record()?;
    recorder.copy(zeros.range(0..count), by_logit.view_mut());
    recorder.copy(zeros.view(), by_scale.view_mut());
    regularise(
        &mut recorder,
        logit_buffer.view(),
        scale_buffer.view(),
        by_logit.view_mut(),
        by_scale.view_mut(),
        weight,
        scale_weight,
    )?;
    h.stream.submit(recorder)?;
    let slope = |value: &dyn Fn(f64) -> f64, at: f32| {
        let at = f64::from(at);
        (value(at + STEP) - value(at - STEP)) / (2.0 * STEP)
    };
    let opacity = |x: f64| weight / count as f64 / (1.0 + (-x).exp());
    let scale = |x: f64| scale_weight / (3 * count) as f64 * x.exp();
    let bound = Bound { absolute: 1e-11, relative: 1e-5 };
    let truth: Vec<f64> = logits.iter().map(|&x| slope(&opacity, x)).collect();
    let device = h.read(&by_logit)?;
    h.close("gradient by opacity logit", &device, &truth, None, bound);
    let truth: Vec<f64> = scales.iter().map(|&x| slope(&scale, x)).collect();
    let device = h.read(&by_scale)?;
    h.close("gradient by log-scale", &device, &truth, None, bound);
    Ok(())
}
