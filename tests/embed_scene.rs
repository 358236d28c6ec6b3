//! Scenes on the device: edits in place, and queries.

mod common;
mod host;

use glam::DVec3;
use host::{camera, gaussians};
use splat4d::gpu::{Device, Recorder};
use splat4d::renderer::{Renderer, Target};
use splat4d::scene::Scene;
use splat4d::types::{ControlPoints, DeformNet, Gaussians, NetShape, Tuning};
use std::ops::Range;

fn part(all: &Gaussians, range: Range<usize>) -> Gaussians {
    let logits = &all.motion_logits;
    Gaussians {
        positions: all.positions[range.clone()].to_vec(),
        log_scales: all.log_scales[range.clone()].to_vec(),
        rotations: all.rotations[range.clone()].to_vec(),
        opacity_logits: all.opacity_logits[range.clone()].to_vec(),
        sh_degree: all.sh_degree,
        sh: all.sh[range.clone()].to_vec(),
        motion_logits: if logits.is_empty() { Vec::new() } else { logits[range].to_vec() },
    }
}

fn join(a: &Gaussians, b: &Gaussians) -> Gaussians {
    Gaussians {
        positions: [&a.positions[..], &b.positions].concat(),
        log_scales: [&a.log_scales[..], &b.log_scales].concat(),
        rotations: [&a.rotations[..], &b.rotations].concat(),
        opacity_logits: [&a.opacity_logits[..], &b.opacity_logits].concat(),
        sh_degree: a.sh_degree,
        sh: [&a.sh[..], &b.sh].concat(),
        motion_logits: [&a.motion_logits[..], &b.motion_logits].concat(),
    }
}

fn scene_of(gaussians: Gaussians, moving: bool) -> Scene {
    if !moving {
        return Scene::of(gaussians);
    }
    let shape = NetShape {
        depth: 2,
        width: 16,
        skip: 9,
        position_frequencies: 1,
        time_frequencies: 1,
        ..NetShape::PAPER
    };
    let mut network = DeformNet::random(shape, 3);
    let count = network.parameters.len();
    network.parameters[count - 7..count - 4].copy_from_slice(&[0.2, -0.1, 0.05]);
    let positions = host::gaussians(6).positions;
    Scene {
        control_points: ControlPoints { positions, log_radii: vec![0.0; 6], paths: vec![] },
        network: Some(network),
        ..Scene::of(gaussians)
    }
}

fn logits(mut gaussians: Gaussians) -> Gaussians {
    let sign = |i: usize| if i.is_multiple_of(2) { 2.0 } else { -2.0 };
    gaussians.motion_logits = (0..gaussians.len()).map(sign).collect();
    gaussians
}

/// An edited renderer draws the same as a renderer created from the edited scene.
#[test]
fn edits_leave_what_a_new_renderer_would_have() {
    let device = common::device();
    for (moving, half) in [(false, false), (true, false), (false, true), (true, true)] {
        let all = if moving { logits(gaussians(120)) } else { gaussians(120) };
        let tuning = Tuning { half_sh: half, half_shapes: half, ..Tuning::default() };
        let camera = camera(50, 40);
        let agree = |edited: &mut Renderer, now: &Gaussians| {
            let scene = scene_of(now.clone(), moving);
            let mut fresh = Renderer::tuned(&device, &scene, &tuning).unwrap();
            assert_eq!(edited.len(), now.len());
            let (a, b) =
                (edited.render(&camera, 0.3).unwrap(), fresh.render(&camera, 0.3).unwrap());
            assert!(b.rgba.pixels.iter().any(|v| *v > 0.1), "the picture is not empty");
            assert_eq!((a.rgba.pixels, a.depth.pixels), (b.rgba.pixels, b.depth.pixels));
        };
        let mut now = part(&all, 0..40);
        let mut edited = Renderer::tuned(&device, &scene_of(now.clone(), moving), &tuning).unwrap();
        agree(&mut edited, &now);
        // First beyond the capacity, then within it.
        assert_eq!(edited.append(&part(&all, 40..70)).unwrap(), 40..70);
        now = join(&now, &part(&all, 40..70));
        agree(&mut edited, &now);
        assert_eq!(edited.append(&part(&all, 70..75)).unwrap(), 70..75);
        now = join(&now, &part(&all, 70..75));
        agree(&mut edited, &now);
        edited.remove(10..30).unwrap();
        now = join(&part(&now, 0..10), &part(&now, 30..75));
        agree(&mut edited, &now);
        edited.replace(5, &part(&all, 100..120)).unwrap();
        now = join(&join(&part(&now, 0..5), &part(&all, 100..120)), &part(&now, 25..55));
        agree(&mut edited, &now);
        edited.remove(0..0).unwrap();
        edited.append(&Gaussians::default()).unwrap();
        agree(&mut edited, &now);
    }
    common::assert_valid(&device);
}

#[test]
fn edits_that_do_not_fit_are_named() {
    let device = common::device();
    let mut renderer = Renderer::new(&device, &Scene::of(gaussians(10))).unwrap();
    #[allow(clippy::reversed_empty_ranges)]
    for range in [5..11, 11..11, 4..3] {
        assert!(renderer.remove(range).is_err());
    }
    assert!(renderer.replace(8, &gaussians(3)).is_err());
    let ragged = Gaussians { rotations: Vec::new(), ..gaussians(3) };
    assert!(renderer.append(&ragged).is_err());
    let ragged = Gaussians { motion_logits: vec![1.0], ..gaussians(3) };
    assert!(renderer.append(&ragged).is_err());
    let detailed = Gaussians { sh_degree: 1, sh: vec![[0.0; 3]; 12], ..gaussians(3) };
    assert!(renderer.append(&detailed).is_err());
    assert_eq!(renderer.len(), 10);
    renderer.remove(0..10).unwrap();
    assert!(renderer.is_empty());
    assert!(renderer.render(&camera(20, 20), 0.0).unwrap().rgba.pixels.iter().all(|v| *v == 0.0));
    assert_eq!(renderer.bounds(0.0, 3.0).unwrap(), None);
    renderer.append(&gaussians(10)).unwrap();
    assert_eq!(renderer.len(), 10);
}

/// Two opaque balls, one behind the other, and a third one to the side.
fn balls() -> Gaussians {
    Gaussians {
        positions: vec![[0.0, 0.0, 5.0], [0.0, 0.0, 3.0], [1.0, 0.0, 4.0]],
        log_scales: vec![[-2.0; 3]; 3],
        rotations: vec![[1.0, 0.0, 0.0, 0.0]; 3],
        opacity_logits: vec![4.0; 3],
        sh_degree: 0,
        sh: vec![[1.0; 3]; 3],
        motion_logits: Vec::new(),
    }
}

#[test]
fn a_pixel_tells_which_splat_it_shows() {
    let device = common::device();
    let mut renderer = Renderer::new(&device, &Scene::of(balls())).unwrap();
    let camera = camera(100, 80);
    let middle = renderer.hit(&camera, 0.0, [50, 40]).unwrap().unwrap();
    assert_eq!((middle.gaussian, middle.depth), (1, 3.0));
    assert!(middle.weight > 0.9 && middle.alpha > middle.weight);
    assert!(middle.point.distance(DVec3::new(0.0, 0.0, 3.0)) < 0.03, "{middle:?}");
    // The alpha is that of the rendered image.
    let rendered = renderer.render(&camera, 0.0).unwrap();
    assert!((f64::from(rendered.rgba.at(50, 40)[3]) - middle.alpha).abs() < 1e-5);
    // An offset of 1 at depth 4 is a quarter of the width.
    let aside = renderer.hit(&camera, 0.0, [75, 40]).unwrap().unwrap();
    assert_eq!((aside.gaussian, aside.depth), (2, 4.0));
    assert_eq!(renderer.hit(&camera, 0.0, [0, 0]).unwrap(), None);
    assert!(renderer.hit(&camera, 0.0, [100, 0]).is_err());
    common::assert_valid(&device);
}

#[test]
fn boxes_hold_the_scene_at_a_time() {
    let device = common::device();
    let mut renderer = Renderer::new(&device, &Scene::of(balls())).unwrap();
    let [low, high] = renderer.bounds(0.0, 3.0).unwrap().unwrap();
    let reach = DVec3::splat(3.0 * (-2.0f64).exp());
    assert!((low - (DVec3::new(0.0, 0.0, 3.0) - reach)).length() < 1e-6, "{low}");
    assert!((high - (DVec3::new(1.0, 0.0, 5.0) + reach)).length() < 1e-6, "{high}");
    let mut bad = balls();
    bad.positions[0] = [f32::NAN; 3];
    bad.log_scales[2] = [f32::INFINITY; 3];
    let mut renderer = Renderer::new(&device, &Scene::of(bad)).unwrap();
    let [low, high] = renderer.bounds(0.0, 0.0).unwrap().unwrap();
    assert_eq!([low, high], [DVec3::new(0.0, 0.0, 3.0); 2]);
    // The bounding box follows the moving Gaussians.
    let moving = Gaussians { motion_logits: vec![2.0; 3], ..balls() };
    let mut renderer = Renderer::new(&device, &scene_of(moving, true)).unwrap();
    let [low, high] = renderer.bounds(0.5, 0.0).unwrap().unwrap();
    assert!((low.x - 0.0).abs() > 0.01 && (high.x - 1.0).abs() > 0.01, "{low} {high}");
    common::assert_valid(&device);
}

/// Rendered colour, and the mask of moving Gaussians.
#[test]
fn the_mask_shows_what_moves() {
    let device: Device = common::device();
    let mut moving = balls();
    moving.motion_logits = vec![-1.0, -1.0, 1.0];
    let mut renderer = Renderer::new(&device, &scene_of(moving, true)).unwrap();
    let camera = camera(100, 80);
    let area = 100 * 80;
    let mut rgba = device.buffer::<[f32; 4]>("colour", area).unwrap();
    let mut mask = device.buffer::<[f32; 4]>("mask", area).unwrap();
    let mut stream = device.stream().unwrap();
    let mut recorder: Recorder = stream.record().unwrap();
    let target = Target { rgba: Some(rgba.view_mut()), depth: None, mask: Some(mask.view_mut()) };
    let frame = renderer.record(&mut recorder, &camera, 0.0, target).unwrap();
    let ticket = stream.submit(recorder).unwrap();
    stream.wait(ticket).unwrap();
    assert!(renderer.retire(frame).unwrap().is_whole());
    let (rgba, mask) = (stream.download(&rgba).unwrap(), stream.download(&mask).unwrap());
    let (mut moves, mut stays) = (0.0f32, 0.0f32);
    for (colour, mask) in rgba.iter().zip(&mask) {
        assert_eq!(colour[3], mask[3]);
        assert_eq!([mask[1], mask[2]], [0.0; 2]);
        assert!(mask[0] <= mask[3] + 1e-6);
        moves = moves.max(mask[0]);
        stays = stays.max(mask[3] - mask[0]);
    }
    assert!(moves > 0.9 && stays > 0.9, "{moves} {stays}");
    let short = device.buffer::<[f32; 4]>("short", 7);
    let mut short = short.unwrap();
    let mut recorder = stream.record().unwrap();
    let target = Target { rgba: Some(short.view_mut()), ..Target::default() };
    let refused = renderer.record(&mut recorder, &camera, 0.0, target);
    assert!(refused.err().unwrap().to_string().contains("rgba"));
    common::assert_valid(&device);
}
