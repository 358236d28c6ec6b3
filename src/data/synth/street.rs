//! A street with a passing car, for a camera that pans after it.

use std::f64::consts::FRAC_PI_2;

use glam::{DQuat, DVec3, Vec3};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::mesh::Mesh;
use super::movers::sign;
use super::scene::{Assembly, FLOOR, Part};
use super::texture::{Material, Pattern};
use crate::types::Pose;

/// Half the length of the street that is modelled, m.
const HALF_LENGTH: f64 = 22.0;
/// Distance of the far pavement's kerb; the houses stand behind it, m.
const KERB: f64 = 8.5;
const FRONTS: f64 = 10.5;
/// Distance of the hazy backdrop, m.
const HAZE: f64 = 26.0;
const SKY: f64 = -14.0;
/// Spacing of the vertices with baked light, m.
const CELL: f64 = 0.9;

/// Distance of the middle of the car's lane, m.
const LANE: f64 = 5.6;

/// Road, pavements, houses, lamp posts and bollards.
pub(super) fn street(rng: &mut ChaCha8Rng) -> Vec<Part> {
    let mut a = Assembly::new(rng);
    ground(&mut a);
    houses(&mut a);
    posts(&mut a);
    a.parts
}

/// Motion that a camera follows: position of the car's centre in the middle of the clip, and its
/// displacement from there to the end, m.
#[derive(Clone, Copy, Debug)]
pub(super) struct Drive {
    pub middle: DVec3,
    pub half_way: DVec3,
}

/// A car that passes at constant speed.
pub(super) fn car(rng: &mut ChaCha8Rng) -> (Vec<Part>, Drive) {
    let way = sign(rng);
    let reach = rng.random_range(4.2..5.0);
    let across = rng.random_range(-0.4..0.4);
    let drive = Drive {
        middle: DVec3::new(rng.random_range(-0.3..0.3), FLOOR - 0.6, LANE),
        half_way: DVec3::new(way * reach, 0.0, across),
    };
    let heading = DQuat::from_rotation_y((-across).atan2(way * reach));
    let mut a = Assembly::new(rng);
    a.carry(move |time| {
        let place = drive.middle + drive.half_way * (2.0 * time - 1.0);
        Pose::new(heading, place.with_y(FLOOR))
    });
    // The shape faces +x; its origin is on the road and heights are negative.
    let paint = Material::random(a.rng, Pattern::Blobs(0.5), 0.07);
    let trim = Material::random(a.rng, Pattern::Stripes(Vec3::new(1.1, 0.6, 0.3)), 0.06);
    let glass = Material::tinted(a.rng, [0.25, 0.3, 0.36], Pattern::Blobs(0.3), 0.06);
    let tyre = Material::tinted(a.rng, [0.2, 0.2, 0.21], Pattern::Blobs(0.15), 0.05);
    let mut block = |half: [f64; 3], centre: [f64; 3], material: &Material| {
        let mesh = Mesh::cuboid(DVec3::from(half), 0.5).at(DVec3::from(centre));
        a.add(mesh, material.clone());
    };
    block([1.9, 0.3, 0.8], [0.0, -0.62, 0.0], &paint);
    block([1.92, 0.07, 0.82], [0.0, -0.4, 0.0], &trim);
    block([1.0, 0.2, 0.68], [-0.2, -1.12, 0.0], &glass);
    block([0.95, 0.05, 0.7], [-0.2, -1.36, 0.0], &paint);
    for (x, z) in [(-1.2, -0.75), (1.25, -0.75), (-1.2, 0.75), (1.25, 0.75)] {
        let place = Pose::new(DQuat::from_rotation_x(FRAC_PI_2), DVec3::new(x, -0.32, z));
        a.add(Mesh::cylinder(0.32, 0.09, 24, 1).placed(place), tyre.clone());
    }
    (a.parts, drive)
}

/// A rectangle whose sides are cut into cells.
fn patch(origin: [f64; 3], side_a: [f64; 3], side_b: [f64; 3]) -> Mesh {
    let (side_a, side_b) = (DVec3::from(side_a), DVec3::from(side_b));
    let cells = [side_a, side_b].map(|side| (side.length() / CELL).ceil() as usize);
    Mesh::patch(DVec3::from(origin), side_a, side_b, cells)
}

fn ground(a: &mut Assembly) {
    let length = 2.0 * HALF_LENGTH;
    let asphalt = Material::tinted(a.rng, [0.36, 0.36, 0.38], Pattern::Blobs(0.8), 0.08);
    let near = -HALF_LENGTH;
    a.add(
        patch([-HALF_LENGTH, FLOOR, near], [0.0, 0.0, KERB - near], [length, 0.0, 0.0]).flipped(),
        asphalt,
    );
    let slabs = Material::tinted(a.rng, [0.6, 0.58, 0.54], Pattern::Planks(0.8), 0.09);
    // Ground behind the houses, visible through the gaps between them.
    let (kerb, deep) = (FLOOR - 0.12, HAZE - KERB);
    a.add(
        patch([-HALF_LENGTH, kerb, KERB], [0.0, 0.0, deep], [length, 0.0, 0.0]).flipped(),
        slabs.clone(),
    );
    a.add(
        patch([-HALF_LENGTH, kerb, KERB], [length, 0.0, 0.0], [0.0, FLOOR - kerb, 0.0]).flipped(),
        slabs,
    );
    // Backdrop for rays that pass between or above the houses.
    let haze =
        Material::tinted(a.rng, [0.68, 0.74, 0.82], Pattern::Blobs(6.0), 0.5).of_contrast(0.5);
    let high = FLOOR - SKY;
    for (x, z) in [(0.0, HAZE), (0.0, -HALF_LENGTH - 1.0)] {
        let wall =
            patch([x - HALF_LENGTH - 8.0, SKY, z], [0.0, high, 0.0], [length + 16.0, 0.0, 0.0]);
        a.add(if z > 0.0 { wall } else { wall.flipped() }, haze.clone());
    }
    for x in [-HALF_LENGTH, HALF_LENGTH] {
        let wall = patch([x, SKY, near - 1.0], [0.0, high, 0.0], [0.0, 0.0, HAZE - near + 1.0]);
        a.add(if x < 0.0 { wall } else { wall.flipped() }, haze.clone());
    }
    let deep = HAZE - near + 1.0;
    a.add(
        patch([-HALF_LENGTH, SKY, near - 1.0], [length, 0.0, 0.0], [0.0, 0.0, deep]).flipped(),
        haze,
    );
}

/// A row of houses of differing width, height and depth, with windows and doors.
fn houses(a: &mut Assembly) {
    let mut left = -HALF_LENGTH + 1.0;
    while left < HALF_LENGTH - 3.0 {
        let width = a.rng.random_range(2.8..4.6);
        let high = a.rng.random_range(3.6..6.5);
        let front = FRONTS + a.rng.random_range(0.0..1.2);
        let wall = Material::random(a.rng, Pattern::Blobs(1.1), 0.11);
        let middle = DVec3::new(left + 0.5 * width, FLOOR - 0.5 * high, front + 2.0);
        a.add(Mesh::cuboid(DVec3::new(0.5 * width, 0.5 * high, 2.0), CELL).at(middle), wall);
        let pane = Material::random(a.rng, Pattern::Blobs(0.5), 0.1);
        for (row, column) in (0..2).flat_map(|row| (0..2).map(move |column| (row, column))) {
            let x = left + width * (0.3 + 0.4 * f64::from(column)) + a.rng.random_range(-0.2..0.2);
            let y = FLOOR - 1.5 - 1.7 * f64::from(row) + a.rng.random_range(-0.15..0.15);
            let half = DVec3::new(a.rng.random_range(0.3..0.5), a.rng.random_range(0.4..0.6), 0.06);
            if y - half.y > FLOOR - high {
                a.add(Mesh::cuboid(half, CELL).at(DVec3::new(x, y, front)), pane.clone());
            }
        }
        // Occasionally a lane leads away between two houses.
        left += width + if a.rng.random_bool(0.3) { a.rng.random_range(0.6..1.4) } else { 0.02 };
    }
}

/// Lamp posts on the far pavement and bollards at its kerb.
fn posts(a: &mut Assembly) {
    let mut x = -HALF_LENGTH + a.rng.random_range(1.0..3.0);
    while x < HALF_LENGTH - 1.0 {
        let iron = Material::random(a.rng, Pattern::Blobs(0.3), 0.08);
        let tall = a.rng.random_bool(0.4);
        let (radius, half) = if tall { (0.09, 1.9) } else { (0.13, 0.45) };
        let z = KERB + a.rng.random_range(0.25..0.6);
        a.add(
            Mesh::cylinder(radius, half, 20, 10).at(DVec3::new(x, FLOOR - half, z)),
            iron.clone(),
        );
        if tall {
            let lamp = DVec3::new(x, FLOOR - 2.0 * half, z);
            a.add(Mesh::ellipsoid(DVec3::new(0.3, 0.2, 0.3), 24).at(lamp), iron);
        }
        x += a.rng.random_range(1.4..2.6);
    }
}
