//! Triangulation of points from rays of known cameras.

use super::se3::matrix3;
use crate::types::{Intrinsics, Pose};
use glam::{DMat3, DVec2, DVec3};
use nalgebra::Vector3;

/// A triangulated point with its uncertainty.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Triangulated {
    /// Position in the world.
    pub point: DVec3,
    /// The largest angle between two of the rays, radians; a small value means a large uncertainty.
    pub parallax: f64,
    /// Root mean square angle between the given rays and the directions to the point, radians.
    pub angular_rmse: f64,
}

/// Triangulates the point that minimises the angles to rays of at least two cameras: midpoint method,
/// reweighted by inverse squared distance, which converts distances to sines of angles.
///
/// A view is (`view_from_world`, ray in the camera frame, z > 0). `None` for fewer than two views, rays
/// that are parallel to rounding, or a point behind any of the cameras.
pub fn triangulate(views: &[(Pose, DVec3)]) -> Option<Triangulated> {
    if views.len() < 2 {
        return None;
    }
    let rays: Vec<(DVec3, DVec3)> = views
        .iter()
        .map(|(pose, ray)| {
            let inverse = pose.inverse();
            (inverse.translation, (inverse.rotation * *ray).normalize_or_zero())
        })
        .collect();
    let mut parallax = 0.0f64;
    for (i, a) in rays.iter().enumerate() {
        for b in &rays[i + 1..] {
            parallax = parallax.max(a.1.cross(b.1).length().atan2(a.1.dot(b.1)));
        }
    }
    if parallax.is_nan() || parallax < 1e-9 {
        return None;
    }
    // Relative to the first camera, so that a world far from its origin loses no precision.
    let origin = rays[0].0;
    let mut weights = vec![1.0; rays.len()];
    let mut point = DVec3::ZERO;
    for _ in 0..4 {
        let (mut normal, mut right) = (DMat3::ZERO, DVec3::ZERO);
        for ((centre, d), w) in rays.iter().zip(&weights) {
            let across = DMat3::IDENTITY - DMat3::from_cols(*d * d.x, *d * d.y, *d * d.z);
            normal += across * *w;
            right += across * (*centre - origin) * *w;
        }
        let solved = matrix3(&normal).cholesky()?.solve(&Vector3::new(right.x, right.y, right.z));
        point = DVec3::new(solved[0], solved[1], solved[2]);
        for ((centre, _), w) in rays.iter().zip(&mut weights) {
            *w = 1.0 / (point + origin - *centre).length_squared().max(1e-300);
        }
    }
    let point = point + origin;
    let mut squared = 0.0;
    for ((pose, ray), (centre, d)) in views.iter().zip(&rays) {
        if pose.apply(point).dot(*ray) <= 0.0 {
            return None;
        }
        let towards = point - *centre;
        squared += towards.cross(*d).length().atan2(towards.dot(*d)).powi(2);
    }
    point.is_finite().then(|| Triangulated {
        point,
        parallax,
        angular_rmse: (squared / views.len() as f64).sqrt(),
    })
}

/// An inverse depth with its uncertainty.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct InverseDepth {
    /// 1 / z in the reference camera; 0 where the pixels indicate a point at infinity or beyond.
    pub value: f64,
    /// Standard deviation for pixel errors of 1 px; infinite without parallax.
    pub deviation: f64,
    /// Root mean square reprojection error, pixels.
    pub rmse: f64,
}

/// The inverse depth of a reference pixel that best explains its observations in other frames: the initial
/// value for bundle adjustment.
///
/// A view is (`target_from_reference`, pixel, weight). Linear estimate, then Gauss–Newton on the pixels
/// with a Huber kernel of `huber` px. `None` without a view of positive weight, or where the point moves
/// behind a target during the iteration.
pub fn inverse_depth(
    intrinsics: &Intrinsics,
    pixel: DVec2,
    views: &[(Pose, DVec2, f64)],
    huber: f64,
) -> Option<InverseDepth> {
    let ray = intrinsics.ray(pixel);
    // x × (R ray + d t) = 0 for the observed ray x.
    let (mut upper, mut lower) = (0.0, 0.0);
    for (pose, seen, weight) in views {
        let x = intrinsics.ray(*seen).normalize_or_zero();
        let (a, b) = (x.cross(pose.rotation * ray), x.cross(pose.translation));
        upper -= weight * a.dot(b);
        lower += weight * b.length_squared();
    }
    let mut d = if lower > 0.0 { (upper / lower).max(0.0) } else { 0.0 };
    let (mut information, mut sum, mut total) = (0.0, 0.0, 0.0);
    for step in 0..6 {
        let (mut h, mut g) = (0.0, 0.0);
        (information, sum, total) = (0.0, 0.0, 0.0);
        for (pose, seen, weight) in views.iter().filter(|v| v.2 > 0.0) {
            let (u, jacobian) = super::bundle::project(intrinsics, pose, pixel, d)?;
            let (r, j) = (u - *seen, jacobian.inverse_depth);
            let length = r.length();
            let w = weight * if length <= huber { 1.0 } else { huber / length };
            h += w * j.length_squared();
            g += w * j.dot(r);
            information += weight * j.length_squared();
            sum += weight * length * length;
            total += weight;
        }
        if h > 0.0 && step < 5 {
            d = (d - g / h).max(0.0);
        }
    }
    (total > 0.0 && d.is_finite() && sum.is_finite()).then(|| InverseDepth {
        value: d,
        deviation: if information > 0.0 { 1.0 / information.sqrt() } else { f64::INFINITY },
        rmse: (sum / total).sqrt(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::se3::exp_so3;
    use glam::DQuat;

    fn cameras(offset: DVec3) -> Vec<Pose> {
        (0..4)
            .map(|i| {
                let t = i as f64;
                let centre = offset + DVec3::new(0.3 * t, 0.1 * t * t, 0.05 * t);
                Pose::new(exp_so3(DVec3::new(0.02 * t, -0.05 * t, 0.1)), centre).inverse()
            })
            .collect()
    }

    #[test]
    fn rays_through_a_point_give_the_point() {
        for offset in [DVec3::ZERO, DVec3::splat(1e6)] {
            let point = offset + DVec3::new(0.5, -0.3, 4.0);
            let views: Vec<_> = cameras(offset).iter().map(|p| (*p, p.apply(point))).collect();
            for n in [2, 4] {
                let found = triangulate(&views[..n]).unwrap();
                assert!((found.point - point).length() < 1e-8, "{found:?}");
                assert!(found.angular_rmse < 1e-8 && found.parallax > 0.05);
            }
        }
    }

    #[test]
    fn what_cannot_be_triangulated_is_none() {
        let cameras = cameras(DVec3::ZERO);
        let away: Vec<_> = cameras.iter().map(|p| (*p, p.rotation * DVec3::Z)).collect();
        assert!(triangulate(&away).is_none(), "parallel rays");
        let point = DVec3::new(0.0, 0.0, -4.0);
        let behind: Vec<_> = cameras.iter().map(|p| (*p, -p.apply(point))).collect();
        assert!(triangulate(&behind).is_none(), "behind");
        assert!(triangulate(&behind[..1]).is_none());
        assert!(triangulate(&[(cameras[0], DVec3::NAN), (cameras[1], DVec3::Z)]).is_none());
    }

    #[test]
    fn inverse_depth_is_found_with_one_bad_view_and_at_infinity() {
        let k = Intrinsics::centred(400.0, 480, 270);
        let cameras = cameras(DVec3::ZERO);
        let pixel = DVec2::new(200.0, 150.0);
        let relative: Vec<Pose> = cameras[1..].iter().map(|p| *p * cameras[0].inverse()).collect();
        for d in [0.0, 0.2, 0.9] {
            let mut views: Vec<_> = relative
                .iter()
                .map(|p| (*p, super::super::bundle::project(&k, p, pixel, d).unwrap().0, 1.0))
                .collect();
            let found = inverse_depth(&k, pixel, &views, 1.0).unwrap();
            assert!((found.value - d).abs() < 1e-9 && found.rmse < 1e-6, "{found:?}");
            assert!(found.deviation < 0.1);
            views.push((relative[0], views[0].1 + DVec2::new(30.0, 5.0), 1.0));
            views.push((relative[1], views[1].1, 1.0));
            let found = inverse_depth(&k, pixel, &views, 1.0).unwrap();
            assert!((found.value - d).abs() < 0.03, "{d}: {found:?}");
        }
        let still = [(Pose::new(DQuat::IDENTITY, DVec3::ZERO), pixel, 1.0)];
        let found = inverse_depth(&k, pixel, &still, 1.0).unwrap();
        assert!(found.deviation.is_infinite() && found.value == 0.0);
        assert!(inverse_depth(&k, pixel, &[], 1.0).is_none());
    }
}
