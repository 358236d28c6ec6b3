//! Movers: a cart, deforming objects, a crowd.
//!
//! A motion is a closed-form map of rest positions, so that every surface point has an exact position at
//! every time, whatever the number of frames.

use std::f64::consts::{FRAC_PI_2, TAU};
use std::sync::Arc;

use glam::{DQuat, DVec3, Vec3};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::mesh::Mesh;
use super::scene::{Assembly, FLOOR, Motion, Part};
use super::texture::{Material, Pattern};
use crate::types::Pose;

/// At rest, movers face the camera, which suits the light that is baked at rest.
fn upright(x: f64, z: f64, turn: f64) -> Pose {
    Pose::new(DQuat::from_rotation_y(turn), DVec3::new(x, FLOOR, z))
}

/// Moves a shape rigidly by `world_from_shape` at each time.
pub(super) fn rigid(
    rest: Pose,
    world_from_shape: impl Fn(f64) -> Pose + Send + Sync + 'static,
) -> Motion {
    let shape_from_rest = rest.inverse();
    Arc::new(move |p, time| (world_from_shape(time) * shape_from_rest).apply(p))
}

pub(super) fn sign(rng: &mut ChaCha8Rng) -> f64 {
    if rng.random_bool(0.5) { 1.0 } else { -1.0 }
}

/// One rigid mover: a cart with its load, driven along a curve across the room.
pub(super) fn cart(rng: &mut ChaCha8Rng) -> Vec<Part> {
    let way = sign(rng);
    let length = rng.random_range(1.05..1.2);
    let (middle, depth) = (rng.random_range(-0.15..-0.05), rng.random_range(3.1..3.3));
    let curve = sign(rng) * rng.random_range(0.09..0.13);
    let drive = move |time: f64| {
        let s = 2.0 * time - 1.0;
        let heading = (4.0 * curve * s).atan2(length);
        upright(middle + way * 0.5 * length * s, depth + curve * s * s, way * -heading)
    };
    let mut a = Assembly::new(rng);
    a.carry(drive);
    // Heights are negative: y points down, and the shape's origin is on the floor.
    let body = Material::random(a.rng, Pattern::Blobs(0.2), 0.035);
    let cab = Material::random(a.rng, Pattern::Stripes(Vec3::new(2.0, 1.4, 1.0)), 0.035);
    let load = Material::random(a.rng, Pattern::Blobs(0.15), 0.03);
    let tyre = Material::tinted(a.rng, [0.42, 0.42, 0.45], Pattern::Blobs(0.09), 0.03);
    a.add(Mesh::cuboid(DVec3::new(0.52, 0.15, 0.26), 0.3).at(DVec3::new(0.0, -0.29, 0.0)), body);
    a.add(
        Mesh::cuboid(DVec3::new(0.2, 0.19, 0.23), 0.3).at(DVec3::new(way * 0.28, -0.63, 0.0)),
        cab,
    );
    let ball = DVec3::new(0.26, 0.23, 0.23);
    a.add(Mesh::ellipsoid(ball, 32).at(DVec3::new(way * -0.22, -0.62, 0.0)), load);
    for (x, z) in [(-0.34, -0.26), (0.34, -0.26), (-0.34, 0.26), (0.34, 0.26)] {
        let place = Pose::new(DQuat::from_rotation_x(FRAC_PI_2), DVec3::new(x, -0.14, z));
        a.add(Mesh::cylinder(0.14, 0.04, 24, 1).placed(place), tyre.clone());
    }
    a.parts
}

/// Non-rigid movers: a cloth that ripples on a swinging rod, and a column that bends and twists.
pub(super) fn bending(rng: &mut ChaCha8Rng) -> Vec<Part> {
    let mut a = Assembly::new(rng);
    cloth(&mut a);
    column(&mut a);
    a.parts
}

fn cloth(a: &mut Assembly) {
    let half_wide = a.rng.random_range(0.45..0.55);
    let high = a.rng.random_range(0.8..0.95);
    let rod = DVec3::new(a.rng.random_range(-0.45..-0.3), -0.62, a.rng.random_range(3.0..3.2));
    let (phase, way) = (a.rng.random_range(0.0..TAU), sign(a.rng));
    let sway = sign(a.rng) * a.rng.random_range(0.2..0.28);
    let ripples = a.rng.random_range(0.8..1.1);
    // Every point of the cloth moves: the rod carries it sideways, it swings about the rod, and a wave runs
    // across it with an amplitude that grows from rod to hem.
    let motion: Motion = Arc::new(move |p, time| {
        let local = p - rod;
        let (across, down) = (local.x / half_wide, local.y.max(0.0) / high);
        let wave = TAU * (0.5 * ripples * across - way * 0.9 * time) + phase;
        let depth = 0.13 * down.sqrt() * (0.35 + 0.65 * down) * wave.sin();
        let hem = 0.06 * down * down * (wave + 1.0).cos();
        let bent = DVec3::new(local.x + hem, local.y * (1.0 - 0.05 * down), local.z + depth);
        let swing = DQuat::from_rotation_x(0.22 * (TAU * 0.6 * time + phase).sin())
            * DQuat::from_rotation_y(0.3 * way * (2.0 * time - 1.0));
        rod + DVec3::X * sway * (2.0 * time - 1.0) + swing * bent
    });
    a.motion = Some(motion);
    let weave = Material::random(a.rng, Pattern::Blobs(0.22), 0.035);
    let corner = rod - DVec3::X * half_wide;
    let (side, down) = (DVec3::X * 2.0 * half_wide, DVec3::Y * high);
    a.add(Mesh::patch(corner, down, side, [30, 36]), weave);
    let metal = Material::tinted(a.rng, [0.55, 0.55, 0.6], Pattern::Blobs(0.1), 0.03);
    let lie = Pose::new(DQuat::from_rotation_z(FRAC_PI_2), rod - DVec3::Y * 0.02);
    a.add(Mesh::cylinder(0.03, half_wide + 0.08, 16, 12).placed(lie), metal);
}

fn column(a: &mut Assembly) {
    let high = a.rng.random_range(0.95..1.1);
    let foot = DVec3::new(a.rng.random_range(0.5..0.65), FLOOR, a.rng.random_range(3.1..3.4));
    let (phase, way) = (a.rng.random_range(0.0..TAU), sign(a.rng));
    let slide = sign(a.rng) * a.rng.random_range(0.1..0.16);
    // The axis is bent into an arc of changing curvature and direction; cross-sections stay plane and
    // perpendicular to it.
    let motion: Motion = Arc::new(move |p, time| {
        let local = p - foot;
        let height = -local.y;
        let facing = DQuat::from_rotation_y(way * (0.4 + 0.8 * time));
        let turned = facing.inverse() * DVec3::new(local.x, 0.0, local.z);
        let curvature = 0.75 * (TAU * 0.55 * time + phase).sin() / high;
        let angle = curvature * height;
        // sin(θ)/κ and (1 − cos θ)/κ, without dividing by a curvature that passes through zero.
        let sinc = |x: f64| if x.abs() < 1e-4 { 1.0 - x * x / 6.0 } else { x.sin() / x };
        let rise = height * sinc(angle);
        let lean = height * (0.5 * angle).sin() * sinc(0.5 * angle);
        let bent =
            DVec3::new(lean + turned.x * angle.cos(), -rise + turned.x * angle.sin(), turned.z);
        foot + DVec3::X * slide * (2.0 * time - 1.0) + facing * bent
    });
    a.motion = Some(motion);
    let skin = Material::random(a.rng, Pattern::Blobs(0.19), 0.03);
    let centre = foot - DVec3::Y * (0.5 * high + 0.01);
    a.add(Mesh::cylinder(0.17, 0.5 * high, 32, 28).at(centre), skin);
}

/// A crowd in two rows that covers more than half of the image; each person walks a different path.
pub(super) fn crowd(rng: &mut ChaCha8Rng) -> Vec<Part> {
    let mut a = Assembly::new(rng);
    for (row, count, spread, depth) in [(0, 4, 2.1, 2.05), (1, 6, 3.6, 3.2)] {
        for place in 0..count {
            let across = spread * ((place as f64 + 0.5) / count as f64 - 0.5);
            let x = across + a.rng.random_range(-0.05..0.05);
            let z = depth + a.rng.random_range(-0.2..0.2);
            // Neighbours walk in opposite directions, so that the crowd has no common motion that could be
            // mistaken for the camera's.
            let way = if (place + row) % 2 == 0 { 1.0 } else { -1.0 };
            walker(&mut a, x, z, way);
        }
    }
    a.parts
}

fn walker(a: &mut Assembly, x: f64, z: f64, way: f64) {
    let walk = way * a.rng.random_range(0.15..0.25);
    let (steps, phase) = (a.rng.random_range(1.0..1.6), a.rng.random_range(0.0..TAU));
    let (turn, size) = (a.rng.random_range(-0.5..0.5), a.rng.random_range(0.94..1.06));
    let stray = a.rng.random_range(-0.12..0.12);
    let go = move |time: f64| {
        let s = 2.0 * time - 1.0;
        let beat = TAU * steps * time + phase;
        let mut pose = upright(x + walk * s, z + stray * s, turn * s + 0.08 * beat.sin());
        pose.translation.y -= 0.03 * (1.0 + beat.cos());
        pose.rotation *= DQuat::from_rotation_z(0.06 * beat.sin());
        pose
    };
    let rest = upright(x, z, 0.0);
    a.world_from_shape = rest;
    a.motion = Some(rigid(rest, go));
    let coat = match a.rng.random_range(0..3) {
        0 => Pattern::Blobs(0.16),
        1 => Pattern::Stripes(Vec3::new(1.0, 3.0, 0.0)),
        _ => Pattern::Stripes(Vec3::new(3.0, 0.5, 1.0)),
    };
    let coat = Material::random(a.rng, coat, 0.026);
    let trousers = Material::random(a.rng, Pattern::Blobs(0.1), 0.026);
    let skin = Material::tinted(a.rng, [0.72, 0.54, 0.44], Pattern::Blobs(0.11), 0.024);
    let body = DVec3::new(0.27, 0.4, 0.18) * size;
    a.add(Mesh::ellipsoid(body, 28).at(DVec3::Y * -0.92 * size), coat.clone());
    a.add(
        Mesh::ellipsoid(DVec3::new(0.14, 0.18, 0.15) * size, 24).at(DVec3::Y * -1.42 * size),
        skin,
    );
    for side in [-1.0, 1.0] {
        let leg = DVec3::new(side * 0.12, -0.33, 0.0) * size;
        a.add(Mesh::cylinder(0.1 * size, 0.33 * size, 16, 4).at(leg), trousers.clone());
        let arm = Pose::new(
            DQuat::from_rotation_z(side * -0.25),
            DVec3::new(side * 0.3, -0.9, 0.0) * size,
        );
        a.add(Mesh::ellipsoid(DVec3::new(0.075, 0.33, 0.075) * size, 16).placed(arm), coat.clone());
    }
}
