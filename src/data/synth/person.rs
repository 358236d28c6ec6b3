//! A walking person with articulated limbs.
//!
//! Every limb is rigid and rotates in the joint above it; the body rises and sinks so that the lower foot
//! is on the floor.

use std::f64::consts::{FRAC_PI_2, TAU};

use glam::{DQuat, DVec3, Vec3};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::mesh::Mesh;
use super::movers::sign;
use super::scene::{Assembly, FLOOR, Part};
use super::texture::{Material, Pattern};
use crate::types::Pose;

/// Lengths, metres: hip to knee, knee to sole, shoulder to elbow, elbow to hand.
const THIGH: f64 = 0.40;
const SHIN: f64 = 0.42;
const UPPER_ARM: f64 = 0.28;
const LOWER_ARM: f64 = 0.3;
/// Height of the shoulders above the hips, m.
const TRUNK: f64 = 0.5;

/// A walk along an arc over the floor, with swinging limbs.
#[derive(Clone, Copy)]
struct Gait {
    middle: DVec3,
    /// Metres along x over the clip.
    walk: f64,
    /// Radians by which the heading turns over the clip.
    turn: f64,
    /// Double steps over the clip, and their phase at its start.
    cycles: f64,
    phase: f64,
}

impl Gait {
    /// Swing of the thigh of a side (−1 left, 1 right) and bend of its knee, radians.
    fn leg(&self, side: f64, time: f64) -> (f64, f64) {
        let beat = TAU * self.cycles * time + self.phase + FRAC_PI_2 * side;
        (0.42 * beat.sin(), 0.2 + 0.35 * (1.0 + (beat - 0.9).cos()))
    }

    /// Position of the sole of a side below the hips, along the body's axes, m.
    fn sole(&self, side: f64, time: f64) -> f64 {
        let (thigh, knee) = self.leg(side, time);
        THIGH * thigh.cos() + SHIN * (thigh - knee).cos()
    }

    /// Pose of the hips: x points in the walking direction, y down.
    fn world_from_hips(&self, time: f64) -> Pose {
        let s = time - 0.5;
        let heading = if self.walk > 0.0 { 0.0 } else { std::f64::consts::PI };
        let turned = DQuat::from_rotation_y(heading + self.turn * s);
        let high = self.sole(-1.0, time).max(self.sole(1.0, time));
        let place = DVec3::new(self.walk * s, FLOOR - high, -0.25 * self.walk * self.turn * s * s);
        Pose::new(turned, DVec3::new(self.middle.x, 0.0, self.middle.z) + place)
    }

    fn world_from_thigh(&self, side: f64, time: f64) -> Pose {
        let (thigh, _) = self.leg(side, time);
        self.world_from_hips(time)
            * Pose::new(DQuat::from_rotation_z(-thigh), DVec3::new(0.0, 0.0, 0.1 * side))
    }

    fn world_from_shin(&self, side: f64, time: f64) -> Pose {
        let (_, knee) = self.leg(side, time);
        self.world_from_thigh(side, time)
            * Pose::new(DQuat::from_rotation_z(knee), DVec3::Y * THIGH)
    }

    /// Arms swing opposite to the legs.
    fn world_from_upper_arm(&self, side: f64, time: f64) -> Pose {
        let (thigh, _) = self.leg(-side, time);
        let spread = DQuat::from_rotation_x(-0.12 * side);
        self.world_from_hips(time)
            * Pose::new(
                spread * DQuat::from_rotation_z(-0.9 * thigh),
                DVec3::new(0.0, -TRUNK + 0.04, 0.23 * side),
            )
    }

    fn world_from_lower_arm(&self, side: f64, time: f64) -> Pose {
        let (thigh, _) = self.leg(-side, time);
        self.world_from_upper_arm(side, time)
            * Pose::new(DQuat::from_rotation_z(-0.5 - 0.4 * thigh), DVec3::Y * UPPER_ARM)
    }
}

/// One person who walks across the room and turns.
pub(super) fn walking(rng: &mut ChaCha8Rng) -> Vec<Part> {
    let way = sign(rng);
    let gait = Gait {
        middle: DVec3::new(rng.random_range(-0.1..0.1), 0.0, rng.random_range(2.9..3.1)),
        walk: way * rng.random_range(0.9..1.1),
        turn: rng.random_range(-0.9..0.9),
        cycles: rng.random_range(1.0..1.2),
        phase: rng.random_range(0.0..TAU),
    };
    let mut a = Assembly::new(rng);
    let coat = Material::random(a.rng, Pattern::Stripes(Vec3::new(1.0, 5.0, 1.0)), 0.026);
    let trousers = Material::random(a.rng, Pattern::Blobs(0.1), 0.026);
    let skin = Material::tinted(a.rng, [0.72, 0.54, 0.44], Pattern::Blobs(0.11), 0.024);
    let shoe = Material::tinted(a.rng, [0.25, 0.2, 0.18], Pattern::Plain, 0.03);
    a.carry(move |time| gait.world_from_hips(time));
    let chest = DVec3::new(0.14, 0.33, 0.21);
    a.add(Mesh::ellipsoid(chest, 32).at(DVec3::Y * (-0.55 * TRUNK)), coat.clone());
    a.add(Mesh::ellipsoid(DVec3::new(0.13, 0.12, 0.17), 28), trousers.clone());
    a.add(Mesh::cylinder(0.055, 0.08, 20, 2).at(DVec3::Y * (-TRUNK - 0.06)), skin.clone());
    let head = DVec3::new(0.125, 0.15, 0.11);
    a.add(Mesh::ellipsoid(head, 28).at(DVec3::new(0.01, -TRUNK - 0.25, 0.0)), skin.clone());
    for side in [-1.0, 1.0] {
        a.carry(move |time| gait.world_from_thigh(side, time));
        a.add(rounded(0.085, THIGH), trousers.clone());
        a.carry(move |time| gait.world_from_shin(side, time));
        a.add(rounded(0.065, SHIN - 0.06), trousers.clone());
        let foot = Mesh::ellipsoid(DVec3::new(0.13, 0.05, 0.05), 24);
        a.add(foot.at(DVec3::new(0.06, SHIN - 0.05, 0.0)), shoe.clone());
        a.carry(move |time| gait.world_from_upper_arm(side, time));
        a.add(rounded(0.06, UPPER_ARM), coat.clone());
        a.carry(move |time| gait.world_from_lower_arm(side, time));
        a.add(rounded(0.048, LOWER_ARM - 0.06), coat.clone());
        a.add(Mesh::ellipsoid(DVec3::splat(0.055), 20).at(DVec3::Y * LOWER_ARM), skin.clone());
    }
    a.parts
}

/// A rounded limb from the joint at the origin down along y.
fn rounded(radius: f64, length: f64) -> Mesh {
    let half = 0.5 * length;
    Mesh::ellipsoid(DVec3::new(radius, half + 0.6 * radius, radius), 24).at(DVec3::Y * half)
}
