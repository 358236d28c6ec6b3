//! Objects in free flight: a ball and a box.

use glam::{DQuat, DVec3, Vec3};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::mesh::Mesh;
use super::movers::sign;
use super::scene::{Assembly, Part};
use super::texture::{Material, Pattern};
use crate::types::Pose;

/// Duration of a clip, s. No object reaches the floor within it.
const DURATION: f64 = 0.7;
/// Metres per second², downwards.
const GRAVITY: f64 = 9.81;

/// A flight: position in the middle of the clip, velocity and spin.
struct Flight {
    middle: DVec3,
    /// Velocity, m/s.
    velocity: DVec3,
    /// Angular velocity about the world axes, rad/s.
    spin: DVec3,
}

impl Flight {
    fn world_from_shape(&self, time: f64) -> Pose {
        let t = DURATION * (time - 0.5);
        let place = self.middle + self.velocity * t + DVec3::Y * (0.5 * GRAVITY * t * t);
        Pose::new(DQuat::from_scaled_axis(self.spin * t), place)
    }
}

/// A ball and a box that fly past each other on parabolas, spinning.
pub(super) fn ball_and_box(rng: &mut ChaCha8Rng) -> Vec<Part> {
    let way = sign(rng);
    let mut a = Assembly::new(rng);
    let ball = Flight {
        middle: DVec3::new(
            a.rng.random_range(-0.15..0.15),
            a.rng.random_range(-0.55..-0.45),
            a.rng.random_range(2.9..3.1),
        ),
        velocity: DVec3::new(
            way * a.rng.random_range(1.7..2.0),
            0.0,
            a.rng.random_range(-0.4..0.4),
        ),
        spin: random_spin(a.rng, 2.5),
    };
    a.carry(move |time| ball.world_from_shape(time));
    let skin = Material::random(a.rng, Pattern::Stripes(Vec3::new(2.0, 3.5, 0.0)), 0.03);
    let radius = a.rng.random_range(0.17..0.2);
    a.add(Mesh::ellipsoid(DVec3::splat(radius), 48), skin);
    let parcel = Flight {
        middle: DVec3::new(
            a.rng.random_range(-0.15..0.15),
            a.rng.random_range(-0.15..-0.05),
            a.rng.random_range(3.5..3.7),
        ),
        velocity: DVec3::new(
            -way * a.rng.random_range(1.5..1.8),
            a.rng.random_range(-0.1..0.1),
            a.rng.random_range(-0.4..0.4),
        ),
        spin: random_spin(a.rng, 3.0),
    };
    a.carry(move |time| parcel.world_from_shape(time));
    let paper = Material::random(a.rng, Pattern::Blobs(0.14), 0.03);
    a.add(Mesh::cuboid(DVec3::new(0.24, 0.17, 0.2), 0.3), paper);
    a.parts
}

fn random_spin(rng: &mut ChaCha8Rng, rate: f64) -> DVec3 {
    let axis = DVec3::from_array(std::array::from_fn(|_| rng.random_range(-1.0..1.0)));
    axis.try_normalize().unwrap_or(DVec3::Y) * rng.random_range(0.8 * rate..1.2 * rate)
}
