//! The point that cameras look at, and cameras that look at a point.

use glam::{DMat3, DQuat, DVec3};

use crate::types::{Camera, Pose};

/// The point nearest to all cameras' optical axes, in the least-squares sense, in world units.
///
/// `None` where there are fewer than two cameras, where their axes are so nearly parallel that the point is
/// undetermined, or where it is not in front of most of them.
pub fn look_at_point(cameras: &[Camera]) -> Option<DVec3> {
    // The squared distance of p to an axis with direction d through c is |(I − d dᵀ)(p − c)|².
    let (mut normal, mut right) = (DMat3::ZERO, DVec3::ZERO);
    for camera in cameras {
        let d = camera.view_from_world.inverse().rotation * DVec3::Z;
        let across = DMat3::IDENTITY - DMat3::from_cols(d * d.x, d * d.y, d * d.z);
        normal += across;
        right += across * camera.centre();
    }
    // The determinant is zero for parallel axes; for n axes that spread by an angle a it is about n³ sin² a.
    let spread = normal.determinant() / (cameras.len() as f64).powi(3);
    if cameras.len() < 2 || !spread.is_finite() || spread < 1e-4 {
        return None;
    }
    let point = normal.inverse() * right;
    let before = cameras.iter().filter(|c| c.view_from_world.apply(point).z > 0.0).count();
    (2 * before > cameras.len()).then_some(point)
}

/// `view_from_world` of a camera at `centre` that looks at `target`, with `up` pointing up in its image.
/// Where `up` is parallel to the line of sight, another direction replaces it.
pub fn look_at(centre: DVec3, target: DVec3, up: DVec3) -> Pose {
    let forward = (target - centre).try_normalize().unwrap_or(DVec3::Z);
    let right = forward.cross(up).try_normalize().filter(|r| r.is_finite());
    let right = match right {
        Some(right) if forward.cross(up).length() > 1e-6 * up.length() => right,
        _ => forward.any_orthonormal_vector(),
    };
    let down = forward.cross(right);
    let world_from_view = DQuat::from_mat3(&DMat3::from_cols(right, down, forward));
    Pose::new(world_from_view, centre).inverse()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::types::Intrinsics;

    fn camera(centre: DVec3, target: DVec3) -> Camera {
        let view_from_world = look_at(centre, target, DVec3::NEG_Y);
        Camera { intrinsics: Intrinsics::centred(100.0, 64, 48), view_from_world }
    }

    #[test]
    fn cameras_see_their_target_in_the_middle_and_upright() {
        let (centre, target) = (DVec3::new(1.0, -2.0, 3.0), DVec3::new(-4.0, 0.5, 9.0));
        let camera = camera(centre, target);
        assert!((camera.centre() - centre).length() < 1e-12);
        let seen = camera.view_from_world.apply(target);
        assert!(seen.x.abs() < 1e-12 && seen.y.abs() < 1e-12);
        assert!((seen.z - (target - centre).length()).abs() < 1e-12);
        let above = camera.view_from_world.apply(target + DVec3::NEG_Y);
        assert!(above.y < 0.0 && above.x.abs() < 1e-12, "up is up: {above}");
        // Along the up direction, up is undefined, and the result is still a rotation.
        let pose = look_at(DVec3::ZERO, DVec3::NEG_Y, DVec3::NEG_Y);
        assert!((pose.apply(DVec3::NEG_Y) - DVec3::Z).length() < 1e-12);
    }

    #[test]
    fn axes_meet_where_cameras_look() {
        let target = DVec3::new(0.3, 0.2, 5.0);
        let ring: Vec<Camera> = (0..7)
            .map(|i| {
                let (sin, cos) = (0.5 * f64::from(i)).sin_cos();
                camera(DVec3::new(3.0 * cos, 0.4 * sin, 5.0 + 3.0 * sin), target)
            })
            .collect();
        assert!((look_at_point(&ring).unwrap() - target).length() < 1e-9);
        assert_eq!(look_at_point(&ring[..1]), None);
        // Side by side with parallel axes.
        let row: Vec<Camera> = (0..5)
            .map(|i| camera(DVec3::X * f64::from(i), DVec3::new(f64::from(i), 0.0, 1.0)))
            .collect();
        assert_eq!(look_at_point(&row), None);
        // Axes that meet behind the cameras.
        let out: Vec<Camera> =
            ring.iter().map(|c| camera(c.centre(), 2.0 * c.centre() - target)).collect();
        assert_eq!(look_at_point(&out), None);
    }
}
