//! Time and memory against size: Gaussians, pixels, control points, frames.
//!
//! Each curve is compared with the oracle at its smallest size; larger sizes run the same kernels
//! on scenes of the same kind. Sizes that would not fit on the device, by a rehearsal, or that
//! would exceed the remaining time, are skipped.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use rand::RngExt;

use super::job::{Job, Pace};
use super::pipelines;
use super::rows::{NARROW, thousands};
use super::scenes::{camera, cloud, control_points, network, rng};
use crate::gpu::{Detail, Device, DeviceKind, Footprint};
use crate::renderer::{RenderScale, Renderer};
use crate::report::{Accuracy, Clock, Curve, CurvePoint, Place, Spread, Work};
use crate::scene::Scene;
use crate::train::{MotionStart, PictureKind, TrainSettings, Trainer, TrainingScale, TrainingView};
use crate::types::{Gaussians, Image, MotionScale, NetShape, Tuning};
use crate::{Error, Result};

/// Number of control points that a Gaussian follows.
const FOLLOWED: usize = 4;
/// Number of profiled executions for the times of the kernels.
const PROFILED: usize = 3;
/// In a dynamic scene, one Gaussian in this many is dynamic.
const MOVING: usize = 10;

/// The pipeline to measure.
#[derive(Clone, Copy, PartialEq)]
enum Pipeline {
    Render,
    Step,
    MovingStep,
}

/// The sizes of a point of a curve.
#[derive(Clone, Copy)]
struct Sizes {
    gaussians: usize,
    width: u32,
    height: u32,
    control_points: usize,
    frames: usize,
}

/// The size that grows along a curve.
#[derive(Clone, Copy)]
enum Axis {
    Gaussians,
    Pixels,
    ControlPoints,
    Frames,
}

/// A curve to measure.
struct Plan {
    pipeline: Pipeline,
    axis: Axis,
    held: Sizes,
    sizes: Vec<usize>,
    /// The deformation network of a dynamic scene.
    network: NetShape,
}

/// Measures time and memory of rendering and of training steps as functions of size, within about
/// `time`; `each` is called with every point and its curve.
///
/// # Errors
/// What `each` returns; a failed submission.
pub fn curves(
    device: &Device,
    seed: u64,
    quick: bool,
    time: Duration,
    each: &mut dyn FnMut(&Curve, &CurvePoint) -> Result<()>,
) -> Result<Vec<Curve>> {
    let software = device.info().kind == DeviceKind::Software;
    let plans = plans(software, quick);
    let begun = Instant::now();
    let mut curves = Vec::new();
    let count = plans.len() as u32;
    for (done, plan) in (0..).zip(&plans) {
        // Later curves get the time that earlier ones did not use.
        let until = begun + time * (done + 1) / count;
        curves.push(plan.measure(device, seed, until, each)?);
    }
    Ok(curves)
}

fn plans(software: bool, quick: bool) -> Vec<Plan> {
    let (width, height) = if software { (480, 270) } else { (1920, 1080) };
    let held = Sizes {
        gaussians: match (quick, software) {
            (true, _) => 2000,
            (_, true) => 50_000,
            _ => 500_000,
        },
        width,
        height,
        control_points: if quick { 64 } else { 512 },
        frames: 8,
    };
    let gaussians = match quick {
        true => vec![2000, 4000, 8000],
        false => vec![10_000, 30_000, 100_000, 300_000, 1_000_000, 2_000_000, 5_000_000],
    };
    let pixels = match quick {
        true => vec![25_000, 50_000, 100_000],
        false => vec![100_000, 250_000, 500_000, 1_000_000, 2_000_000, 4_000_000, 8_000_000],
    };
    let nodes = if quick { vec![32, 64] } else { vec![64, 128, 256, 512, 1024, 2048, 4096] };
    let frames = if quick { vec![8, 16] } else { vec![8, 32, 128, 512] };
    let plan = |pipeline, axis, held, sizes: &[usize]| Plan {
        pipeline,
        axis,
        held,
        sizes: sizes.to_vec(),
        network: if software { NARROW } else { NetShape::PAPER },
    };
    use {Axis::*, Pipeline::*};
    vec![
        plan(MovingStep, Frames, held, &frames),
        plan(MovingStep, ControlPoints, held, &nodes),
        plan(Render, Pixels, held, &pixels),
        plan(Step, Pixels, held, &pixels),
        plan(Render, Gaussians, held, &gaussians),
        plan(Step, Gaussians, held, &gaussians),
    ]
}

impl Sizes {
    /// With another size along an axis.
    fn with(self, axis: Axis, size: usize) -> Sizes {
        match axis {
            Axis::Gaussians => Sizes { gaussians: size, ..self },
            Axis::ControlPoints => Sizes { control_points: size, ..self },
            Axis::Frames => Sizes { frames: size, ..self },
            Axis::Pixels => {
                let height = (size as f64 * 9.0 / 16.0).sqrt().round() as u32;
                Sizes { width: (size as f64 / f64::from(height)).round() as u32, height, ..self }
            }
        }
    }
}

impl Plan {
    fn names(&self) -> (&'static str, &'static str, String) {
        let Sizes { gaussians, width, height, control_points, frames } = self.held;
        let pipeline = match self.pipeline {
            Pipeline::Render => "render",
            Pipeline::Step => "training step",
            Pipeline::MovingStep => "moving training step",
        };
        let mut held = Vec::new();
        let axis = match self.axis {
            Axis::Gaussians => "Gaussians",
            Axis::Pixels => "pixels",
            Axis::ControlPoints => "control points",
            Axis::Frames => "frames",
        };
        if axis != "Gaussians" {
            held.push(format!("{} Gaussians", thousands(gaussians)));
        }
        if axis != "pixels" {
            held.push(format!("{width}×{height}"));
        }
        if self.pipeline == Pipeline::MovingStep {
            if axis != "control points" {
                held.push(format!("{control_points} control points"));
            }
            let NetShape { depth, width, .. } = self.network;
            held.push(format!("1 in {MOVING} moves, network of {depth} layers of {width}"));
        }
        if self.pipeline != Pipeline::Render && axis != "frames" {
            held.push(format!("{frames} frames"));
        }
        (pipeline, axis, held.join(", "))
    }

    fn measure(
        &self,
        device: &Device,
        seed: u64,
        until: Instant,
        each: &mut dyn FnMut(&Curve, &CurvePoint) -> Result<()>,
    ) -> Result<Curve> {
        let (pipeline, axis, held) = self.names();
        let mut curve = Curve {
            pipeline: pipeline.into(),
            axis: axis.into(),
            held,
            clock: Clock::Device,
            accuracy: self.accuracy(device, seed)?,
            points: Vec::new(),
        };
        let mut cost: Option<(usize, Duration)> = None;
        for &size in &self.sizes {
            let sizes = self.held.with(self.axis, size);
            let left = until.saturating_duration_since(Instant::now());
            let foreseen = self.footprint(device, &sizes);
            let mut point = CurvePoint {
                size: match self.axis {
                    Axis::Pixels => u64::from(sizes.width) * u64::from(sizes.height),
                    _ => size as u64,
                },
                time: None,
                foreseen: foreseen.as_ref().ok().map(|taken| taken.bytes),
                taken: None,
                left_out: None,
                kernels: Vec::new(),
            };
            // Proportional to the time of the last point; a training step uses one frame, whatever
            // their number.
            let expected = cost.map(|(at, took)| match self.axis {
                Axis::Frames => took,
                _ => took.mul_f64(size as f64 / at as f64),
            });
            point.left_out = match foreseen.and_then(|taken| taken.fits(device)) {
                Err(error @ (Error::RangeLimit { .. } | Error::TooLarge { .. })) => {
                    Some(format!("does not fit: {error}"))
                }
                Err(other) => return Err(other),
                Ok(()) if !curve.accuracy.passed() => {
                    Some(format!("its bound is missed in {}", curve.accuracy.output))
                }
                Ok(()) => expected.filter(|expected| *expected > left).map(|expected| {
                    let (expected, left) = (expected.as_secs_f64(), left.as_secs_f64());
                    format!("would take {expected:.0} s where {left:.0} s are left")
                }),
            };
            if point.left_out.is_none() {
                let begun = Instant::now();
                curve.clock = self.take(device, seed, &sizes, &mut point)?;
                cost = Some((size, begun.elapsed()));
            }
            each(&curve, &point)?;
            curve.points.push(point);
        }
        Ok(curve)
    }

    /// Times a point and reads its memory.
    fn take(
        &self,
        device: &Device,
        seed: u64,
        sizes: &Sizes,
        point: &mut CurvePoint,
    ) -> Result<Clock> {
        let before = device.restart_memory_peak();
        let mut job = self.job(device, seed, sizes)?;
        let pace = Pace { total: Duration::from_millis(500), least: 5, most: 15 };
        let (time, clock) = job.time(device, pace)?;
        point.time = Some(time);
        let mut kernels: BTreeMap<&'static str, [f64; PROFILED]> = BTreeMap::new();
        for execution in 0..PROFILED {
            let sample = job.metered(device, Detail::Dispatches)?;
            for time in sample.meter.iter().flat_map(|meter| &meter.kernels) {
                kernels.entry(time.kernel).or_default()[execution] += time.nanoseconds;
            }
        }
        let median = |times: [f64; PROFILED]| Spread::new(times.to_vec()).map(|s| s.median());
        let named = |(kernel, times): (&str, _)| Some((kernel.to_owned(), median(times)?));
        point.kernels = kernels.into_iter().filter_map(named).collect();
        point.kernels.sort_by(|a, b| b.1.total_cmp(&a.1));
        point.taken = Some(device.memory().1 - before);
        Ok(clock)
    }

    /// The pipeline against the oracle, small.
    fn accuracy(&self, device: &Device, seed: u64) -> Result<Accuracy> {
        let job = match self.pipeline {
            Pipeline::Render => pipelines::rendered(device, seed, 2000, 240, 136),
            Pipeline::Step => pipelines::step(device, seed, (2000, 240, 136), false),
            Pipeline::MovingStep => pipelines::step(device, seed, (2000, 240, 136), true),
        };
        match job {
            Ok(job) => Ok(job.accuracy),
            Err(error @ Error::DeviceLost { .. }) => Err(error),
            Err(error) => {
                let output = error.to_string();
                Ok(Accuracy { of_bound: f64::INFINITY, error: f64::INFINITY, output })
            }
        }
    }

    fn settings(&self) -> TrainSettings {
        TrainSettings {
            steps: u32::MAX,
            max_gaussians: 0,
            sh_interval: 0,
            growth: None,
            ..TrainSettings::default()
        }
    }

    fn footprint(&self, device: &Device, sizes: &Sizes) -> Result<Footprint> {
        let size = (sizes.width, sizes.height);
        match self.pipeline {
            Pipeline::Render => {
                let scene = Scene::of(Gaussians { sh_degree: 3, ..Default::default() });
                let scale = RenderScale::new(&scene, size, &Tuning::default());
                RenderScale { gaussians: sizes.gaussians, ..scale }.footprint(device)
            }
            _ => {
                let (width, height) = size;
                let kind = PictureKind { width, height, disparity: false, mask: false };
                TrainingScale {
                    pictures: [(kind, sizes.frames)].into(),
                    gaussians: sizes.gaussians,
                    intersections: 0,
                    motion: (self.pipeline == Pipeline::MovingStep).then_some(MotionScale {
                        control_points: sizes.control_points,
                        keys: 0,
                        network: Some(self.network),
                        neighbours: FOLLOWED,
                    }),
                    settings: self.settings(),
                }
                .footprint(device)
            }
        }
    }

    fn job(&self, device: &Device, seed: u64, sizes: &Sizes) -> Result<Job> {
        let camera = camera(sizes.width, sizes.height);
        let mut gaussians = cloud(seed, sizes.gaussians, 3, &camera);
        let job = |execute| Job {
            // Held against the oracle by [`accuracy`](Self::accuracy).
            accuracy: Accuracy { of_bound: 0.0, error: 0.0, output: String::new() },
            work: Work::default(),
            place: Place::Device,
            reset: None,
            execute,
        };
        if self.pipeline == Pipeline::Render {
            let mut renderer = Renderer::new(device, &Scene::of(gaussians))?;
            return Ok(job(Box::new(move || renderer.render(&camera, 0.0).map(|_| None))));
        }
        let start = (self.pipeline == Pipeline::MovingStep).then(|| MotionStart {
            points: control_points(seed, sizes.control_points, &camera),
            network: Some(network(seed, self.network)),
            neighbours: FOLLOWED,
        });
        if start.is_some() {
            let moves = |i| if i % MOVING == 0 { 1.0 } else { -1.0 };
            gaussians.motion_logits = (0..sizes.gaussians).map(moves).collect();
        }
        let mut rng = rng(seed + 9);
        let mut image = Image::new(sizes.width, sizes.height, 3);
        image.pixels.iter_mut().for_each(|v| *v = f32::from(rng.random::<u8>()) / 255.0);
        let time = 0.25;
        let view = TrainingView {
            camera,
            time,
            image,
            weights: None,
            disparity: None,
            mask: None,
            every: 1,
        };
        let views = vec![view; sizes.frames];
        let settings = self.settings();
        let mut trainer = Trainer::new(device, &views, &gaussians, start.as_ref(), settings)?;
        Ok(job(Box::new(move || {
            trainer.step()?;
            trainer.finish()?;
            Ok(None)
        })))
    }
}
