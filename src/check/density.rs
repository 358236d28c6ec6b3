//! Check cases of density control.

use super::{Bound, Case, Guarded, Harness, Workload};
use crate::error::Result;
use crate::gpu::{Buffer, Recorder};
use crate::ops::density::{
    Adaptation, AdaptationArgs, JitterArgs, Relocation, RelocationArgs, accumulate, jitter,
    regularise, reset_opacity,
};
use crate::oracle::{Real, density};
use crate::types::{AdaptSettings, MotionClass, Work};
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
    /// Values in a row of a further parameter and its moments; 0 for none.
    width: usize,
}

const SEED: u32 = 77;
const STEP: u32 = 3;

impl Round {
    /// Rows after the round.
    fn rows(&self) -> usize {
        self.logits.len() + self.grown
    }

    fn payload(&self) -> Vec<f32> {
        (0..self.width * self.rows()).map(|i| i as f32).collect()
    }

    fn run(self, h: &mut Harness) -> Result<()> {
        let mut workload = RelocationWorkload::new(h, self)?;
        h.execute(&mut workload)
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

/// A round of relocation or growth.
pub(crate) struct RelocationWorkload {
    round: Round,
    op: Relocation,
    motion: Buffer<f32>,
    source_logits: Buffer<f32>,
    source_scales: Buffer<f32>,
    source_payload: Buffer<f32>,
    logits: Guarded<f32>,
    scales: Guarded<f32>,
    values: Guarded<f32>,
    moments: Guarded<f32>,
}

impl RelocationWorkload {
    /// Uploads a round.
    fn new(h: &mut Harness, round: Round) -> Result<RelocationWorkload> {
        let device = h.device.clone();
        let rows = round.rows();
        Ok(RelocationWorkload {
            op: Relocation::new(&device, rows)?,
            motion: device.upload("motion logits", &round.motion)?,
            source_logits: device.upload("logits", &round.logits)?,
            source_scales: device.upload("scales", &round.scales)?,
            source_payload: device.upload("payload", &round.payload())?,
            logits: h.output("opacity logits", rows)?,
            scales: h.output("log-scales", 3 * rows)?,
            values: h.output("payload", round.width * rows)?,
            moments: h.output("moments", round.width * rows)?,
            round,
        })
    }

    /// A relocation of `count` Gaussians of which about a tenth is dead, as in training.
    #[cfg(feature = "bench")]
    pub(crate) fn random(h: &mut Harness, count: usize) -> Result<RelocationWorkload> {
        let logits = random(h, count, -6.2, 5.0);
        let scales = random(h, 3 * count, -5.0, 0.0);
        let class = MotionClass::Any;
        let round = Round { logits, scales, motion: Vec::new(), class, grown: 0, width: 0 };
        RelocationWorkload::new(h, round)
    }
}

impl Workload for RelocationWorkload {
    fn record_inputs(&mut self, recorder: &mut Recorder) -> Result<()> {
        let count = self.round.logits.len();
        recorder.copy(self.source_logits.view(), self.logits.view_mut().range(0..count));
        recorder.copy(self.source_scales.view(), self.scales.view_mut().range(0..3 * count));
        recorder.copy(self.source_payload.view(), self.values.view_mut());
        recorder.copy(self.source_payload.view(), self.moments.view_mut());
        Ok(())
    }

    fn record(&mut self, recorder: &mut Recorder) -> Result<()> {
        let round = &self.round;
        let (count, width) = (round.logits.len(), round.width);
        let args = RelocationArgs {
            opacity_logits: self.logits.view_mut().range(0..count),
            log_scales: self.scales.view_mut().range(0..3 * count),
            motion_logits: (!round.motion.is_empty()).then(|| self.motion.view()),
            class: round.class,
            seed: SEED,
            step: STEP,
        };
        match round.grown {
            0 => self.op.relocate(recorder, args)?,
            grown => self.op.grow(recorder, args, grown)?,
        }
        self.op.copy(recorder, self.logits.view_mut(), 1)?;
        self.op.copy(recorder, self.scales.view_mut(), 3)?;
        self.op.copy(recorder, self.values.view_mut(), width)?;
        self.op.zero(recorder, self.moments.view_mut(), width)
    }

    fn compare(&self, h: &mut Harness) -> Result<()> {
        let round = &self.round;
        let count = round.logits.len();
        // Weights are rounded exponentials, so f32 may be off by one.
        let device_weights = h.read_view(self.op.weights().range(0..count))?;
        let (logits, motion) = (reals(&round.logits), reals(&round.motion));
        let truth = density::draw_weights::<f64>(&logits, &motion, round.class);
        let as_float: Vec<f32> = device_weights.iter().map(|&w| w as f32).collect();
        let truth: Vec<f64> = truth.iter().map(|&w| f64::from(w)).collect();
        let one_off = Bound { absolute: 1.0, relative: 0.0 };
        h.close("weights", &as_float, &truth, None, one_off);

        // Given the device's own weights, all further results are exact.
        let rows: Vec<u32> = match round.grown {
            0 => density::dead::<f32>(&round.logits, &round.motion, round.class),
            _ => (count as u32..round.rows() as u32).collect(),
        };
        let mut targets = density::draw(&device_weights, rows.len(), SEED, STEP);
        if round.grown > 0 && device_weights.iter().all(|&w| w == 0) {
            targets.fill(0);
        }
        let sum = device_weights.iter().sum::<u32>();
        let device = h.read_view(self.op.totals())?;
        h.exact("totals", &device, &[sum, rows.len() as u32]);
        let device = h.read_view(self.op.row_from_slot().range(0..rows.len()))?;
        h.exact("row of each slot", &device, &rows);
        let device = h.read_view(self.op.target_from_slot().range(0..rows.len()))?;
        h.exact("target of each slot", &device, &targets);

        let new = round.after::<f64>(&rows, &targets);
        let twin = round.after::<f32>(&rows, &targets);
        // Measured 1e-6: logits of ten and more, and an exponential between.
        let bound = Bound { absolute: 5e-6, relative: 2e-6 };
        let device = h.read(&self.logits)?;
        h.close("opacity logits", &device, &new.0, Some(&twin.0), bound);
        let device = h.read(&self.scales)?;
        h.close("log-scales", &device, &new.1, Some(&twin.1), bound);

        let (mut copied, mut zeroed) = (round.payload(), round.payload());
        for (&row, &target) in rows.iter().zip(&targets).filter(|(_, t)| **t != u32::MAX) {
            let (row, target) = (row as usize, target as usize);
            for c in 0..round.width {
                copied[round.width * row + c] = (round.width * target + c) as f32;
                zeroed[round.width * row + c] = 0.0;
                if device_weights[target] > 0 {
                    zeroed[round.width * target + c] = 0.0;
                }
            }
        }
        let device = h.read(&self.values)?;
        h.exact("copied rows", &device, &copied);
        let device = h.read(&self.moments)?;
        h.exact("zeroed rows", &device, &zeroed);
        Ok(())
    }

    /// Weights and flags are written, summed and looked up; every dead row is copied.
    fn work(&self) -> Work {
        let round = &self.round;
        let dead = density::dead::<f32>(&round.logits, &round.motion, round.class).len() as u64;
        let count = round.logits.len() as u64;
        Work { bytes: 40 * count + 64 * dead, operations: 12 * count + 60 * dead }
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
            Round { logits, scales, motion, class, grown: 0, width: 5 }.run(h)?;
        }
    }
    // Opacities near 0.01, where ln(1 + x) of a rounded 1 + x loses most of its digits.
    let logits: Vec<f32> =
        (0..4000).map(|i| if i % 2 == 0 { -8.0 } else { h.rng.random_range(-4.7..-4.4) }).collect();
    let (scales, class) = (vec![0.0; 3 * logits.len()], MotionClass::Any);
    Round { logits, scales, motion: Vec::new(), class, grown: 0, width: 5 }.run(h)?;
    // If all are dead, or none is, nothing changes.
    for logit in [-8.0, 2.0] {
        let (logits, scales) = (vec![logit; 70], vec![0.5; 210]);
        let class = MotionClass::Any;
        Round { logits, scales, motion: Vec::new(), class, grown: 0, width: 5 }.run(h)?;
    }
    Ok(())
}

fn grow(h: &mut Harness) -> Result<()> {
    for (count, grown) in [(1000, 50), (64, 64), (3, 40), (1, 200)] {
        let (logits, scales) = (random(h, count, -4.0, 6.0), random(h, 3 * count, -5.0, 0.0));
        let class = MotionClass::Any;
        Round { logits, scales, motion: Vec::new(), class, grown, width: 5 }.run(h)?;
    }
    // All are dead: the first is copied unchanged.
    let (logits, scales) = (vec![-8.0; 5], vec![0.5; 15]);
    Round { logits, scales, motion: Vec::new(), class: MotionClass::Any, grown: 3, width: 5 }.run(h)
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
            Round { logits, scales, motion: Vec::new(), class, grown: 0, width: 5 }.run(h)?;
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

/// Thresholds of adaptive control.
const ADAPT: AdaptSettings =
    AdaptSettings { gradient: 2e-4, small: 0.05, opacity: 0.005, large: 0.9 };

fn adapt(h: &mut Harness) -> Result<()> {
    for (count, capacity) in [(1000, 2000), (1000, 1100), (70, 70), (1, 2), (0, 4)] {
        let mut cloud = Cloud::random(h, count);
        if count > 20 {
            cloud.logits[3] = f32::NAN;
            cloud.scales[15] = f32::NAN;
            (cloud.logits[9], cloud.logits[10]) = (40.0, -40.0);
        }
        let mut workload = AdaptationWorkload::new(h, cloud, capacity)?;
        h.execute_on(&format!("{count} of {capacity}"), &mut workload)?;
    }
    Ok(())
}

/// Gaussians with their statistics.
struct Cloud {
    /// Sum of gradient norms and number of views of each.
    statistics: Vec<f32>,
    logits: Vec<f32>,
    scales: Vec<f32>,
    positions: Vec<f32>,
    quaternions: Vec<f32>,
}

impl Cloud {
    /// Values that straddle every threshold of [`ADAPT`].
    fn random(h: &mut Harness, count: usize) -> Cloud {
        let statistics = (0..count)
            .flat_map(|_| {
                let views = h.rng.random_range(0..5u32) as f32;
                [h.rng.random_range(0.0f32..4e-4) * views, views]
            })
            .collect();
        Cloud {
            statistics,
            logits: random(h, count, -6.0, 3.0),
            scales: random(h, 3 * count, -6.0, 0.0),
            positions: random(h, 3 * count, -1.0, 1.0),
            quaternions: random(h, 4 * count, -1.0, 1.0),
        }
    }

    fn layout(&self, capacity: usize) -> (Vec<density::Action>, Vec<(u32, density::Origin)>) {
        let (statistics, scales) = (rows(&self.statistics), rows(&self.scales));
        let actions = density::decide::<f32>(&ADAPT, &statistics, &self.logits, &scales);
        let layout = density::layout(&actions, capacity);
        (actions, layout)
    }

    /// Centres and log-scales after the parts of split Gaussians were drawn.
    fn parts<R: Real>(&self, layout: &[(u32, density::Origin)]) -> (Vec<R>, Vec<R>) {
        let gathered = |values: &[f32], width| density::gather(layout, width, values, false);
        let mut positions = rows::<R, 3>(&gathered(&self.positions, 3));
        let mut scales = rows::<R, 3>(&gathered(&self.scales, 3));
        let rotations = rows::<R, 4>(&gathered(&self.quaternions, 4));
        density::draw_parts(layout, &mut positions, &mut scales, &rotations, SEED, STEP);
        (positions.concat(), scales.concat())
    }
}

/// A round of adaptive control: the decisions, the arrays in their new order, the parts.
pub(crate) struct AdaptationWorkload {
    cloud: Cloud,
    capacity: usize,
    op: Adaptation,
    statistics: Buffer<f32>,
    logits: Buffer<f32>,
    scales: Buffer<f32>,
    positions: Buffer<f32>,
    rotations: Buffer<f32>,
    new_scales: Guarded<f32>,
    new_positions: Guarded<f32>,
    moments: Guarded<f32>,
    new_rotations: Buffer<[f32; 4]>,
}

impl AdaptationWorkload {
    /// Uploads Gaussians, of which `capacity` may remain.
    fn new(h: &mut Harness, cloud: Cloud, capacity: usize) -> Result<AdaptationWorkload> {
        let device = h.device.clone();
        Ok(AdaptationWorkload {
            op: Adaptation::new(&device, capacity)?,
            statistics: device.upload("statistics", &cloud.statistics)?,
            logits: device.upload("logits", &cloud.logits)?,
            scales: device.upload("scales", &cloud.scales)?,
            positions: device.upload("positions", &cloud.positions)?,
            rotations: device.upload("rotations", &cloud.quaternions)?,
            new_scales: h.output("log-scales", 3 * capacity)?,
            new_positions: h.output("positions", 3 * capacity)?,
            moments: h.output("moments", 3 * capacity)?,
            new_rotations: device.buffer("rotations", capacity)?,
            cloud,
            capacity,
        })
    }

    /// `count` random Gaussians, with capacity for twice as many.
    #[cfg(feature = "bench")]
    pub(crate) fn random(h: &mut Harness, count: usize) -> Result<AdaptationWorkload> {
        let cloud = Cloud::random(h, count);
        AdaptationWorkload::new(h, cloud, 2 * count)
    }
}

impl Workload for AdaptationWorkload {
    fn record(&mut self, recorder: &mut Recorder) -> Result<()> {
        let op = &mut self.op;
        let args = AdaptationArgs {
            statistics: self.statistics.view(),
            opacity_logits: self.logits.view(),
            log_scales: self.scales.view(),
        };
        op.plan(recorder, &ADAPT, args)?;
        op.gather(recorder, self.scales.view(), self.new_scales.view_mut(), 3, false)?;
        op.gather(recorder, self.positions.view(), self.new_positions.view_mut(), 3, false)?;
        op.gather(recorder, self.positions.view(), self.moments.view_mut(), 3, true)?;
        let turned = self.new_rotations.view_mut().floats();
        op.gather(recorder, self.rotations.view(), turned, 4, false)?;
        let (positions, scales) = (self.new_positions.view_mut(), self.new_scales.view_mut());
        op.draw_parts(recorder, positions, scales, self.new_rotations.view(), SEED, STEP)
    }

    fn compare(&self, h: &mut Harness) -> Result<()> {
        let (actions, layout) = self.cloud.layout(self.capacity);
        let survivors = actions.iter().filter(|&&a| a != density::Action::Prune).count();
        let growing =
            |a: &&density::Action| matches!(a, density::Action::Clone | density::Action::Split);
        let added = actions.iter().filter(growing).count();
        let device = h.read_view(self.op.totals())?;
        h.exact("totals", &device, &[survivors as u32, added as u32, layout.len() as u32]);
        let codes: Vec<u32> =
            layout.iter().map(|&(source, origin)| source | (origin as u32) << 30).collect();
        let device = h.read_view(self.op.source_from_row().range(0..codes.len()))?;
        h.exact("source of each row", &device, &codes);
        let written = 3 * layout.len();
        let kept_moments = density::gather::<f32>(&layout, 3, &self.cloud.positions, true);
        let device = h.read(&self.moments)?;
        h.exact("moments", &device[..written], &kept_moments);

        let truth = self.cloud.parts::<f64>(&layout);
        let twin = self.cloud.parts::<f32>(&layout);
        // The radius of a normal sample is √(−2 ln u). Near u = 1 the rounding of the logarithm is divided by
        // the radius, and the smallest of n radii is about √(2/n). Measured 7.9e-6 over 200,000 rows.
        let share = (layout.len() as f64 / 1000.0).sqrt().max(1.0);
        let bound = Bound { absolute: 3e-6 * share, relative: 0.0 };
        let device = h.read(&self.new_positions)?;
        h.close("positions", &device[..written], &truth.0, Some(&twin.0), bound);
        let device = h.read(&self.new_scales)?;
        h.close("log-scales", &device[..written], &truth.1, Some(&twin.1), bound);
        Ok(())
    }

    /// Statistics, decisions and their sums for each Gaussian; thirteen values of each row are read and
    /// written.
    fn work(&self) -> Work {
        let count = self.cloud.logits.len() as u64;
        let kept = self.cloud.layout(self.capacity).1.len() as u64;
        Work { bytes: count * (24 + 40) + kept * (4 + 2 * 13 * 4), operations: count * 20 }
    }
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
