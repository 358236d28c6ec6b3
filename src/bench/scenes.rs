//! Benchmark scenes, determined by the seed.

use crate::types::{
    Camera, ControlPoints, DeformNet, Gaussians, Intrinsics, NetShape, Pose, sh_coefficients,
};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Mean number of splats per pixel: the splats' total area (within two standard deviations) over
/// the image's area.
const LAYERS: f64 = 12.0;

pub(super) fn rng(seed: u64) -> ChaCha8Rng {
    ChaCha8Rng::seed_from_u64(seed)
}

/// A camera at the origin that looks along z, with a horizontal field of view of 53°.
pub(super) fn camera(width: u32, height: u32) -> Camera {
    Camera {
        intrinsics: Intrinsics::centred(f64::from(width), width, height),
        view_from_world: Pose::IDENTITY,
    }
}

/// Gaussians that fill the view, some of them outside it. Their sizes give about twelve splats per
/// pixel, whatever their number.
pub(super) fn cloud(seed: u64, count: usize, degree: u32, camera: &Camera) -> Gaussians {
    let rng = &mut rng(seed);
    let k = camera.intrinsics;
    let (width, height) = (f64::from(k.width), f64::from(k.height));
    let sigma = (LAYERS * width * height / (4.0 * std::f64::consts::PI * count as f64)).sqrt();
    let mut out = Gaussians { sh_degree: degree, ..Gaussians::default() };
    for _ in 0..count {
        let z = rng.random_range(2.0f64..6.0);
        let x = rng.random_range(-0.55..0.55) * width / k.fx * z;
        let y = rng.random_range(-0.55..0.55) * height / k.fy * z;
        out.positions.push([x as f32, y as f32, z as f32]);
        let size = (sigma * z / k.fx).ln();
        let axis = |rng: &mut ChaCha8Rng| (size + rng.random_range(-0.7..0.5)) as f32;
        out.log_scales.push([axis(rng), axis(rng), axis(rng)]);
        out.rotations.push(std::array::from_fn(|_| rng.random_range(-1.0f32..1.0)));
        out.opacity_logits.push(rng.random_range(-3.0f32..3.0));
        for band in 0..sh_coefficients(degree) {
            let most = if band == 0 { 1.2 } else { 0.25 };
            out.sh.push(std::array::from_fn(|_| rng.random_range(-most..most)));
        }
    }
    out
}

/// Control points in the volume that [`cloud`] fills, with radii of the size of their distances.
pub(super) fn control_points(seed: u64, count: usize, camera: &Camera) -> ControlPoints {
    let rng = &mut rng(seed ^ 0xc0);
    let k = camera.intrinsics;
    let spacing = (40.0f64 / count.max(1) as f64).cbrt();
    let (half_x, half_y) = (0.55 * f64::from(k.width) / k.fx, 0.55 * f64::from(k.height) / k.fy);
    let positions = (0..count)
        .map(|_| {
            let z = rng.random_range(2.0f64..6.0);
            let (x, y) = (rng.random_range(-half_x..half_x), rng.random_range(-half_y..half_y));
            [(x * z) as f32, (y * z) as f32, z as f32]
        })
        .collect();
    let log_radii =
        (0..count).map(|_| (spacing.ln() + rng.random_range(-0.2..0.2)) as f32).collect();
    ControlPoints { positions, log_radii, paths: Vec::new() }
}

/// A network with visible motions; the usual initial head would give nearly none.
pub(super) fn network(seed: u64, shape: NetShape) -> DeformNet {
    let rng = &mut rng(seed ^ 0xd0);
    let mut net = DeformNet::random(shape, seed);
    let head = shape.layers().last().map_or(0, |(inputs, outputs)| (inputs + 1) * outputs);
    let at = net.parameters.len() - head;
    for p in &mut net.parameters[at..] {
        *p += rng.random_range(-0.02f32..0.02);
    }
    net
}

/// Makes all Gaussians dynamic.
pub(super) fn all_dynamic(mut gaussians: Gaussians) -> Gaussians {
    gaussians.motion_logits = vec![1.0; gaussians.len()];
    gaussians
}

/// A network with motion that is smooth in space and time, so that other networks can learn it: it
/// has few octaves, and motions are some tenths of a unit.
pub(super) fn swing(seed: u64) -> DeformNet {
    let shape = NetShape {
        depth: 6,
        width: 64,
        skip: 3,
        position_frequencies: 1,
        time_frequencies: 2,
        ..NetShape::PAPER
    };
    network(seed, shape)
}
