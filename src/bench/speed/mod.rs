//! Speed against error: the time that each knob saves, and its image error.

mod choose;
mod student;

pub use choose::{Budget, ErrorMeasure, choose};

use super::job::{Job, Pace};
use super::{scenes, truth};
use crate::gpu::Device;
use crate::renderer::Renderer;
use crate::report::{Accuracy, Clock, ImageError, Place, Point, Spread, Sweep, Work};
use crate::scene::Scene;
use crate::types::{Camera, NetShape, RasterKind, Tuning};
use crate::{Error, Result};
use glam::DVec3;

/// A camera at a time in [0, 1].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Shot {
    /// The camera.
    pub camera: Camera,
    /// The time.
    pub time: f64,
}

/// A knob with its positions, the most accurate first; each changes one field of a [`Tuning`].
struct Knob {
    name: &'static str,
    set: fn(&mut Tuning, f64),
    /// The positions, as text and as a number.
    positions: Vec<(String, f64)>,
}

impl Knob {
    fn new(
        name: &'static str,
        set: fn(&mut Tuning, f64),
        positions: impl IntoIterator<Item = (String, f64)>,
    ) -> Knob {
        Knob { name, set, positions: positions.into_iter().collect() }
    }

    fn turn(&self, tuning: &Tuning, position: usize) -> Tuning {
        let mut tuning = *tuning;
        (self.set)(&mut tuning, self.positions[position].1);
        tuning
    }
}

/// The knobs that have an effect on a scene.
fn knobs(scene: &Scene) -> Vec<Knob> {
    let number = |v: f64| (format!("{v}"), v);
    let levels = |v: f64| (format!("{v}/255"), v / 255.0);
    let mut all = vec![
        Knob::new(
            "α cut",
            |t, v| t.alpha_cut = Some(v as f32),
            [1.5, 2.0, 3.0, 4.0, 8.0, 16.0].map(levels),
        ),
        Knob::new(
            "T stop",
            |t, v| t.transmittance_stop = Some(v as f32),
            [1e-3, 3e-3, 1e-2, 3e-2, 0.1].map(number),
        ),
        Knob::new(
            "depth bits",
            |t, v| t.depth_bits = v as u32,
            [24.0, 20.0, 16.0, 12.0, 8.0].map(number),
        ),
        Knob::new(
            "raster",
            |t, _| t.raster = RasterKind::Shared,
            [("shared memory".to_owned(), 1.0)],
        ),
        Knob::new("half-packed SH", |t, _| t.half_sh = true, [("16 bits".to_owned(), 1.0)]),
        Knob::new("half-packed shapes", |t, _| t.half_shapes = true, [("16 bits".to_owned(), 1.0)]),
    ];
    let degree = scene.gaussians.sh_degree;
    if degree > 0 {
        let lower = (0..degree).rev().map(|d| number(f64::from(d)));
        all.push(Knob::new("SH degree", |t, v| t.sh_degree = v as u32, lower));
    }
    if scene.moves() && scene.neighbours > 1 {
        let fewer = (1..scene.neighbours).rev().map(|k| number(f64::from(k)));
        all.push(Knob::new("neighbours", |t, v| t.neighbours = Some(v as u32), fewer));
    }
    all
}

/// The error over all shots.
fn error(
    device: &Device,
    scene: &Scene,
    tuning: &Tuning,
    (shots, truths): (&[Shot], &[Vec<f64>]),
) -> Result<ImageError> {
    let mut renderer = Renderer::tuned(device, scene, tuning)?;
    let (mut max, mut squares, mut count) = (0.0f64, 0.0f64, 0usize);
    for (shot, truth) in shots.iter().zip(truths) {
        let image = renderer.render(&shot.camera, shot.time)?.over(scene.background);
        for (&value, &truth) in image.pixels.iter().zip(truth) {
            let difference = (f64::from(value) - truth).abs();
            let difference = if difference.is_nan() { f64::INFINITY } else { difference };
            max = max.max(difference);
            squares += difference * difference;
        }
        count += truth.len();
    }
    let rmse = (squares / count.max(1) as f64).sqrt();
    let psnr = if rmse > 0.0 { (-20.0 * rmse.log10()).min(200.0) } else { 200.0 };
    Ok(ImageError { max, rmse, psnr })
}

/// Renders every shot with some settings.
fn frames(device: &Device, scene: &Scene, tuning: &Tuning, shots: &[Shot]) -> Result<Job> {
    let mut renderer = Renderer::tuned(device, scene, tuning)?;
    let shots = shots.to_vec();
    Ok(Job {
        accuracy: Accuracy { of_bound: 0.0, error: 0.0, output: String::new() },
        work: Work::default(),
        place: Place::Device,
        reset: None,
        execute: Box::new(move || {
            for shot in &shots {
                renderer.render(&shot.camera, shot.time)?;
            }
            Ok(None)
        }),
    })
}

/// A scene as some settings render it.
type Rendering<'a> = (&'a Scene, &'a Tuning);

/// The result of a paired timing: the frame time of the second rendering, and its ratio to the
/// first's, per sample.
struct Race {
    time: Spread,
    ratio: Spread,
    clock: Clock,
}

/// Times two renderings of the same shots alternately, so that other load on the machine affects
/// both.
fn race(
    device: &Device,
    [first, second]: [Rendering<'_>; 2],
    shots: &[Shot],
    pace: Pace,
) -> Result<Race> {
    let mut a = frames(device, first.0, first.1, shots)?;
    let mut b = frames(device, second.0, second.1, shots)?;
    let (mut times, mut ratios, mut clock) = (Vec::new(), Vec::new(), Clock::Host);
    // The first round is a warm-up.
    let begun = std::time::Instant::now();
    for round in 0..=pace.most {
        let (one, (other, read)) = (a.sample(device)?.0, b.sample(device)?);
        if round > 0 {
            times.push(other / shots.len().max(1) as f64);
            ratios.push(other / one.max(f64::MIN_POSITIVE));
            clock = read;
        }
        if ratios.len() >= pace.least && begun.elapsed() > 2 * pace.total {
            break;
        }
    }
    let spread = |values| {
        Spread::new(values).ok_or_else(|| Error::Failed("no time was measured".to_owned()))
    };
    Ok(Race { time: spread(times)?, ratio: spread(ratios)?, clock })
}

fn settings(tuning: &Tuning) -> serde_json::Value {
    serde_json::to_value(tuning).unwrap_or_default()
}

/// Frame time and error of some settings on the same shots. The time is measured alternately with
/// that of the most accurate settings, the error against the image of the oracle in f64. The point
/// belongs to no knob.
///
/// # Errors
/// As for [`sweep`].
pub fn measure_settings(
    device: &Device,
    scene: &Scene,
    tuning: &Tuning,
    shots: &[Shot],
    pace: Pace,
) -> Result<(Point, Clock)> {
    if shots.is_empty() {
        return Err(Error::Input("there is no view to measure on".into()));
    }
    let truths: Vec<Vec<f64>> = shots.iter().map(|shot| truth::image(scene, shot)).collect();
    point(device, scene, tuning, (shots, &truths), pace)
}

fn point(
    device: &Device,
    scene: &Scene,
    tuning: &Tuning,
    (shots, truths): (&[Shot], &[Vec<f64>]),
    pace: Pace,
) -> Result<(Point, Clock)> {
    let error = error(device, scene, tuning, (shots, truths))?;
    let turns = [(scene, &Tuning::default()), (scene, tuning)];
    let Race { time, ratio, clock } = race(device, turns, shots, pace)?;
    let settings = settings(tuning);
    Ok((Point { knob: String::new(), value: String::new(), settings, time, ratio, error }, clock))
}

/// Varies every knob on a scene, one after the other, with the others at their most accurate
/// position. `each` is called with every point.
///
/// # Errors
/// A scene that does not fit the device, or what `each` returns.
pub fn sweep(
    device: &Device,
    name: &str,
    scene: &Scene,
    shots: &[Shot],
    pace: Pace,
    each: &mut dyn FnMut(&Point) -> Result<()>,
) -> Result<Sweep> {
    let Some(first) = shots.first() else {
        return Err(Error::Input(format!("{name}: no view to measure on")));
    };
    let truths: Vec<Vec<f64>> = shots.iter().map(|shot| truth::image(scene, shot)).collect();
    let mut sweep = Sweep {
        scene: name.to_owned(),
        gaussians: scene.gaussians.len(),
        size: [first.camera.intrinsics.width, first.camera.intrinsics.height],
        clock: Clock::Host,
        points: Vec::new(),
    };
    let best = Tuning::default();
    let mut add = |knob: &str, value: &str, tuning: &Tuning, sweep: &mut Sweep| {
        let (point, clock) = point(device, scene, tuning, (shots, &truths), pace)?;
        let point = Point { knob: knob.to_owned(), value: value.to_owned(), ..point };
        each(&point)?;
        sweep.clock = clock;
        sweep.points.push(point);
        Ok::<(), Error>(())
    };
    add("", "all at their best", &best, &mut sweep)?;
    for knob in knobs(scene) {
        for (position, (label, _)) in knob.positions.iter().enumerate() {
            add(knob.name, label, &knob.turn(&best, position), &mut sweep)?;
        }
    }
    Ok(sweep)
}

/// A synthetic static scene with two views.
pub fn still_scene(seed: u64, gaussians: usize, width: u32, height: u32) -> (Scene, Vec<Shot>) {
    let camera = scenes::camera(width, height);
    (Scene::of(scenes::cloud(seed, gaussians, 3, &camera)), views(&camera, &[0.0, 0.0]))
}

/// Views from neighbouring positions, at given times.
fn views(camera: &Camera, times: &[f64]) -> Vec<Shot> {
    let shot = |(i, &time): (usize, &f64)| {
        let mut camera = *camera;
        camera.view_from_world.translation += DVec3::new(0.1, -0.05, 0.02) * i as f64;
        Shot { camera, time }
    };
    times.iter().enumerate().map(shot).collect()
}

/// Sweeps a synthetic dynamic scene. Besides the knobs of [`sweep`], networks of several widths are
/// fitted to the scene's motion, and their image error is measured. `quick`: fewer and
/// shorter fits.
///
/// # Errors
/// As for [`sweep`].
pub fn sweep_motion(
    device: &Device,
    seed: u64,
    quick: bool,
    pace: Pace,
    each: &mut dyn FnMut(&Point) -> Result<()>,
) -> Result<Sweep> {
    let (gaussians, nodes) = if quick { (2000, 64) } else { (10_000, 256) };
    let camera = scenes::camera(240, 136);
    let mut scene = Scene::of(scenes::all_dynamic(scenes::cloud(seed, gaussians, 1, &camera)));
    scene.control_points = scenes::control_points(seed, nodes, &camera);
    let network = scenes::swing(seed);
    let shape = network.shape;
    scene.network = Some(network);
    let shots = views(&camera, &[0.2, 0.7]);
    let name = "moving, synthetic";
    let mut sweep = sweep(device, name, &scene, &shots, pace, each)?;
    let truths: Vec<Vec<f64>> = shots.iter().map(|shot| truth::image(&scene, shot)).collect();
    let widths: &[u32] = if quick { &[16, 32] } else { &[16, 32, 64, 128] };
    for &width in widths {
        let shape = NetShape { width, ..shape };
        let steps = if quick { 60 } else { 500 };
        let fitted = student::fit(device, &scene, shape, steps, seed)?;
        let student = Scene { network: Some(fitted), ..scene.clone() };
        let tuning = Tuning::default();
        let error = error(device, &student, &tuning, (&shots, &truths))?;
        let Race { time, ratio, .. } =
            race(device, [(&scene, &tuning), (&student, &tuning)], &shots, pace)?;
        let (knob, value) = ("network width".to_owned(), width.to_string());
        let point = Point { knob, value, settings: settings(&tuning), time, ratio, error };
        each(&point)?;
        sweep.points.push(point);
    }
    Ok(sweep)
}
