//! Random scenes by seed and index.

use super::FuzzScene;
use crate::types::{Camera, Gaussians, Intrinsics, Pose, RenderSettings, sh_coefficients};
use glam::{DQuat, DVec3};
use rand::seq::IndexedRandom;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

const SIZES: &[(u32, u32)] = &[(1, 1), (17, 3), (16, 16), (33, 17), (5, 40)];

/// The scene of a seed and an index. It is the same on every machine.
pub fn draw(seed: u64, index: u64) -> FuzzScene {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream(index);
    let rng = &mut rng;
    let camera = camera(rng);
    // Fraction of extreme values: none, a few, or a third of all numbers.
    let poison = [0.0, 0.03, 0.3][rng.random_range(0..3)];
    let degree = rng.random_range(0..4);
    let mut gaussians = Gaussians { sh_degree: degree, ..Gaussians::default() };
    let world_from_view = camera.view_from_world.inverse();
    for _ in 0..rng.random_range(1..6) {
        let z: f64 = rng.random_range(0.5..6.0);
        let k = camera.intrinsics;
        // A position inside or beside the image, if the camera is valid.
        let pixel = glam::DVec2::new(
            rng.random_range(-0.3..1.3) * f64::from(k.width),
            rng.random_range(-0.3..1.3) * f64::from(k.height),
        );
        let at = world_from_view.apply(k.ray(pixel) * z).as_vec3().to_array();
        let size = rng.random_range(-4.0f32..0.5);
        gaussians.positions.push(at.map(|v| spoil(rng, poison, v)));
        gaussians.log_scales.push(std::array::from_fn(|_| {
            let own = size + rng.random_range(-1.0f32..1.0);
            spoil(rng, poison, own)
        }));
        gaussians.rotations.push(std::array::from_fn(|_| {
            let own = rng.random_range(-1.0f32..1.0);
            spoil(rng, poison, own)
        }));
        let logit = rng.random_range(-7.0f32..8.0);
        gaussians.opacity_logits.push(spoil(rng, poison, logit));
        for _ in 0..sh_coefficients(degree) {
            gaussians.sh.push(std::array::from_fn(|_| {
                let own = rng.random_range(-0.6f32..0.6);
                spoil(rng, poison / 4.0, own)
            }));
        }
    }
    FuzzScene { gaussians, camera, seed: rng.random() }
}

/// The value itself, or with this probability an extreme or non-finite one.
fn spoil(rng: &mut ChaCha8Rng, probability: f64, value: f32) -> f32 {
    if !rng.random_bool(probability) {
        return value;
    }
    let settings = RenderSettings::default();
    let logit = |p: f32| (p / (1.0 - p)).ln();
    // Thresholds of the renderer, of f32's exponential, and of the quaternion's length.
    let thresholds = [
        settings.near,
        logit(settings.alpha_cut),
        logit(settings.alpha_cap),
        1e-10,
        88.722_84,
        -87.336_55,
        -103.972_08,
        40.0,
        -40.0,
        0.5,
        16.0,
        16.5,
    ];
    let others = [
        0.0,
        -0.0,
        f32::from_bits(1),
        1e-40,
        f32::MIN_POSITIVE,
        -f32::MIN_POSITIVE,
        1e-38,
        -1e-38,
        1e38,
        -1e38,
        f32::MAX,
        f32::MIN,
        f32::INFINITY,
        f32::NEG_INFINITY,
        f32::NAN,
        1e6,
        -1e6,
        1e-20,
        1e20,
    ];
    if rng.random() {
        let threshold = *thresholds.choose(rng).expect("there are some");
        match rng.random_range(0..3) {
            0 => threshold,
            1 => threshold.next_up(),
            _ => threshold.next_down(),
        }
    } else {
        *others.choose(rng).expect("there are some")
    }
}

fn camera(rng: &mut ChaCha8Rng) -> Camera {
    let &(width, height) = SIZES.choose(rng).expect("there are some");
    let mut intrinsics = Intrinsics::centred(rng.random_range(10.0..60.0), width, height);
    let mut pose = Pose::IDENTITY;
    if rng.random() {
        let angles: [f64; 3] = std::array::from_fn(|_| rng.random_range(-1.5..1.5));
        let rotation = DQuat::from_euler(glam::EulerRot::XYZ, angles[0], angles[1], angles[2]);
        let centre: [f64; 3] = std::array::from_fn(|_| rng.random_range(-2.0..2.0));
        let far = [1.0, 1.0, 1.0, 1e3, 1e6][rng.random_range(0..5)];
        pose = Pose::new(rotation, rotation * (DVec3::from_array(centre) * far));
    }
    if rng.random_bool(0.2) {
        let focal = 10f64.powf(rng.random_range(-3.0..6.0));
        (intrinsics.fx, intrinsics.fy) = (focal, focal * rng.random_range(0.5..2.0));
    }
    if rng.random_bool(0.2) {
        intrinsics.cx += 10f64.powf(rng.random_range(0.0..4.0));
    }
    if rng.random_bool(0.05) {
        let bad = [0.0, f64::NAN, f64::INFINITY, 1e38, 1e300, 1e-300, -1.0];
        let bad = *bad.choose(rng).expect("there are some");
        match rng.random_range(0..5) {
            0 => intrinsics.fx = bad,
            1 => intrinsics.cy = bad,
            2 => pose.translation.x = bad,
            3 => pose.translation.z = bad,
            _ => pose.rotation.w = bad,
        }
    }
    Camera { intrinsics, view_from_world: pose }
}
