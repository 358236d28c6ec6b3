//! The residual of one observation, its derivatives, and sums over all observations.

use super::{Kernel, Observation, Options, Problem, counts};
use crate::geometry::se3::skew;
use crate::types::{Intrinsics, Pose};
use glam::{DMat3, DVec2, DVec3};
use rayon::prelude::*;

/// Block size of sums, which are taken over blocks and then in order, so that they do not depend on the
/// number of threads.
const BLOCK: usize = 4096;

/// Derivatives of a projected pixel, with left-multiplied twists (translation, rotation).
#[derive(Clone, Copy, Debug)]
pub struct Jacobian {
    /// With respect to the twist of the observing frame's pose.
    pub target: [DVec2; 6],
    /// With respect to the twist of the reference frame's pose.
    pub reference: [DVec2; 6],
    /// With respect to the inverse depth.
    pub inverse_depth: DVec2,
    /// With respect to the logarithm of the focal length.
    pub log_focal: DVec2,
    /// With respect to the first radial distortion coefficient.
    pub k1: DVec2,
}

/// Projects a pixel of the reference frame with an inverse depth to the target frame, with derivatives;
/// `None` where it is behind the target or nearly in its image plane.
///
/// `target_from_reference = G_t G_r⁻¹`.
pub fn project(
    k: &Intrinsics,
    target_from_reference: &Pose,
    pixel: DVec2,
    inverse_depth: f64,
) -> Option<(DVec2, Jacobian)> {
    project_through(k, 0.0, target_from_reference, pixel, inverse_depth)
}

/// [`project`] through a lens that images the ideal position p in the plane of unit depth at p (1 + k1
/// |p|²); also `None` where the lens's mapping folds over.
pub(super) fn project_through(
    k: &Intrinsics,
    k1: f64,
    target_from_reference: &Pose,
    pixel: DVec2,
    inverse_depth: f64,
) -> Option<(DVec2, Jacobian)> {
    let rotation = target_from_reference.rotation_matrix();
    let (u, x, ray) =
        forward(k, k1, &rotation, target_from_reference.translation, pixel, inverse_depth)?;
    let (iz, d) = (1.0 / x.z, inverse_depth);
    let n = x.truncate() * iz;
    let n2 = n.length_squared();
    // Rows of the derivative of the pixel with respect to the homogeneous point x = R ray + d t: of the
    // pinhole camera, then of the lens.
    let plane_x = DVec3::new(iz, 0.0, -n.x * iz);
    let plane_y = DVec3::new(0.0, iz, -n.y * iz);
    let stretch = 2.0 * k1 * (n.x * plane_x + n.y * plane_y);
    let row_x = k.fx * ((1.0 + k1 * n2) * plane_x + n.x * stretch);
    let row_y = k.fy * ((1.0 + k1 * n2) * plane_y + n.y * stretch);
    let by = |v: DVec3| DVec2::new(row_x.dot(v), row_y.dot(v));
    let axes = [DVec3::X, DVec3::Y, DVec3::Z];
    // Left twist of G_t: x ← x + d ρ + ω × x.
    let target: [DVec2; 6] = std::array::from_fn(|c| match c {
        0..3 => by(axes[c] * d),
        _ => by(axes[c - 3].cross(x)),
    });
    // Left twist of G_r: G_t G_r⁻¹ exp(−ξ), so x ← x − R (d ρ + ω × ray), as x depends on the
    // reference frame's point (ray, d).
    let turned = rotation * skew(ray);
    let reference: [DVec2; 6] = std::array::from_fn(|c| match c {
        0..3 => by(rotation.col(c) * -d),
        _ => by(turned.col(c - 3)),
    });
    let inverse_depth = by(target_from_reference.translation);
    // The ray's x and y solve r (1 + k1 r²) = m, where m is the pixel over f: along the ray, (1 + 3 k1 r²)
    // dr = dm − r³ dk1. f scales m inversely, and the pixel about the principal point.
    let r2 = ray.x * ray.x + ray.y * ray.y;
    let along = by(rotation.col(0) * ray.x + rotation.col(1) * ray.y) / (1.0 + 3.0 * k1 * r2);
    let log_focal = DVec2::new(u.x - k.cx, u.y - k.cy) - (1.0 + k1 * r2) * along;
    let by_k1 = DVec2::new(k.fx, k.fy) * n * n2 - r2 * along;
    Some((u, Jacobian { target, reference, inverse_depth, log_focal, k1: by_k1 }))
}

/// Pixel, homogeneous point and ray; `None` unless the point is clearly in front of the target.
fn forward(
    k: &Intrinsics,
    k1: f64,
    rotation: &DMat3,
    translation: DVec3,
    pixel: DVec2,
    inverse_depth: f64,
) -> Option<(DVec2, DVec3, DVec3)> {
    let ray = undistorted(k1, k.ray(pixel).truncate())?.extend(1.0);
    let x = *rotation * ray + inverse_depth * translation;
    // Rays within about a tenth of a degree of the image plane are excluded.
    if x.z <= 2e-3 * x.abs().max_element() {
        return None;
    }
    if k1 == 0.0 {
        return Some((k.project(x), x, ray));
    }
    let n = x.truncate() / x.z;
    let factor = 1.0 + k1 * n.length_squared();
    let rising = 1.0 + 3.0 * k1 * n.length_squared() > FOLD;
    rising.then(|| (k.project((factor * n).extend(1.0)), x, ray))
}

/// Minimum radial derivative of the distortion, relative to a pinhole camera; below it, the lens model is
/// not used.
const FOLD: f64 = 0.1;

/// Ideal pinhole position of the distorted position `m`, both in the plane of unit depth; `None` where the
/// mapping folds over.
fn undistorted(k1: f64, m: DVec2) -> Option<DVec2> {
    if k1 == 0.0 {
        return Some(m);
    }
    let reach = m.length();
    let mut r = reach;
    for _ in 0..20 {
        let slope = 1.0 + 3.0 * k1 * r * r;
        if slope < FOLD {
            return None;
        }
        let step = (r * (1.0 + k1 * r * r) - reach) / slope;
        r -= step;
        if step.abs() <= 1e-15 * reach {
            break;
        }
    }
    let solved = (r * (1.0 + k1 * r * r) - reach).abs() <= 1e-12 * (1.0 + reach);
    (solved && r >= 0.0).then(|| if reach > 0.0 { m * (r / reach) } else { m })
}

/// `target_from_reference` for an observation.
pub(super) fn relative(problem: &Problem, o: &Observation) -> Pose {
    problem.poses[o.frame] * problem.poses[problem.points[o.point].frame].inverse()
}

/// The residual (projection − observation); `None` behind the camera.
fn residual(problem: &Problem, o: &Observation) -> Option<DVec2> {
    let point = &problem.points[o.point];
    let relative = relative(problem, o);
    let rotation = relative.rotation_matrix();
    let (u, _, _) = forward(
        &problem.intrinsics,
        problem.k1,
        &rotation,
        relative.translation,
        point.pixel,
        point.inverse_depth,
    )?;
    Some(u - o.pixel)
}

/// ρ(r²) and ρ'(r²), the IRLS weight, of a kernel of width c.
pub(super) fn kernel(kind: Kernel, squared: f64, c: f64) -> (f64, f64) {
    let c2 = c * c;
    match kind {
        Kernel::None => (squared, 1.0),
        Kernel::Cauchy => (c2 * (squared / c2).ln_1p(), c2 / (c2 + squared)),
        Kernel::GemanMcClure => {
            let share = c2 / (c2 + squared);
            (squared * share, share * share)
        }
    }
}

/// The total robust cost at a scale, including priors.
///
/// An observation behind its camera costs as much as a residual of the image's diagonal, so that no step
/// gains by moving points behind a camera.
pub(super) fn cost(problem: &Problem, options: &Options, scale: f64) -> f64 {
    let c = options.kernel_width * scale;
    let k = &problem.intrinsics;
    let diagonal2 = f64::from(k.width).powi(2) + f64::from(k.height).powi(2);
    let behind = kernel(options.kernel, diagonal2.max(1.0), c).0;
    let observed = ordered_sum(&problem.observations, |o| {
        if !counts(problem, o) {
            return 0.0;
        }
        let rho = residual(problem, o)
            .map_or(behind, |r| kernel(options.kernel, (r / o.deviation).length_squared(), c).0);
        o.weight * rho
    });
    let priors: f64 = problem
        .points
        .iter()
        .filter_map(|p| p.prior.map(|q| q.weight * (p.inverse_depth - q.inverse_depth).powi(2)))
        .sum();
    observed + priors + focal_prior(problem, options, scale).map_or(0.0, |(w, e)| w * e * e)
}

/// Weight and error (log ratio) of the focal length's prior. A pixel residual has weight 1 at a standard
/// deviation of `scale`; the prior has weight 1 at its own standard deviation.
pub(super) fn focal_prior(problem: &Problem, options: &Options, scale: f64) -> Option<(f64, f64)> {
    let (focal, std) = options.focal_prior?;
    Some(((scale / std).powi(2), (problem.intrinsics.fx / focal).ln()))
}

/// Σ w r² / σ² over the observations in front of their cameras.
pub(super) fn squared_sum(problem: &Problem) -> f64 {
    ordered_sum(&problem.observations, |o| {
        if !counts(problem, o) {
            return 0.0;
        }
        residual(problem, o).map_or(0.0, |r| o.weight * (r / o.deviation).length_squared())
    })
}

/// Length of every residual; infinite behind the camera.
pub(super) fn lengths(problem: &Problem) -> Vec<f64> {
    problem
        .observations
        .par_iter()
        .map(|o| residual(problem, o).map_or(f64::INFINITY, |r| r.length()))
        .collect()
}

/// 1.4826 · median |residual coordinate| / σ over the used observations, with a lower bound.
pub(super) fn robust_scale(problem: &Problem, options: &Options) -> f64 {
    let mut sizes: Vec<f64> = problem
        .observations
        .par_iter()
        .filter(|o| counts(problem, o))
        .filter_map(|o| residual(problem, o).map(|r| r / o.deviation))
        .flat_map_iter(|r| [r.x.abs(), r.y.abs()])
        .collect();
    let floor = options.scale_floor.max(1e-6);
    if sizes.is_empty() {
        return floor;
    }
    let middle = sizes.len() / 2;
    (1.4826 * *sizes.select_nth_unstable_by(middle, f64::total_cmp).1).max(floor)
}

/// Weighted RMS of the residuals within the kernel width, pixels, and their share.
pub(super) fn inliers(problem: &Problem, options: &Options, scale: f64) -> (f64, f64) {
    let limit = options.kernel_width * scale;
    let (mut sum, mut weight, mut count, mut all) = (0.0, 0.0, 0usize, 0usize);
    for (o, length) in problem.observations.iter().zip(lengths(problem)) {
        if counts(problem, o) {
            all += 1;
            if length <= limit * o.deviation {
                count += 1;
                let information = o.weight / o.deviation.powi(2);
                sum += information * length * length;
                weight += information;
            }
        }
    }
    let rmse = if weight > 0.0 { (sum / weight).sqrt() } else { 0.0 };
    (rmse, count as f64 / all.max(1) as f64)
}

fn ordered_sum<T: Sync>(items: &[T], term: impl Fn(&T) -> f64 + Sync) -> f64 {
    let blocks: Vec<f64> =
        items.par_chunks(BLOCK).map(|block| block.iter().map(&term).sum()).collect();
    blocks.iter().sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::se3::{Twist, exp_so3, retract};

    /// Pixel for poses, inverse depth, focal factor and distortion.
    fn seen(
        k: &Intrinsics,
        [t, r]: [&Pose; 2],
        pixel: DVec2,
        d: f64,
        log_focal: f64,
        k1: f64,
    ) -> DVec2 {
        let k = Intrinsics { fx: k.fx * log_focal.exp(), fy: k.fy * log_focal.exp(), ..*k };
        project_through(&k, k1, &(*t * r.inverse()), pixel, d).unwrap().0
    }

    #[test]
    fn jacobians_match_central_differences() {
        let k = Intrinsics { fx: 400.0, fy: 420.0, cx: 150.0, cy: 110.0, width: 320, height: 240 };
        let r = Pose::new(exp_so3(DVec3::new(0.2, -0.1, 0.3)), DVec3::new(0.3, 0.5, -0.2));
        let t = Pose::new(exp_so3(DVec3::new(0.1, 0.2, 0.1)), DVec3::new(-0.4, 0.1, 0.6));
        for (pixel, d, k1) in [
            (DVec2::new(40.0, 200.0), 0.4, 0.0),
            (DVec2::new(300.0, 20.0), 1.7, -0.1),
            (DVec2::ONE, 0.0, 0.2),
            (DVec2::new(k.cx, k.cy), 0.3, -0.3),
        ] {
            let (_, j) = project_through(&k, k1, &(t * r.inverse()), pixel, d).unwrap();
            let h = 1e-6;
            let compare = |name: &str, analytic: DVec2, at: &dyn Fn(f64) -> DVec2| {
                let numeric = (at(h) - at(-h)) / (2.0 * h);
                let scale = 1.0 + analytic.length();
                assert!(
                    (numeric - analytic).length() < 1e-6 * scale,
                    "{name} {numeric} {analytic}"
                );
            };
            for c in 0..6 {
                let twist = |s: f64| {
                    let mut xi = Twist::zeros();
                    xi[c] = s;
                    xi
                };
                compare("target", j.target[c], &|s| {
                    seen(&k, [&retract(&t, &twist(s)), &r], pixel, d, 0.0, k1)
                });
                compare("reference", j.reference[c], &|s| {
                    seen(&k, [&t, &retract(&r, &twist(s))], pixel, d, 0.0, k1)
                });
            }
            compare("depth", j.inverse_depth, &|s| seen(&k, [&t, &r], pixel, d + s, 0.0, k1));
            compare("focal", j.log_focal, &|s| seen(&k, [&t, &r], pixel, d, s, k1));
            compare("k1", j.k1, &|s| seen(&k, [&t, &r], pixel, d, 0.0, k1 + s));
        }
    }

    #[test]
    fn what_a_lens_distorts_is_undistorted() {
        for k1 in [-0.3, -0.05, 0.0, 0.1, 0.5] {
            for p in [DVec2::ZERO, DVec2::new(0.3, -0.6), DVec2::new(-0.7, 0.1)] {
                let m = p * (1.0 + k1 * p.length_squared());
                let found = undistorted(k1, m).unwrap();
                assert!((found - p).length() < 1e-14, "{k1} {p}: {found}");
            }
        }
        // r (1 − r²) is 0.385 at the most.
        assert!(undistorted(-1.0, DVec2::new(0.4, 0.0)).is_none());
        assert!(undistorted(-1.0, DVec2::new(0.384, 0.0)).is_none(), "nearly folded");
    }

    #[test]
    fn a_point_behind_the_target_is_not_projected() {
        let k = Intrinsics::centred(300.0, 320, 240);
        let behind = Pose::new(exp_so3(DVec3::new(0.0, 3.1, 0.0)), DVec3::ZERO);
        assert!(project(&k, &behind, DVec2::new(100.0, 100.0), 0.5).is_none());
        let forward = Pose::new(glam::DQuat::IDENTITY, DVec3::new(0.0, 0.0, -3.0));
        assert!(project(&k, &forward, DVec2::new(100.0, 100.0), 0.5).is_none());
        assert!(project(&k, &forward, DVec2::new(100.0, 100.0), 0.2).is_some());
    }

    #[test]
    fn kernel_weights_are_the_derivatives_of_the_kernels() {
        for kind in [Kernel::None, Kernel::Cauchy, Kernel::GemanMcClure] {
            for squared in [0.0, 0.3, 4.0, 900.0] {
                let h = 1e-5 * (1.0 + squared);
                let at = |s: f64| kernel(kind, s, 1.5).0;
                let numeric = (at(squared + h) - at(squared - h)) / (2.0 * h);
                assert!((numeric - kernel(kind, squared, 1.5).1).abs() < 1e-8, "{kind:?}");
            }
        }
    }
}
