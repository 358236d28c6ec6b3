//! An object that a hand holds in front of the camera and turns.

use std::f64::consts::{PI, TAU};

use glam::{DQuat, DVec3, Vec3};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::mesh::Mesh;
use super::movers::sign;
use super::scene::{Assembly, Part};
use super::texture::{Material, Pattern};
use crate::types::Pose;

/// Distance from the wrist to the elbow, which stays outside the image, m.
const FOREARM: f64 = 0.75;

/// A glossy jug with a handle in a hand that turns it over, on a forearm that comes up from below.
pub(super) fn jug(rng: &mut ChaCha8Rng) -> Vec<Part> {
    let (way, side) = (sign(rng), sign(rng));
    let middle = DVec3::new(rng.random_range(-0.1..0.1), 0.1, rng.random_range(1.75..1.9));
    let (phase, sway) = (rng.random_range(0.0..TAU), rng.random_range(0.08..0.12));
    let turn = way * rng.random_range(1.6..2.0);
    let tilt = rng.random_range(0.25..0.4);
    let hand = move |time: f64| {
        let s = time - 0.5;
        let place = DVec3::new(
            sway * (TAU * 0.7 * time + phase).sin(),
            0.05 * (TAU * 0.9 * time + phase).cos(),
            0.06 * (PI * time + phase).sin(),
        );
        let turned = DQuat::from_rotation_y(turn * s)
            * DQuat::from_rotation_x(tilt * (TAU * 0.6 * time + phase).sin());
        Pose::new(turned, middle + place)
    };
    // The arm does not rotate with the hand: it points from the elbow to the wrist.
    let elbow = middle + DVec3::new(side * 0.3, 0.2 + 0.9 * FOREARM, -0.1);
    let arm = move |time: f64| {
        let wrist = hand(time).apply(DVec3::new(0.0, 0.24, 0.0));
        let up = (wrist - elbow).normalize();
        Pose::new(DQuat::from_rotation_arc(-DVec3::Y, up), wrist)
    };
    let mut a = Assembly::new(rng);
    a.carry(hand);
    let glaze = Material::random(a.rng, Pattern::Blobs(0.09), 0.018).glossy(0.2);
    a.add(Mesh::cylinder(0.13, 0.17, 48, 4), glaze.clone());
    for (y, reach) in [(-0.09, 0.06), (0.09, 0.06)] {
        let lie = DQuat::from_rotation_z(0.5 * PI);
        let place = Pose::new(lie, DVec3::new(0.13 + reach, y, 0.0));
        a.add(Mesh::cylinder(0.022, reach, 16, 1).placed(place), glaze.clone());
    }
    let grip = Mesh::cylinder(0.022, 0.11, 16, 2).at(DVec3::new(0.25, 0.0, 0.0));
    a.add(grip, glaze);
    let skin = Material::tinted(a.rng, [0.74, 0.55, 0.45], Pattern::Plain, 0.03);
    a.add(Mesh::ellipsoid(DVec3::new(0.1, 0.07, 0.09), 32).at(DVec3::Y * 0.21), skin.clone());
    a.carry(arm);
    let sleeve = Material::random(a.rng, Pattern::Stripes(Vec3::new(0.0, 6.0, 1.0)), 0.025);
    a.add(Mesh::cylinder(0.055, 0.09, 24, 2).at(DVec3::Y * 0.08), skin);
    let cloth = Mesh::cylinder(0.085, 0.5 * FOREARM, 32, 6);
    a.add(cloth.at(DVec3::Y * (0.14 + 0.5 * FOREARM)), sleeve);
    a.parts
}
