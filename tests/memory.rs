//! Predicted device memory against the memory that is used.

mod common;

use splat4d::Error;
use splat4d::gpu::{Device, Footprint};
use splat4d::renderer::{RenderScale, Renderer};
use splat4d::scene::Scene;
use splat4d::train::{
    GrowthSettings, MotionSettings, MotionStart, PosedMotion, SelectionSettings, SequenceSettings,
    TrainSettings, Trainer, TrainingScale, TrainingView, posed_scale,
};
use splat4d::types::{
    Camera, ControlPoints, DeformNet, Gaussians, Image, Intrinsics, MotionScale, NetShape, Pose,
    Tuning,
};
use splat4d::vk::Limits;

/// Allowed relative difference between predicted and used memory: the run's buffers are counted exactly,
/// but the upload of one image may end before or after the next begins.
const BOUND: f64 = 0.01;

const NETWORK: NetShape = NetShape {
    depth: 2,
    width: 32,
    skip: 9,
    position_frequencies: 2,
    time_frequencies: 2,
    ..NetShape::PAPER
};

/// Small splats spread over the camera's view, so that each touches a tile or two.
fn cloud(count: usize, sh_degree: u32) -> Gaussians {
    let coefficients = ((sh_degree + 1) * (sh_degree + 1)) as usize;
    let place = |i: usize| {
        let (u, v) = ((i as f32 * 0.618_034).fract(), (i as f32 * 0.754_877_7).fract());
        [0.8 * (2.0 * u - 1.0), 0.6 * (2.0 * v - 1.0), 2.0 + (i % 7) as f32 * 0.1]
    };
    Gaussians {
        positions: (0..count).map(place).collect(),
        log_scales: vec![[-7.0; 3]; count],
        rotations: vec![[1.0, 0.0, 0.0, 0.0]; count],
        opacity_logits: vec![0.0; count],
        sh_degree,
        sh: vec![[0.1; 3]; count * coefficients],
        motion_logits: (0..count).map(|i| if i % 2 == 0 { 2.0 } else { -4.0 }).collect(),
    }
}

fn camera(width: u32, height: u32) -> Camera {
    let intrinsics = Intrinsics::centred(f64::from(width), width, height);
    Camera { intrinsics, view_from_world: Pose::IDENTITY }
}

fn views(count: usize, width: u32, height: u32, known: bool) -> Vec<TrainingView> {
    let view = TrainingView {
        camera: camera(width, height),
        time: 0.5,
        image: Image::new(width, height, 3),
        weights: None,
        disparity: known.then(|| Image::new(width, height, 2)),
        mask: known.then(|| Image::new(width, height, 1)),
        every: 1,
    };
    vec![view; count]
}

/// Number of key times of the control points' paths.
const KEYS: usize = 12;

fn points(count: usize) -> ControlPoints {
    ControlPoints {
        positions: cloud(count, 0).positions,
        log_radii: vec![-1.0; count],
        paths: vec![[0.0; 8]; KEYS * count],
    }
}

#[track_caller]
fn close(what: &str, foreseen: &Footprint, device: &Device) {
    let taken = device.memory().1;
    let off = foreseen.bytes as f64 / taken as f64 - 1.0;
    println!("{what}: {} bytes foreseen, {taken} taken, {:+.2} %", foreseen.bytes, 100.0 * off);
    assert!(off.abs() <= BOUND, "{what}: {} foreseen, {taken} taken", foreseen.bytes);
}

#[test]
fn a_static_training_takes_what_was_foreseen() {
    for (count, width, height) in [(3000, 96, 64), (40_000, 400, 300)] {
        let device = common::device();
        let settings =
            TrainSettings { steps: 4, max_gaussians: 0, growth: None, ..Default::default() };
        let views = views(5, width, height, false);
        let scale = TrainingScale::new(&views, count, None, settings.clone());
        let foreseen = scale.footprint(&device).unwrap();
        assert_eq!(device.memory().1, 0, "foreseeing takes nothing");
        let mut trainer = Trainer::new(&device, &views, &cloud(count, 3), None, settings).unwrap();
        (0..4).for_each(|_| trainer.step().unwrap());
        trainer.gaussians().unwrap();
        close(&format!("{count} static Gaussians"), &foreseen, &device);
        common::assert_valid(&device);
    }
}

#[test]
fn a_moving_training_takes_what_was_foreseen() {
    for (count, nodes, width, height) in [(3000, 20, 96, 64), (40_000, 200, 400, 300)] {
        let device = common::device();
        let settings = TrainSettings {
            steps: 6,
            max_gaussians: count + 1000,
            growth: Some(GrowthSettings::Adaptive(splat4d::train::AdaptiveSettings::scaled_to(6))),
            motion: MotionSettings {
                selection: Some(SelectionSettings::scaled_to(6)),
                ..Default::default()
            },
            ..Default::default()
        };
        let views = views(5, width, height, true);
        let start = MotionStart { points: points(nodes), network: None, neighbours: 4 };
        let motion =
            MotionScale { control_points: nodes, keys: KEYS, network: None, neighbours: 4 };
        let scale = TrainingScale::new(&views, count, Some(motion), settings.clone());
        let foreseen = scale.footprint(&device).unwrap();
        let mut trainer =
            Trainer::new(&device, &views, &cloud(count, 3), Some(&start), settings).unwrap();
        (0..6).for_each(|_| trainer.step().unwrap());
        trainer.gaussians().unwrap();
        close(&format!("{count} moving Gaussians"), &foreseen, &device);
        common::assert_valid(&device);
    }
}

#[test]
fn rendering_takes_what_was_foreseen() {
    for (count, width, height) in [(3000, 96, 64), (60_000, 640, 480)] {
        for (moving, half) in [(false, false), (false, true), (true, false)] {
            let device = common::device();
            let mut scene = Scene::of(cloud(count, 3));
            if moving {
                scene.control_points = points(64);
                if count == 3000 {
                    scene.control_points.paths.clear();
                    scene.network = Some(DeformNet::random(NETWORK, 1));
                }
            } else {
                scene.gaussians.motion_logits.clear();
            }
            let tuning = Tuning { half_sh: half, half_shapes: half, ..Tuning::default() };
            let scale = RenderScale::new(&scene, (width, height), &tuning);
            let foreseen = scale.footprint(&device).unwrap();
            let mut renderer = Renderer::tuned(&device, &scene, &tuning).unwrap();
            (0..2).for_each(|_| drop(renderer.render(&camera(width, height), 0.5).unwrap()));
            let what = format!("rendering {count}, moving {moving}, half {half}");
            close(&what, &foreseen, &device);
            common::assert_valid(&device);
        }
    }
}

/// Splats that each cover a large part of the image.
fn wide(count: usize) -> Scene {
    let gaussians = cloud(count, 0);
    Scene::of(Gaussians {
        log_scales: vec![[0.0; 3]; count],
        opacity_logits: vec![-2.0; count],
        motion_logits: Vec::new(),
        ..gaussians
    })
}

#[test]
fn wide_splats_are_counted_and_take_what_was_foreseen() {
    let device = common::device();
    let (scene, tuning) = (wide(3000), Tuning::default());
    let camera = camera(160, 96);
    let mut counter = Renderer::tuned(&device, &scene, &tuning).unwrap();
    let counted = counter.count(&camera, 0.0).unwrap() as usize;
    assert!(counted > 40 * 3000, "{counted} pairs: most of 60 tiles each");
    drop(counter);
    device.restart_memory_peak();

    let base = RenderScale::new(&scene, (160, 96), &tuning);
    let scale = RenderScale { intersections: counted, ..base };
    assert!(scale.is_dense() && !base.is_dense());
    let foreseen = scale.footprint(&device).unwrap();
    assert!(foreseen.bytes > 2 * base.footprint(&device).unwrap().bytes);
    let mut renderer = Renderer::tuned(&device, &scene, &tuning).unwrap();
    renderer.reserve(counted);
    let reserved = renderer.render(&camera, 0.0).unwrap();
    close("wide splats", &foreseen, &device);

    // Without the reservation the pairs are counted first: the image is the same, and so is the memory.
    drop(renderer);
    device.restart_memory_peak();
    let mut renderer = Renderer::tuned(&device, &scene, &tuning).unwrap();
    assert!(renderer.render(&camera, 0.0).unwrap().rgba == reserved.rgba);
    close("wide splats, unreserved", &foreseen, &device);

    // A second image with more pairs is drawn twice, after a quarter more capacity is allocated.
    drop(renderer);
    device.restart_memory_peak();
    let mut renderer = Renderer::tuned(&device, &scene, &tuning).unwrap();
    let half = Camera {
        view_from_world: Pose {
            rotation: Pose::IDENTITY.rotation,
            translation: [1.6, 0.0, 0.0].into(),
        },
        ..camera
    };
    assert!(renderer.count(&half, 0.0).unwrap() < counted as u64);
    renderer.render(&half, 0.0).unwrap();
    assert!(renderer.render(&camera, 0.0).unwrap().rgba == reserved.rgba);
    let taken = device.memory().1 as f64;
    assert!(taken < 1.3 * foreseen.bytes as f64, "{taken} taken, {} foreseen", foreseen.bytes);

    // More memory than any device has.
    let before = device.memory().0;
    renderer.reserve(u32::MAX as usize);
    let error = renderer.render(&camera, 0.0).unwrap_err();
    assert!(matches!(error, Error::TooLarge { .. } | Error::RangeLimit { .. }), "{error}");
    renderer.reserve(1 << 32);
    let error = renderer.render(&camera, 0.0).unwrap_err();
    assert!(matches!(&error, Error::RangeLimit { label, .. } if label == "tile keys"), "{error}");
    assert!(device.memory().0 <= before);
    common::assert_valid(&device);
}

/// 100,000 splats on about 190 tiles each: the scene's arrays are small, but rendering needs much memory.
#[test]
fn a_crowd_of_wide_splats_takes_what_was_foreseen() {
    let (count, width, height, tuning) = (100_000, 640, 360, Tuning::default());
    let device = common::device();
    let small = cloud(count, 0);
    let scene = Scene::of(Gaussians {
        positions: small.positions.iter().map(|p| p.map(|x| 160.0 * x)).collect(),
        log_scales: vec![[3.0; 3]; count],
        motion_logits: Vec::new(),
        ..small
    });
    let camera = camera(width, height);
    let mut renderer = Renderer::tuned(&device, &scene, &tuning).unwrap();
    let intersections = renderer.count(&camera, 0.0).unwrap() as usize;
    drop(renderer);
    device.restart_memory_peak();
    let base = RenderScale::new(&scene, (width, height), &tuning);
    let scale = RenderScale { intersections, ..base };
    let foreseen = scale.footprint(&device).unwrap();
    eprintln!("{intersections} pairs");
    assert!(foreseen.bytes > 10 * base.footprint(&device).unwrap().bytes);
    // Rendering without counting first takes no more.
    let mut renderer = Renderer::tuned(&device, &scene, &tuning).unwrap();
    renderer.render(&camera, 0.0).unwrap();
    close("a crowd of wide splats", &foreseen, &device);
    common::assert_valid(&device);
}

#[test]
fn a_training_of_wide_splats_takes_what_was_foreseen() {
    let device = common::device();
    let scene = wide(3000);
    let views = views(3, 160, 96, false);
    let settings = TrainSettings { steps: 3, max_gaussians: 0, growth: None, ..Default::default() };
    let mut counter = Renderer::new(&device, &scene).unwrap();
    let intersections = counter.count(&views[0].camera, 0.0).unwrap() as usize;
    drop(counter);
    device.restart_memory_peak();
    let base = TrainingScale::new(&views, 3000, None, settings.clone());
    let scale = TrainingScale { intersections, ..base.clone() };
    assert!(scale.is_dense() && !base.is_dense());
    let foreseen = scale.footprint(&device).unwrap().bytes as f64;
    let mut trainer = Trainer::new(&device, &views, &scene.gaussians, None, settings).unwrap();
    (0..3).for_each(|_| trainer.step().unwrap());
    trainer.gaussians().unwrap();
    // The splats change during training, so the bound is a tenth.
    let off = foreseen / device.memory().1 as f64;
    assert!((0.9..1.1).contains(&off), "{foreseen} foreseen, {} taken", device.memory().1);
    common::assert_valid(&device);
}

#[test]
fn sizes_beyond_every_device_are_errors() {
    let device = common::device();
    let views = views(2, 64, 48, false);
    for count in [1 << 30, 1 << 32, 1 << 62, usize::MAX] {
        let settings = TrainSettings { max_gaussians: count, ..Default::default() };
        let scale = TrainingScale::new(&views, count, None, settings);
        let error = scale.footprint(&device).unwrap_err();
        assert!(matches!(error, Error::RangeLimit { .. }), "{count}: {error}");
        let scene = Scene::of(cloud(1, 0));
        let scale = RenderScale::new(&scene, (64, 48), &Tuning::default());
        let error = RenderScale { gaussians: count, ..scale }.footprint(&device).unwrap_err();
        assert!(matches!(error, Error::RangeLimit { .. }), "{count}: {error}");
    }
}

#[test]
fn what_does_not_fit_is_told_and_what_would() {
    let device = common::device();
    // A hundredth of the usual binding size.
    let small = device.with_limits(Limits { storage_range: 1 << 20, ..*device.limits() });
    let views = views(2, 64, 48, false);
    let settings = TrainSettings { growth: None, max_gaussians: 0, ..Default::default() };
    let of = |count| TrainingScale::new(&views, count, None, settings.clone());
    let error = of(100_000).footprint(&small).unwrap_err();
    assert!(matches!(&error, Error::RangeLimit { limit: 1_048_576, .. }), "{error}");
    let most = of(100_000).most_gaussians(&small);
    // The largest buffer takes 84 bytes per Gaussian, for the highest band of spherical harmonics.
    assert!((12_400..=12_483).contains(&most), "{most}");
    of(most).footprint(&small).unwrap();
    of(most + most / 200).footprint(&small).unwrap_err();

    let scene = Scene::of(cloud(10, 3));
    let scale = RenderScale {
        gaussians: 100_000,
        ..RenderScale::new(&scene, (64, 48), &Tuning::default())
    };
    scale.footprint(&small).unwrap_err();
    assert_eq!(scale.most_gaussians(&small), most);

    // On the whole device the limit is the memory or the binding size.
    let most = scale.most_gaussians(&device);
    assert!(most > 100_000, "{most}");
    let fits = |gaussians| {
        let taken = RenderScale { gaussians, ..scale }.footprint(&device)?;
        taken.fits(&device)
    };
    fits(most).unwrap();
    fits(most + most / 200).unwrap_err();
    assert_eq!(device.memory().1, 0, "nothing was made");
    common::assert_valid(&device);
}

#[test]
fn whole_runs_are_foreseen_at_their_largest() {
    let device = common::device();
    let views = views(3, 64, 48, false);
    let settings = TrainSettings { steps: 40, max_gaussians: 2000, ..Default::default() };
    let bytes = |motion: Option<&PosedMotion>, count| {
        posed_scale(&views, count, motion, &settings).footprint(&device).unwrap().bytes
    };
    let (still, moving) = (bytes(None, 2000), bytes(Some(&PosedMotion::default()), 2000));
    assert!(moving > still, "{moving}, {still}");
    let sequence = SequenceSettings { max_gaussians: 3000, ..Default::default() };
    let of = |frames| sequence.scale(frames, (64, 48)).footprint(&device).unwrap().bytes;
    // A reference image, disparity and mask: 4, 8 and 4 bytes per pixel. A key time of the paths:
    // parameters, gradients and two moments, at a revision also those of the next paths, and the
    // readback.
    let key = 9 * 32 * sequence.control_points as u64;
    // Offset views, which have no mask: twelve per ten frames, three of them in a round.
    assert_eq!(of(30) - of(20), 10 * (16 * 64 * 48 + key) + 12 * 12 * 64 * 48);
    // For a long clip all of them are in every round.
    assert_eq!(of(110) - of(100), 10 * (16 * 64 * 48 + key) + 3 * 12 * 64 * 48);
}
