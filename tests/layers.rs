//! Layers besides colour, on scenes with known truth: a wall in front of the camera.

mod common;

use glam::{DQuat, DVec3};
use splat4d::renderer::Renderer;
use splat4d::scene::Scene;
use splat4d::types::{Camera, ControlPoints, Gaussians, Image, Intrinsics, Pose};

const DEPTH: f32 = 4.0;

/// Overlapping discs, thin along z, at one depth; their planes are rotated about y by `turn`.
fn wall(turn: f64) -> Gaussians {
    let side = 41;
    let positions: Vec<[f32; 3]> = (0..side * side)
        .map(|i| [(i % side) as f32 * 0.1 - 2.0, (i / side) as f32 * 0.1 - 2.0, DEPTH])
        .collect();
    let n = positions.len();
    let q = DQuat::from_rotation_y(turn);
    Gaussians {
        positions,
        log_scales: vec![[-2.3, -2.3, -6.0]; n],
        rotations: vec![[q.w as f32, q.x as f32, q.y as f32, q.z as f32]; n],
        opacity_logits: vec![3.0; n],
        sh_degree: 0,
        sh: vec![[0.3; 3]; n],
        motion_logits: Vec::new(),
    }
}

/// The same wall; its right half moves by `way` from time 0 to time 1.
fn moving(way: [f32; 3]) -> Scene {
    let mut gaussians = wall(0.0);
    let moves = |p: &[f32; 3]| if p[0] > 0.0 { 5.0 } else { -5.0 };
    gaussians.motion_logits = gaussians.positions.iter().map(moves).collect();
    let key = |share: f32| {
        let [x, y, z] = way.map(|v| share * v);
        [x, y, z, 0.0, 0.0, 0.0, 0.0, 0.0]
    };
    let control_points = ControlPoints {
        positions: vec![[0.0, 0.0, DEPTH]],
        log_radii: vec![1.0],
        paths: vec![key(0.0), key(1.0)],
    };
    Scene { control_points, neighbours: 1, ..Scene::of(gaussians) }
}

fn camera(x: f64) -> Camera {
    Camera {
        intrinsics: Intrinsics::centred(60.0, 80, 48),
        view_from_world: Pose::new(DQuat::IDENTITY, DVec3::new(-x, 0.0, 0.0)),
    }
}

/// Checks that a map's values in some columns are within `bound` of the expected ones.
#[track_caller]
fn holds(map: &Image, columns: std::ops::Range<u32>, expected: &[f32], bound: f32) {
    for y in 4..map.height - 4 {
        for x in columns.clone() {
            for (value, expected) in map.at(x, y).iter().zip(expected) {
                assert!((value - expected).abs() <= bound, "({x}, {y}): {value} for {expected}");
            }
        }
    }
}

#[test]
fn flow_of_a_still_scene_is_the_cameras() {
    let device = common::device();
    let mut renderer = Renderer::new(&device, &Scene::of(wall(0.0))).unwrap();
    let (from, to) = (camera(0.0), camera(0.2));
    let seen = renderer.render(&from, 0.0).unwrap();
    let flow = renderer.flow(&seen, (&from, 0.0), (&to, 1.0)).unwrap();
    assert_eq!((flow.width, flow.height, flow.channels), (80, 48, 2));
    // A focal length of 60 px, a step of 0.2 to the right, at a depth of 4.
    holds(&flow, 14..66, &[-3.0, 0.0], 1e-3);
    assert!(renderer.moving().unwrap().pixels.iter().all(|v| *v == 0.0));
    // To a camera that has the wall behind it there is no flow.
    let mut beyond = to;
    beyond.view_from_world.translation.z = -9.0;
    let none = renderer.flow(&seen, (&from, 0.0), (&beyond, 0.0)).unwrap();
    assert!(none.pixels.iter().all(|v| v.is_nan()));
}

#[test]
fn what_moves_has_flow_of_its_own() {
    let device = common::device();
    let mut renderer = Renderer::new(&device, &moving([0.4, -0.2, 0.0])).unwrap();
    let here = camera(0.0);
    let seen = renderer.render(&here, 0.0).unwrap();
    let flow = renderer.flow(&seen, (&here, 0.0), (&here, 1.0)).unwrap();
    // The columns at the edge in the middle are left out: they belong to both halves.
    holds(&flow, 48..66, &[6.0, -3.0], 1e-3);
    holds(&flow, 14..32, &[0.0, 0.0], 1e-3);
    let mask = renderer.moving().unwrap();
    let alpha = |x: u32| seen.rgba.at(x, 24)[3];
    for x in 48..66 {
        assert!((mask.at(x, 24)[0] - alpha(x)).abs() < 1e-5 && alpha(x) > 0.9);
    }
    holds(&mask, 14..32, &[0.0], 0.0);
    // Both motions at once, the camera's and the wall's, also from a time in between.
    let seen = renderer.render(&here, 0.5).unwrap();
    let flow = renderer.flow(&seen, (&here, 0.5), (&camera(0.2), 1.0)).unwrap();
    holds(&flow, 56..66, &[3.0 - 3.0, -1.5], 1e-3);
    let (a, b) = (renderer.posed(0.0).unwrap(), renderer.posed(1.0).unwrap());
    let last = a.positions.len() - 1;
    assert!((b.positions[last][0] - a.positions[last][0] - 0.4).abs() < 1e-6);
    assert_eq!((a.positions[0], a.rotations[0]), (b.positions[0], b.rotations[0]));
    // A motion along the line of sight: the wall gets closer and appears larger.
    let mut renderer = Renderer::new(&device, &moving([0.0, 0.0, -2.0])).unwrap();
    let seen = renderer.render(&here, 0.0).unwrap();
    let flow = renderer.flow(&seen, (&here, 0.0), (&here, 1.0)).unwrap();
    let [u, v] = [flow.at(60, 30)[0], flow.at(60, 30)[1]];
    assert!((u - 20.5).abs() < 1e-3 && (v - 6.5).abs() < 1e-3, "twice as far out: {u} {v}");
    common::assert_valid(&device);
}

#[test]
fn normals_look_at_the_camera() {
    let device = common::device();
    for turn in [0.0f64, 0.5, -0.5, 3.0] {
        let mut renderer = Renderer::new(&device, &Scene::of(wall(turn))).unwrap();
        let mut camera = camera(0.0);
        renderer.render(&camera, 0.0).unwrap();
        let normals = renderer.normals(&camera, 0.0).unwrap();
        let axis = DQuat::from_rotation_y(turn) * DVec3::Z;
        let axis = if axis.z > 0.0 { -axis } else { axis };
        holds(&normals, 30..50, &axis.to_array().map(|v| v as f32), 1e-4);
        // Normals are in the camera's frame, whatever its roll.
        let roll = DQuat::from_rotation_z(0.7);
        camera.view_from_world.rotation = roll;
        renderer.render(&camera, 0.0).unwrap();
        let rolled = renderer.normals(&camera, 0.0).unwrap();
        holds(&rolled, 35..45, &(roll * axis).to_array().map(|v| v as f32), 1e-4);
    }
    // Empty pixels have no normal.
    let mut renderer = Renderer::new(&device, &Scene::of(wall(0.0))).unwrap();
    let mut away = camera(0.0);
    away.view_from_world.rotation = DQuat::from_rotation_y(2.0);
    renderer.render(&away, 0.0).unwrap();
    assert!(renderer.normals(&away, 0.0).unwrap().pixels.iter().all(|v| *v == 0.0));
}

#[test]
fn values_belong_to_gaussians_and_a_picture() {
    let device = common::device();
    let scene = Scene::of(wall(0.0));
    let count = scene.gaussians.len();
    let mut renderer = Renderer::new(&device, &scene).unwrap();
    let error = renderer.repaint(&vec![[0.0; 3]; count]).unwrap_err().to_string();
    assert!(error.contains("nothing was rendered"), "{error}");
    let seen = renderer.render(&camera(0.0), 0.0).unwrap();
    let error = renderer.repaint(&[[0.0; 3]]).unwrap_err().to_string();
    assert!(error.contains("1681"), "{error}");
    let painted = renderer.repaint(&vec![[1.0, -2.0, 1e6]; count]).unwrap();
    for (painted, seen) in painted.pixels.chunks_exact(4).zip(seen.rgba.pixels.chunks_exact(4)) {
        assert_eq!(painted[3], seen[3]);
        assert!((painted[0] - seen[3]).abs() < 1e-5 && (painted[1] + 2.0 * seen[3]).abs() < 1e-5);
    }
    assert!(renderer.posed(f64::NAN).is_err());
    // The same holds for an empty scene.
    let mut renderer = Renderer::new(&device, &Scene::default()).unwrap();
    renderer.render(&camera(0.0), 0.0).unwrap();
    assert!(renderer.moving().unwrap().pixels.iter().all(|v| *v == 0.0));
    assert!(renderer.normals(&camera(0.0), 0.0).unwrap().pixels.iter().all(|v| *v == 0.0));
}
