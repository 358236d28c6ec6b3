//! Where to put the first Gaussians when there are no points: in the space that the cameras look
//! at.

use glam::DVec3;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::data::Point;
use crate::geometry::look_at_point;
use crate::types::{Camera, range};

/// `count` grey points spread evenly over the cube that the cameras look at: around the point
/// nearest to their axes, its half side a third of the cameras' mean distance from it (the objects
/// of NeRF's and D-NeRF's synthetic scenes fill about that, seen from a distance of 4). Cameras
/// with parallel axes do not meet anywhere: there the cube lies before their middle, as deep as
/// they are spread.
pub fn random_points(cameras: &[Camera], count: usize, seed: u64) -> Vec<Point> {
    let mean = |points: &mut dyn Iterator<Item = DVec3>| {
        points.sum::<DVec3>() / cameras.len().max(1) as f64
    };
    let middle = mean(&mut cameras.iter().map(Camera::centre));
    let seen = look_at_point(cameras).map(|point| {
        let sum: f64 = cameras.iter().map(|c| c.centre().distance(point)).sum();
        (point, sum / cameras.len() as f64)
    });
    // Cameras in one place look at that place: there is no cube around it.
    let seen = seen.filter(|(point, distance)| *distance > 1e-9 * point.length().max(1e-3));
    let (centre, distance) = match seen {
        Some(seen) => seen,
        None => {
            let axes = &mut cameras.iter().map(|c| c.view_from_world.inverse().rotation * DVec3::Z);
            let forward = mean(axes).try_normalize().unwrap_or(DVec3::Z);
            let spread = cameras.iter().map(|c| c.centre().distance(middle)).fold(0.0, f64::max);
            let distance = if spread > 1e-6 { 3.0 * spread } else { 3.0 };
            (middle + forward * distance, distance)
        }
    };
    let half = (distance / 3.0).clamp(f64::MIN_POSITIVE, f64::from(range::REACH));
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut inside = || DVec3::from_array(std::array::from_fn(|_| rng.random_range(-half..half)));
    (0..count)
        .map(|_| Point { position: (centre + inside()).as_vec3().to_array(), colour: [0.5; 3] })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::look_at;
    use crate::types::Intrinsics;

    #[test]
    fn points_lie_where_the_cameras_look() {
        let target = DVec3::new(10.0, 20.0, 30.0);
        let camera = |centre: DVec3| Camera {
            intrinsics: Intrinsics::centred(100.0, 64, 48),
            view_from_world: look_at(centre, target, DVec3::NEG_Y),
        };
        let around =
            [DVec3::X, DVec3::Z, DVec3::NEG_X].map(|side| camera(target + 6.0 * side)).to_vec();
        let points = random_points(&around, 500, 3);
        assert_eq!(points.len(), 500);
        let from = |p: &Point| glam::Vec3::from_array(p.position).as_dvec3() - target;
        assert!(points.iter().all(|p| from(p).abs().max_element() <= 2.0 + 1e-4));
        assert!(points.iter().any(|p| from(p).abs().max_element() > 1.8));
        assert_eq!(points, random_points(&around, 500, 3));
        assert_ne!(points, random_points(&around, 500, 4));
        // Cameras that turn in one place, and numbers that no reader lets through.
        let turning: Vec<Camera> = [DVec3::X, DVec3::Z, DVec3::NEG_X, DVec3::NEG_Z]
            .map(|side| Camera {
                view_from_world: look_at(target, target + side, DVec3::NEG_Y),
                ..around[0]
            })
            .to_vec();
        let points = random_points(&turning, 50, 3);
        assert!(points.iter().any(|p| from(p).length() > 0.5));
        for wild in [1e19, 1e300, f64::NAN, f64::INFINITY] {
            let mut cameras = around.clone();
            cameras[1].view_from_world.translation.x = wild;
            assert_eq!(random_points(&cameras, 50, 3).len(), 50);
        }
        // One camera alone.
        let seen = random_points(&around[..1], 50, 0);
        let before = |p: &Point| {
            let p = glam::Vec3::from_array(p.position).as_dvec3();
            around[0].view_from_world.apply(p).z > 0.0
        };
        assert!(seen.iter().all(before));
    }
}
