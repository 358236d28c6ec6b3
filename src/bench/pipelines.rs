//! Benchmarks of whole pipelines.

use std::cell::RefCell;
use std::rc::Rc;

use super::job::{Entry, Job};
use super::rows::{NARROW, compare_image, thousands};
use super::scenes::{all_dynamic, camera, cloud, control_points, network, rng};
use super::truth::cloud_at;
use super::verify::Check;
use crate::check::Bound;
use crate::geometry::bundle::{Observation, Options, Point, Problem, adjust, project};
use crate::gpu::Device;
use crate::ops::flow::{Flow, FlowArgs};
use crate::oracle::flow::{Pyramid, flow as oracle_flow};
use crate::oracle::loss::{self, Target};
use crate::oracle::render;
use crate::oracle::view::{Cloud, View};
use crate::renderer::Renderer;
use crate::report::{Place, Work};
use crate::scene::Scene;
use crate::train::{MotionStart, TrainSettings, Trainer, TrainingView};
use crate::types::{FlowSettings, Gaussians, Image, Intrinsics, Pose, RenderSettings};
use crate::{Error, Result};
use glam::{DQuat, DVec2, DVec3};
use rand::RngExt;

/// Control points of the dynamic training step.
const NODES: usize = 256;
/// Control points that a Gaussian follows.
const FOLLOWED: usize = 4;

pub(super) fn entries(quick: bool) -> Vec<Entry> {
    let mut all = Vec::new();
    let renders: &[(usize, u32, u32)] = if quick {
        &[(5000, 240, 136)]
    } else {
        &[(50_000, 480, 270), (50_000, 960, 540), (50_000, 1920, 1080)]
    };
    for &(n, w, h) in renders {
        let size = format!("{} Gaussians, {w}×{h}", thousands(n));
        all.push(Entry::new("pipeline/render", size, move |d, s| rendered(d, s, n, w, h)));
    }
    let (n, w, h) = if quick { (2000, 240, 136) } else { (20_000, 480, 270) };
    for (id, moving) in [("pipeline/train_step", false), ("pipeline/dynamic_train_step", true)] {
        let size = format!("{} Gaussians, {w}×{h}", thousands(n));
        all.push(Entry::new(id, size, move |d, s| step(d, s, (n, w, h), moving)));
    }
    let flows: &[(u32, u32)] = if quick { &[(120, 68)] } else { &[(240, 135), (480, 270)] };
    for &(w, h) in flows {
        let size = format!("{w}×{h}, both directions");
        all.push(Entry::new("pipeline/flow", size, move |d, s| pair(d, s, w, h)));
    }
    let (frames, points) = if quick { (6, 300) } else { (24, 3000) };
    let size = format!("{frames} frames, {} points", thousands(points));
    let job = move |_: &Device, s| bundle(s, frames, points);
    all.push(Entry::new("pipeline/bundle_adjustment", size, job));
    all
}

pub(super) fn rendered(
    device: &Device,
    seed: u64,
    n: usize,
    width: u32,
    height: u32,
) -> Result<Job> {
    let camera = camera(width, height);
    let scene = Scene::of(cloud(seed, n, 3, &camera));
    let mut renderer = Renderer::new(device, &scene)?;
    let image = renderer.render(&camera, 0.0)?;
    let (cloud, view) = (Cloud::<f64>::new(&scene.gaussians), View::new(&camera));
    let truth = render::forward(&cloud, &view, &scene.settings);
    let rgba: Vec<[f32; 4]> = bytemuck::cast_slice(&image.rgba.pixels).to_vec();
    let mut check = Check::new();
    compare_image(&mut check, "image", &rgba, &truth.pixels);
    let pixels = u64::from(width) * u64::from(height);
    // The minimum to read and write: the Gaussians and the image.
    let work = Work { bytes: n as u64 * 59 * 4 + pixels * 20, operations: 0 };
    Ok(Job {
        accuracy: check.accuracy(),
        work,
        place: Place::Device,
        reset: None,
        execute: Box::new(move || renderer.render(&camera, 0.0).map(|_| None)),
    })
}

/// The rendered scene's loss against a training image and its gradients, by the oracle in f64.
fn photometric(
    gaussians: &Cloud<f64>,
    view: &View<f64>,
    photo: &Image,
    settings: &TrainSettings,
) -> (loss::Loss<f64>, Cloud<f64>) {
    let rendered = render::forward(gaussians, view, &settings.render);
    let wide = f64::from;
    let rgb: Vec<[f64; 3]> =
        photo.pixels.chunks_exact(3).map(|p| [wide(p[0]), wide(p[1]), wide(p[2])]).collect();
    let target = Target {
        width: photo.width,
        height: photo.height,
        rgb: &rgb,
        background: settings.background.map(wide),
        weights: None,
        ssim_share: wide(settings.ssim_share),
        depth: None,
        alpha: None,
    };
    let loss = loss::loss(&rendered.pixels, &target);
    let (gradient, _, _) =
        render::backward(gaussians, view, &settings.render, &rendered, &loss.gradient);
    (loss, gradient)
}

pub(super) fn step(
    device: &Device,
    seed: u64,
    (n, width, height): (usize, u32, u32),
    moving: bool,
) -> Result<Job> {
    let camera = camera(width, height);
    let mut rng = rng(seed + 9);
    let mut gaussians = cloud(seed, n, 3, &camera);
    let mut photo = Image::new(width, height, 3);
    photo.pixels.iter_mut().for_each(|v| *v = f32::from(rng.random::<u8>()) / 255.0);
    let start = moving.then(|| MotionStart {
        points: control_points(seed, NODES, &camera),
        network: Some(network(seed, NARROW)),
        neighbours: FOLLOWED,
    });
    if moving {
        gaussians = all_dynamic(gaussians);
    }
    let time = 0.25;
    let views = [TrainingView {
        camera,
        time,
        image: photo.clone(),
        weights: None,
        disparity: None,
        mask: None,
        every: 1,
    }];
    let settings = TrainSettings {
        steps: u32::MAX,
        // The capacity for intersections follows from this. It is large enough that the step
        // compared with the oracle is not repeated.
        max_gaussians: 8 * n,
        sh_interval: 0,
        growth: None,
        render: RenderSettings::default(),
        ..TrainSettings::default()
    };
    let mut trainer = Trainer::new(device, &views, &gaussians, start.as_ref(), settings.clone())?;
    trainer.step()?;
    let value = trainer
        .loss()?
        .ok_or_else(|| Error::Failed("a training step went without leaving its loss".into()))?;
    let after = trainer.gaussians()?;
    let mut scene = Scene::of(gaussians.clone());
    if let Some(MotionStart { points, network, neighbours }) = start.clone() {
        (scene.control_points, scene.network) = (points, network);
        scene.neighbours = neighbours as u32;
    }
    let placed = cloud_at(&scene, time);
    let (truth, gradient) = photometric(&placed, &View::new(&camera), &photo, &settings);
    let mut check = Check::new();
    // Where a splat crosses the α cut, a few pixels change by one level.
    let bound = Bound { absolute: 2e-5, relative: 0.0 };
    let device_value = [value.l1 as f32, value.ssim as f32];
    check.close("loss of the first step", &device_value, &[truth.l1, truth.ssim], bound);
    check_update(&mut check, &gaussians, &after, &gradient, &settings);
    // Forward and backward read and write the parameters, Adam reads and writes four arrays.
    let work =
        Work { bytes: n as u64 * 59 * 4 * 10 + u64::from(width * height) * 4 * 60, operations: 0 };
    Ok(Job {
        accuracy: check.accuracy(),
        work,
        place: Place::Device,
        reset: None,
        execute: Box::new(move || {
            trainer.step()?;
            trainer.finish()?;
            Ok(None)
        }),
    })
}

/// Adam's first step is the learning rate times the gradient's negative sign, whatever its
/// magnitude. It is checked for parameters whose gradient is clearly not zero.
fn check_update(
    check: &mut Check,
    before: &Gaussians,
    after: &Gaussians,
    gradient: &Cloud<f64>,
    settings: &TrainSettings,
) {
    let mut hold = |name: &str, before: &[f32], after: &[f32], by: &[f64], rate: f64| {
        let largest = by.iter().fold(0.0f64, |m, v| m.max(v.abs()));
        let clear = (0..by.len()).filter(|&i| by[i].abs() > 0.02 * largest);
        let (device, truth): (Vec<f32>, Vec<f64>) =
            clear.map(|i| (after[i], f64::from(before[i]) - rate * by[i].signum())).unzip();
        check.close(name, &device, &truth, Bound { absolute: 1e-2 * rate, relative: 1e-6 });
    };
    let rates = &settings.rates;
    let (old, new, by) = (&before.opacity_logits, &after.opacity_logits, &gradient.opacity_logits);
    hold("opacity after a step", old, new, by, rates.opacity);
    hold(
        "scales after a step",
        before.log_scales.as_flattened(),
        after.log_scales.as_flattened(),
        gradient.log_scales.as_flattened(),
        rates.log_scale,
    );
}

/// Two views of a smooth texture, the second moved by a little more than a pixel.
fn textures(seed: u64, width: u32, height: u32) -> [Image; 2] {
    let mut rng = rng(seed);
    let waves: Vec<[f32; 4]> = (0..12)
        .map(|_| {
            let (fx, fy) = (rng.random_range(-0.5f32..0.5), rng.random_range(-0.5f32..0.5));
            [fx, fy, rng.random_range(0.0..std::f32::consts::TAU), rng.random_range(0.02f32..0.07)]
        })
        .collect();
    let image = |du: f32, dv: f32| {
        let mut image = Image::new(width, height, 1);
        for (i, value) in image.pixels.iter_mut().enumerate() {
            let (x, y) = ((i as u32 % width) as f32 - du, (i as u32 / width) as f32 - dv);
            let sum: f32 = waves.iter().map(|[fx, fy, p, a]| a * (fx * x + fy * y + p).sin()).sum();
            *value = (0.5 + sum).clamp(0.0, 1.0);
        }
        image
    };
    [image(0.0, 0.0), image(1.3, -0.7)]
}

fn pair(device: &Device, seed: u64, width: u32, height: u32) -> Result<Job> {
    let settings = FlowSettings::default();
    let images = textures(seed, width, height);
    let plan = Flow::plan(width, height, &settings)?;
    let n = width as usize * height as usize;
    let mut frames = [plan.frame(device)?, plan.frame(device)?];
    let mut scratch = plan.scratch(device)?;
    let buffers = [
        device.upload("first image", &images[0].pixels)?,
        device.upload("second image", &images[1].pixels)?,
    ];
    let mut flows = [device.buffer::<[f32; 2]>("flow", n)?, device.buffer("flow back", n)?];
    let mut sure = [device.buffer::<f32>("confidence", n)?, device.buffer("confidence back", n)?];
    macro_rules! record {
        ($recorder:expr) => {{
            for (frame, pixels) in frames.iter_mut().zip(&buffers) {
                plan.record_frame($recorder, pixels.view(), 1, frame)?;
            }
            let [forward, backward] = &mut flows;
            let [sure_forward, sure_backward] = &mut sure;
            let args = FlowArgs {
                first: &frames[0],
                second: &frames[1],
                guess: None,
                flow: [forward.view_mut(), backward.view_mut()],
                confidence: [sure_forward.view_mut(), sure_backward.view_mut()],
            };
            plan.record($recorder, args, &mut scratch)
        }};
    }
    let mut stream = device.stream()?;
    let mut recorder = stream.record()?;
    record!(&mut recorder)?;
    stream.submit(recorder)?;
    let got = stream.download(&flows[0])?;
    let pyramid = |image: &Image| {
        let wide: Vec<f64> = image.pixels.iter().map(|&v| f64::from(v)).collect();
        Pyramid::new(&wide, width as usize, height as usize, 1, settings.coarsest_side)
    };
    let truth = oracle_flow(&pyramid(&images[0]), &pyramid(&images[1]), None, &settings);
    let mut check = Check::new();
    // Rounding can decide which candidate of a patch wins; refinement reduces the difference again.
    let tight = Bound { absolute: 2e-2, relative: 0.0 };
    let loose = Bound { absolute: 1.0, relative: 0.0 };
    let exact = truth.forward.as_flattened();
    check.mostly("flow", got.as_flattened(), exact, tight, 0.02, loose);
    Job::recorded(device, check.accuracy(), Work::default(), move |recorder| record!(recorder))
}

/// Bundle adjustment of poses and depths from exact observations, compared with the values that
/// generated them.
fn bundle(seed: u64, frames: usize, points: usize) -> Result<Job> {
    let mut rng = rng(seed);
    let intrinsics = Intrinsics::centred(500.0, 640, 480);
    let truth: Vec<Pose> = (0..frames)
        .map(|i| {
            let t = i as f64 / frames as f64;
            let turn = DQuat::from_euler(glam::EulerRot::XYZ, 0.05 * t, 0.2 * t, 0.02 * t);
            Pose::new(turn, DVec3::new(-0.8 * t, 0.1 * (5.0 * t).sin(), 0.2 * t))
        })
        .collect();
    let (mut all, mut observations) = (Vec::new(), Vec::new());
    for point in 0..points {
        let frame = rng.random_range(0..frames);
        let pixel = DVec2::new(rng.random_range(20.0..620.0), rng.random_range(20.0..460.0));
        let inverse_depth = rng.random_range(0.15..0.5);
        // Small and large frame distances of both parities, so that the problem is connected.
        for step in [1, 2, 3, 5, 7, 11] {
            let other = (frame + step) % frames;
            let relative = truth[other] * truth[frame].inverse();
            if let Some((pixel, _)) = project(&intrinsics, &relative, pixel, inverse_depth) {
                observations.push(Observation {
                    point,
                    frame: other,
                    pixel,
                    weight: 1.0,
                    deviation: 1.0,
                });
            }
        }
        all.push(Point { frame, pixel, inverse_depth, prior: None });
    }
    let mut problem = Problem {
        intrinsics,
        k1: 0.0,
        poses: truth.clone(),
        // The first and the last frame are fixed, which determines position and scale.
        fixed: (0..frames).map(|i| i == 0 || i + 1 == frames).collect(),
        points: all,
        observations,
    };
    let count = problem.observations.len() as u64;
    for pose in &mut problem.poses[1..frames - 1] {
        let mut jitter = || rng.random_range(-0.01..0.01);
        let turn = DQuat::from_euler(glam::EulerRot::XYZ, jitter(), jitter(), jitter());
        *pose = Pose::new(turn * pose.rotation, pose.translation + DVec3::new(jitter(), 0.0, 0.0));
    }
    for point in &mut problem.points {
        point.inverse_depth *= rng.random_range(0.9..1.1);
    }
    let options = Options { steps: 50, ..Options::default() };
    let mut solved = problem.clone();
    let report = adjust(&mut solved, &options)?;
    let flat = |poses: &[Pose]| -> Vec<f64> {
        let parts = poses
            .iter()
            .flat_map(|p| p.translation.to_array().into_iter().chain(p.rotation.to_array()));
        parts.collect()
    };
    let got: Vec<f32> = flat(&solved.poses).iter().map(|&v| v as f32).collect();
    let mut check = Check::new();
    // The poses are accurate to 1e-9; the bound covers the f32 of this comparison.
    check.close("poses", &got, &flat(&truth), Bound { absolute: 1e-6, relative: 0.0 });
    // A step forms each observation's Jacobian (13 columns of 2) and adds its products.
    let work = Work { bytes: 0, operations: report.steps as u64 * count * 700 };
    let state = Rc::new(RefCell::new(problem.clone()));
    let again = state.clone();
    Ok(Job {
        accuracy: check.accuracy(),
        work,
        place: Place::Processor,
        reset: Some(Box::new(move || {
            again.borrow_mut().clone_from(&problem);
            Ok(())
        })),
        execute: Box::new(move || adjust(&mut state.borrow_mut(), &options).map(|_| None)),
    })
}
