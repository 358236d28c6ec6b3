//! Training with a loss that the caller computes: the gradients are those of the caller's loss, in each
//! part of a step.

mod common;
mod host;

use host::{Host, camera, gaussians};
use splat4d::gpu::{Buffer, Device, Recorder, Stream};
use splat4d::ops::loss::{Loss, LossArgs, LossSettings, Reference};
use splat4d::oracle::view::{Cloud, View, perturbed};
use splat4d::oracle::{deform, mlp, path, render};
use splat4d::train::own_loss::{Differentiated, OwnGradients, Pass};
use splat4d::train::{
    MotionSettings, MotionStart, SYNC_INTERVAL, SceneOptimiser, TrainSettings, Trainer,
    TrainingView,
};
use splat4d::types::{
    Camera, ControlPoints, DeformNet, Gaussians, Image, NetShape, RenderSettings,
};

const SIZE: (u32, u32) = (33, 21);

/// Settings without the discontinuities of blending, so that finite differences are meaningful.
fn smooth() -> RenderSettings {
    RenderSettings {
        alpha_cut: 1e-12,
        alpha_cap: 0.95,
        transmittance_stop: 0.0,
        ..RenderSettings::default()
    }
}

fn settings() -> TrainSettings {
    TrainSettings {
        steps: 10,
        max_gaussians: 0,
        sh_degree: 0,
        sh_interval: 0,
        render: smooth(),
        growth: None,
        motion: MotionSettings { arap_weight: 0.0, ..MotionSettings::default() },
        ..TrainSettings::default()
    }
}

/// A loss that the engine does not have, and its derivatives with respect to red, green, blue, alpha and
/// depth.
fn loss(at: usize, rgba: [f64; 4], depth: f64) -> (f64, [f64; 5]) {
    let (mut value, mut slopes) = (0.0, [0.0; 5]);
    for c in 0..3 {
        let off = rgba[c] - 0.2 - 0.1 * ((at + 7 * c) as f64).sin();
        value += (1.0 + 5.0 * off * off).ln();
        slopes[c] = 10.0 * off / (1.0 + 5.0 * off * off);
    }
    value += 0.3 * rgba[3].powi(2) + 0.02 * depth.powi(2);
    slopes[3] = 0.6 * rgba[3];
    slopes[4] = 0.04 * depth;
    (value, slopes)
}

/// The loss of the oracle's render.
fn exact(cloud: &Cloud<f64>, camera: &Camera) -> f64 {
    let p = render::forward(cloud, &View::new(camera), &smooth()).pixels;
    let pixels = p.rgb.iter().zip(&p.alpha).zip(&p.depth).enumerate();
    pixels.map(|(i, ((c, &a), &d))| loss(i, [c[0], c[1], c[2], a], d).0).sum()
}

/// Runs the forward and the backward part of a step with this loss, so that the step's gradients can be
/// read.
fn differentiate(
    stream: &mut Stream,
    trainer: &mut SceneOptimiser,
    camera: &Camera,
    time: f64,
) -> Pass<Differentiated> {
    let device = stream.device().clone();
    let mut recorder = stream.record().unwrap();
    let pass = trainer.forward(&mut recorder, camera, time).unwrap();
    stream.submit(recorder).unwrap();
    let rgba = stream.download(&trainer.pixels(&pass).unwrap().rgba).unwrap();
    let depth = stream.download(&trainer.pixels(&pass).unwrap().depth).unwrap();
    let slopes: Vec<[f64; 5]> = rgba
        .iter()
        .zip(&depth)
        .enumerate()
        .map(|(i, (rgba, depth))| loss(i, rgba.map(f64::from), f64::from(*depth)).1)
        .collect();
    let by_rgba: Vec<[f32; 4]> =
        slopes.iter().map(|s| std::array::from_fn(|c| s[c] as f32)).collect();
    let by_depth: Vec<f32> = slopes.iter().map(|s| s[4] as f32).collect();
    let by_rgba = device.upload("by rgba", &by_rgba).unwrap();
    let by_depth = device.upload("by depth", &by_depth).unwrap();
    let mut recorder = stream.record().unwrap();
    let by = OwnGradients { rgba: by_rgba.view(), depth: Some(by_depth.view()) };
    let pass = trainer.backward(&mut recorder, pass, by).unwrap();
    let ticket = stream.submit(recorder).unwrap();
    stream.wait(ticket).unwrap();
    pass
}

/// Pairs of a gradient and a central difference, with a label.
#[derive(Default)]
struct Pairs(Vec<(String, f64, f64)>);

impl Pairs {
    const STEP: f64 = 1e-6;

    fn add(&mut self, what: String, gradient: f32, value: impl Fn(f64) -> f64) {
        let truth = (value(Self::STEP) - value(-Self::STEP)) / (2.0 * Self::STEP);
        self.0.push((what, f64::from(gradient), truth));
    }

    /// Checks every pair against the bound. The errors measured on lavapipe and SwiftShader are below a
    /// tenth of it.
    fn hold(&self) {
        let largest = self.0.iter().fold(0.0f64, |most, (_, _, truth)| most.max(truth.abs()));
        let mut worst = 0.0f64;
        for (what, gradient, truth) in &self.0 {
            let miss = (gradient - truth).abs() / (3e-7 * largest + 3e-5 * truth.abs());
            assert!(miss <= 1.0, "{what}: {gradient} instead of {truth} (largest {largest})");
            worst = worst.max(miss);
        }
        println!("{} gradients, the worst at {worst:.3} of the bound", self.0.len());
    }
}

/// The loss after a change of the given size.
fn after(
    change: impl Fn(&mut Cloud<f64>, f64),
    cloud: &Cloud<f64>,
    camera: &Camera,
) -> impl Fn(f64) -> f64 {
    move |h| {
        let mut moved = cloud.clone();
        change(&mut moved, h);
        exact(&moved, camera)
    }
}

#[test]
fn gradients_are_those_of_the_callers_loss() {
    let device = common::device();
    let mut stream = device.stream().unwrap();
    let scene = gaussians(9);
    let camera = camera(SIZE.0, SIZE.1);
    let mut trainer = SceneOptimiser::new(&device, &scene, None, 1.0, settings()).unwrap();
    let pass = differentiate(&mut stream, &mut trainer, &camera, 0.0);
    let found = trainer.gradients(&pass).unwrap();
    let g = found.gaussians;
    let [positions, scales, opacities, colours] =
        [&g.positions, &g.log_scales, &g.opacity_logits, &g.sh[0]]
            .map(|buffer| stream.download(buffer).unwrap());
    let rotations = stream.download(&g.rotations).unwrap();
    let pose = stream.download(found.pose).unwrap();
    assert!(trainer.conclude(pass).unwrap());
    let cloud = Cloud::<f64>::new(&scene);
    let mut pairs = Pairs::default();
    for i in 0..scene.len() {
        let mut add = |what: &str, gradient: f32, change: &dyn Fn(&mut Cloud<f64>, f64)| {
            pairs.add(format!("{what} of {i}"), gradient, after(change, &cloud, &camera));
        };
        for k in 0..3 {
            add("position", positions[3 * i + k], &|c, h| c.positions[i][k] += h);
            add("scale", scales[3 * i + k], &|c, h| c.log_scales[i][k] += h);
            add("colour", colours[3 * i + k], &|c, h| c.sh[i][k] += h);
        }
        for k in 0..4 {
            add("rotation", rotations[i][k], &|c, h| c.rotations[i][k] += h);
        }
        add("opacity", opacities[i], &|c, h| c.opacity_logits[i] += h);
    }
    for k in 0..6 {
        pairs.add(format!("pose {k}"), pose[k], |h| {
            let mut twist = [0.0; 6];
            twist[k] = h;
            exact(&cloud, &perturbed(&camera, twist))
        });
    }
    pairs.hold();
    common::assert_valid(&device);
}

/// A motion model: eight control points on paths with four key times.
fn paths() -> MotionStart {
    let at = |i: usize| (i * 37 % 101) as f32 / 50.0 - 1.0;
    let mut paths = vec![[0.0; 8]; 32];
    for (i, motion) in paths.iter_mut().enumerate() {
        (0..8).filter(|k| *k != 3).for_each(|k| motion[k] = 0.1 * at(8 * i + k));
    }
    let positions = gaussians(8).positions;
    MotionStart {
        points: ControlPoints { positions, log_radii: vec![-0.3; 8], paths },
        network: None,
        neighbours: 3,
    }
}

/// A motion model: eight control points, and a network that moves them.
fn motion() -> MotionStart {
    let shape = NetShape {
        depth: 2,
        width: 16,
        skip: 9,
        position_frequencies: 2,
        time_frequencies: 2,
        ..NetShape::PAPER
    };
    let mut network = DeformNet::random(shape, 5);
    // The network's head is initialised to zero; here it must produce motion.
    let count = network.parameters.len();
    for (i, value) in network.parameters.iter_mut().enumerate().skip(count - 7 * 17) {
        *value += 0.05 * ((i * 37 % 101) as f32 / 50.0 - 1.0);
    }
    let positions = gaussians(8).positions;
    MotionStart {
        points: ControlPoints { positions, log_radii: vec![-0.3; 8], paths: vec![] },
        network: Some(network),
        neighbours: 3,
    }
}

#[test]
fn gradients_reach_network_and_radii() {
    gradients_reach(&motion());
}

#[test]
fn gradients_reach_paths_and_radii() {
    gradients_reach(&paths());
}

fn gradients_reach(start: &MotionStart) {
    const TIME: f64 = 0.4;
    let device = common::device();
    let mut stream = device.stream().unwrap();
    let mut scene = gaussians(9);
    scene.motion_logits = (0..9).map(|i| if i < 6 { 2.0 } else { -2.0 }).collect();
    let camera = camera(SIZE.0, SIZE.1);
    let mut trainer = SceneOptimiser::new(&device, &scene, Some(start), 1.0, settings()).unwrap();
    let pass = differentiate(&mut stream, &mut trainer, &camera, TIME);
    let found = trainer.gradients(&pass).unwrap();
    let (model, radii) = found.motion.unwrap();
    let (model, radii) = (stream.download(model).unwrap(), stream.download(radii).unwrap());
    let opacities = stream.download(&found.gaussians.opacity_logits).unwrap();
    assert!(trainer.conclude(pass).unwrap());

    let wide = |v: &[f32]| v.iter().map(|&v| f64::from(v)).collect::<Vec<f64>>();
    let parameters = match &start.network {
        Some(network) => wide(&network.parameters),
        None => wide(start.points.paths.as_flattened()),
    };
    let log_radii = wide(&start.points.log_radii);
    let nodes: Vec<[f64; 3]> = start.points.positions.iter().map(|p| p.map(f64::from)).collect();
    let cloud = Cloud::<f64>::new(&scene);
    let dynamic: Vec<u32> = (0..6).collect();
    let near = deform::nearest(&cloud.positions[..6], &nodes, 3);
    // The device has the time as f32.
    let time = f64::from(TIME as f32);
    let value = |parameters: &[f64], log_radii: &[f64], opacity: f64| {
        let transforms: Vec<[f64; 8]> = match &start.network {
            Some(network) => {
                let query = |p: &[f64; 3]| [p[0], p[1], p[2], time];
                let queries: Vec<[f64; 4]> = nodes.iter().map(query).collect();
                let outputs = mlp::forward(&network.shape, parameters, &queries).outputs;
                outputs.into_iter().map(mlp::transform).collect()
            }
            None => path::evaluate(parameters.as_chunks().0, nodes.len(), &[time]),
        };
        let skinned = deform::forward(&deform::Skin {
            positions: &cloud.positions,
            rotations: &cloud.rotations,
            opacity_logits: &cloud.opacity_logits,
            motion_logits: &[],
            evidence: &[],
            gaussian_from_dynamic: &dynamic,
            neighbours: &near,
            k: 3,
            nodes: &nodes,
            log_radii,
            transforms: &transforms,
            soft: false,
        });
        let mut moved = cloud.clone();
        (moved.positions, moved.rotations) = (skinned.positions, skinned.rotations);
        moved.opacity_logits = skinned.opacity_logits;
        moved.opacity_logits[2] += opacity;
        exact(&moved, &camera)
    };
    let mut pairs = Pairs::default();
    // The opacity offset (component 3) of a path's motion is given, so it has no gradient.
    let is_given = |i: &usize| start.network.is_none() && i % 8 == 3;
    for i in (0..parameters.len()).step_by(13).filter(|i| !is_given(i)) {
        pairs.add(format!("parameter {i}"), model[i], |h| {
            let mut changed = parameters.clone();
            changed[i] += h;
            value(&changed, &log_radii, 0.0)
        });
    }
    for i in 0..8 {
        pairs.add(format!("radius {i}"), radii[i], |h| {
            let mut changed = log_radii.clone();
            changed[i] += h;
            value(&parameters, &changed, 0.0)
        });
    }
    pairs.add("opacity".into(), opacities[2], |h| value(&parameters, &log_radii, h));
    pairs.hold();
    common::assert_valid(&device);
}

fn target() -> Image {
    let mut image = Image::new(SIZE.0, SIZE.1, 3);
    for (i, value) in image.pixels.iter_mut().enumerate() {
        *value = 0.5 + 0.4 * (i as f32 * 0.07).sin();
    }
    image
}

/// One step with the engine's loss, recorded through the public ops.
fn step(
    device: &Device,
    stream: &mut Stream,
    trainer: &mut SceneOptimiser,
    reference: &Reference,
) -> bool {
    let loss = Loss::plan(device, SIZE.0, SIZE.1);
    let mut scratch = loss.scratch(device).unwrap();
    let render = splat4d::ops::render::Render::plan(device, 1, 1, SIZE.0, SIZE.1, smooth());
    let mut gradients = render.unwrap().pixel_gradients(device).unwrap();
    let how = LossSettings { depth_scale: 1.0, ..LossSettings::default() };
    let mut recorder = stream.record().unwrap();
    let pass = trainer.forward(&mut recorder, &camera(SIZE.0, SIZE.1), 0.0).unwrap();
    let pixels = trainer.pixels(&pass).unwrap();
    let args = LossArgs { rendered: pixels, reference, disparity: None, gradients: &mut gradients };
    loss.record(&mut recorder, &how, args, &mut scratch).unwrap();
    let by = OwnGradients { rgba: gradients.rgba.view(), depth: Some(gradients.depth.view()) };
    let pass = trainer.backward(&mut recorder, pass, by).unwrap();
    let pass = trainer.update(&mut recorder, pass).unwrap();
    let ticket = stream.submit(recorder).unwrap();
    stream.wait(ticket).unwrap();
    trainer.conclude(pass).unwrap()
}

#[test]
fn steps_from_outside_are_the_trainers_own() {
    let device = common::device();
    let mut stream = device.stream().unwrap();
    let scene = gaussians(40);
    let settings = TrainSettings { ssim_share: 0.2, ..settings() };
    let view = TrainingView {
        camera: camera(SIZE.0, SIZE.1),
        time: 0.0,
        image: target(),
        weights: None,
        disparity: None,
        mask: None,
        every: 1,
    };
    let mut own = Trainer::new(&device, &[view], &scene, None, settings.clone()).unwrap();
    let mut outside = SceneOptimiser::new(&device, &scene, None, 1.0, settings).unwrap();
    let reference = Reference::new(&device, &target(), None).unwrap();
    for _ in 0..5 {
        own.step().unwrap();
        assert!(step(&device, &mut stream, &mut outside, &reference));
    }
    assert_eq!(outside.progress().step, 5);
    let trained = outside.gaussians().unwrap();
    assert_ne!(trained, scene);
    assert_eq!(trained, own.gaussians().unwrap());
    common::assert_valid(&device);
}

#[test]
fn steps_from_outside_resume() {
    let device = common::device();
    let mut stream = device.stream().unwrap();
    let scene = gaussians(20);
    let settings = TrainSettings { steps: 200, ..settings() };
    let reference = Reference::new(&device, &target(), None).unwrap();
    let mut trainer = SceneOptimiser::new(&device, &scene, None, 1.0, settings.clone()).unwrap();
    for _ in 0..SYNC_INTERVAL {
        assert!(step(&device, &mut stream, &mut trainer, &reference));
    }
    let state = trainer.state().unwrap();
    let mut resumed = SceneOptimiser::resume(&device, state, settings).unwrap();
    for _ in 0..3 {
        assert!(step(&device, &mut stream, &mut trainer, &reference));
        assert!(step(&device, &mut stream, &mut resumed, &reference));
    }
    assert_eq!(resumed.progress().step, SYNC_INTERVAL + 3);
    assert_eq!(resumed.gaussians().unwrap(), trainer.gaussians().unwrap());
    common::assert_valid(&device);
}

#[test]
fn steps_run_in_a_hosts_command_buffer() {
    let host = Host::new();
    let semaphore = host.semaphore();
    {
        // SAFETY: the handles belong together, and one thread uses the queue.
        let device = unsafe { Device::adopt(host.lend()) }.unwrap();
        let scene = gaussians(9);
        let mut trainer = SceneOptimiser::new(&device, &scene, None, 1.0, settings()).unwrap();
        let commands = host.commands();
        let area = (SIZE.0 * SIZE.1) as usize;
        let mut by_rgba: Buffer<[f32; 4]> = device.buffer("by rgba", area).unwrap();
        host.begin(commands);
        // SAFETY: the command buffer has begun and is submitted once; the guards outlive the wait.
        let mut recorder = unsafe { Recorder::over(&device, commands) }.unwrap();
        let pass = trainer.forward(&mut recorder, &camera(SIZE.0, SIZE.1), 0.0).unwrap();
        let first = recorder.finish().unwrap();
        // A host computes its loss here; this loss is the sum of all values.
        // SAFETY: the command buffer is recording.
        unsafe {
            let to = by_rgba.handle();
            host.device.cmd_fill_buffer(commands, to.buffer, to.offset, to.bytes, 0x3f80_0000);
        }
        // SAFETY: as above.
        let mut recorder = unsafe { Recorder::over(&device, commands) }.unwrap();
        let by = OwnGradients { rgba: by_rgba.view(), depth: None };
        let pass = trainer.backward(&mut recorder, pass, by).unwrap();
        let pass = trainer.update(&mut recorder, pass).unwrap();
        let second = recorder.finish().unwrap();
        host.submit(commands, semaphore, 1);
        host.wait(semaphore, 1);
        drop((first, second));
        assert!(trainer.conclude(pass).unwrap());
        let after = trainer.gaussians().unwrap();
        // The step reduces the sum, so every opacity falls.
        for i in 0..scene.len() {
            assert!(after.opacity_logits[i] < scene.opacity_logits[i], "Gaussian {i}");
        }
        let _ = by_rgba.view_mut();
    }
    host.destroy_semaphore(semaphore);
}

#[test]
fn a_frame_that_does_not_fit_teaches_nothing_and_comes_again() {
    let device = common::device();
    let mut stream = device.stream().unwrap();
    // Each Gaussian covers all of the 1200 tiles.
    let mut scene: Gaussians = gaussians(40);
    scene.log_scales = vec![[1.5; 3]; 40];
    let big = camera(640, 480);
    let mut trainer = SceneOptimiser::new(&device, &scene, None, 1.0, settings()).unwrap();
    let by: Buffer<[f32; 4]> = device.upload("by rgba", &vec![[1.0f32; 4]; 640 * 480]).unwrap();
    let mut step = |trainer: &mut SceneOptimiser| {
        let mut recorder = stream.record().unwrap();
        let pass = trainer.forward(&mut recorder, &big, 0.0).unwrap();
        let by = OwnGradients { rgba: by.view(), depth: None };
        let pass = trainer.backward(&mut recorder, pass, by).unwrap();
        let pass = trainer.update(&mut recorder, pass).unwrap();
        let ticket = stream.submit(recorder).unwrap();
        stream.wait(ticket).unwrap();
        trainer.conclude(pass).unwrap()
    };
    assert!(!step(&mut trainer));
    assert_eq!(trainer.progress().step, 0);
    assert_eq!(trainer.gaussians().unwrap(), scene);
    assert!(step(&mut trainer));
    assert_eq!(trainer.progress().step, 1);
    assert_ne!(trainer.gaussians().unwrap(), scene);
    common::assert_valid(&device);
}

/// A NaN loss: the parameters stay as they are, and the broken gradients are counted.
#[test]
fn gradients_that_are_no_numbers_are_left_out_and_counted() {
    let device = common::device();
    let mut stream = device.stream().unwrap();
    let scene = gaussians(9);
    let camera = camera(SIZE.0, SIZE.1);
    let mut trainer = SceneOptimiser::new(&device, &scene, None, 1.0, settings()).unwrap();
    let mut by = vec![[1.0f32; 4]; (SIZE.0 * SIZE.1) as usize];
    let mut step = |trainer: &mut SceneOptimiser, by: &[[f32; 4]]| {
        let by: Buffer<[f32; 4]> = device.upload("by rgba", by).unwrap();
        let mut recorder = stream.record().unwrap();
        let pass = trainer.forward(&mut recorder, &camera, 0.0).unwrap();
        let by = OwnGradients { rgba: by.view(), depth: None };
        let pass = trainer.backward(&mut recorder, pass, by).unwrap();
        let pass = trainer.update(&mut recorder, pass).unwrap();
        let ticket = stream.submit(recorder).unwrap();
        stream.wait(ticket).unwrap();
        assert!(trainer.conclude(pass).unwrap());
    };
    step(&mut trainer, &by);
    assert_eq!(trainer.broken_gradients().unwrap(), 0);
    let before = trainer.gaussians().unwrap();
    by.fill([f32::NAN; 4]);
    step(&mut trainer, &by);
    let broken = trainer.broken_gradients().unwrap();
    // Position, scale, rotation, opacity and colour of each Gaussian: 14 numbers.
    assert!((9..=9 * 14).contains(&broken), "{broken} gradients");
    let after = trainer.gaussians().unwrap();
    assert_eq!(after, before);
    // The count is part of the training state.
    let state = trainer.state().unwrap();
    let mut trainer = SceneOptimiser::resume(&device, state, settings()).unwrap();
    assert_eq!(trainer.broken_gradients().unwrap(), broken);
    by.fill([1.0; 4]);
    step(&mut trainer, &by);
    assert_eq!(trainer.broken_gradients().unwrap(), broken);
    assert_ne!(trainer.gaussians().unwrap(), before);
    common::assert_valid(&device);
}

#[test]
fn steps_out_of_turn_are_named() {
    let device = common::device();
    let mut stream = device.stream().unwrap();
    let scene = gaussians(3);
    let camera = camera(SIZE.0, SIZE.1);
    let new =
        |scene: &Gaussians, extent| SceneOptimiser::new(&device, scene, None, extent, settings());
    assert!(new(&scene, f64::NAN).is_err());
    assert!(new(&Gaussians::default(), 1.0).is_err());
    let (mut trainer, mut other) = (new(&scene, 1.0).unwrap(), new(&scene, 1.0).unwrap());
    let by = device.buffer::<[f32; 4]>("by rgba", (SIZE.0 * SIZE.1) as usize).unwrap();
    let few = device.buffer::<[f32; 4]>("few", 7).unwrap();
    let given = OwnGradients { rgba: by.view(), depth: None };
    let mut recorder = stream.record().unwrap();
    let mut pass = trainer.forward(&mut recorder, &camera, 0.0).unwrap();
    assert!(trainer.fits(&mut pass).is_err(), "the device has not finished");
    let error = trainer.forward(&mut recorder, &camera, 0.0).err().unwrap().to_string();
    assert!(error.contains("a step with a loss of your own is in progress"), "{error}");
    let error = other.pixels(&pass).err().unwrap().to_string();
    assert!(error.contains("of another optimiser"), "{error}");
    // A part that fails ends the step.
    let short = OwnGradients { rgba: few.view(), depth: None };
    assert!(trainer.backward(&mut recorder, pass, short).is_err());
    let pass = trainer.forward(&mut recorder, &camera, 0.0).unwrap();
    let pass = trainer.backward(&mut recorder, pass, given).unwrap();
    let ticket = stream.submit(recorder).unwrap();
    stream.wait(ticket).unwrap();
    assert!(trainer.conclude(pass).unwrap());
    // Without an update no parameter changes.
    assert_eq!((trainer.progress().step, trainer.gaussians().unwrap()), (0, scene));
}
