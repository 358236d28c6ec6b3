//! Refinement of a relative pose on pixel pairs, without 3D points.

use super::epipolar::{essential_from_pose, fundamental_from_essential};
use super::se3::exp_so3;
use crate::types::{Intrinsics, Pose};
use glam::{DMat3, DVec2, DVec3};
use nalgebra::{SMatrix, SVector};

/// The signed Sampson distance of a pixel pair, pixels, and its derivative with respect to the left
/// rotation (three) and the translation `δ` (three, unconstrained) of `b_from_a`.
///
/// With rays a, b and y = R a: n = b·(t × y), and the epipolar lines are t × y in b and −Rᵀ(t × b) in a.
/// The distance is n over the norm of the lines' first two components in pixels.
pub fn sampson_with_jacobian(
    b_from_a: &Pose,
    ka: &Intrinsics,
    kb: &Intrinsics,
    pixel_a: DVec2,
    pixel_b: DVec2,
) -> Option<(f64, [f64; 6])> {
    let inverse = b_from_a.rotation_matrix().transpose();
    distance(b_from_a, &inverse, ka, kb, pixel_a, pixel_b)
}

fn distance(
    b_from_a: &Pose,
    a_from_b_rotation: &DMat3,
    ka: &Intrinsics,
    kb: &Intrinsics,
    pixel_a: DVec2,
    pixel_b: DVec2,
) -> Option<(f64, [f64; 6])> {
    let (a, b, t) = (ka.ray(pixel_a), kb.ray(pixel_b), b_from_a.translation);
    let back = |v: DVec3| *a_from_b_rotation * v;
    let y = a_from_b_rotation.transpose() * a;
    let m = b.cross(t);
    let (line_b, line_a) = (t.cross(y), back(m));
    let in_pixels = |l: DVec3, k: &Intrinsics| DVec2::new(l.x / k.fx, l.y / k.fy);
    let (gb, ga) = (in_pixels(line_b, kb), in_pixels(line_a, ka));
    let squared = gb.length_squared() + ga.length_squared();
    let n = b.dot(line_b);
    if squared.is_nan() || squared <= 1e-300 {
        return None;
    }
    let inverse = 1.0 / squared.sqrt();
    let mut jacobian = [0.0; 6];
    for c in 0..6 {
        let axis = [DVec3::X, DVec3::Y, DVec3::Z][c % 3];
        let (d_line_b, d_line_a) = if c < 3 {
            // y ← y + ω × y; Rᵀ ← Rᵀ (I − [ω]×).
            (t.cross(axis.cross(y)), -back(axis.cross(m)))
        } else {
            (axis.cross(y), back(b.cross(axis)))
        };
        let dn = b.dot(d_line_b);
        let d_squared = 2.0 * (gb.dot(in_pixels(d_line_b, kb)) + ga.dot(in_pixels(d_line_a, ka)));
        jacobian[c] = inverse * (dn - 0.5 * n * d_squared * inverse * inverse);
    }
    Some((n * inverse, jacobian))
}

/// Refines a relative pose (translation of length 1) by Levenberg–Marquardt on the Sampson distances of
/// pixel pairs with a Cauchy kernel of `width` px; also returns Σ w ρ, pixels².
///
/// The translation stays on the unit sphere, so there are five unknowns. The result is never worse than the
/// initial pose.
pub fn refine_relative(
    b_from_a: &Pose,
    ka: &Intrinsics,
    kb: &Intrinsics,
    pairs: &[(DVec2, DVec2)],
    weights: Option<&[f64]>,
    width: f64,
    steps: usize,
) -> (Pose, f64) {
    let mut pose = *b_from_a;
    let mut cost = relative_cost(&pose, ka, kb, pairs, weights, width);
    let mut damping = 1e-4;
    for _ in 0..steps {
        let (u, v) = pose.translation.normalize_or(DVec3::Z).any_orthonormal_pair();
        let (mut h, mut g) = (SMatrix::<f64, 5, 5>::zeros(), SVector::<f64, 5>::zeros());
        let inverse = pose.rotation_matrix().transpose();
        for (i, &(a, b)) in pairs.iter().enumerate() {
            let Some((s, j)) = distance(&pose, &inverse, ka, kb, a, b) else { continue };
            let w = weights.map_or(1.0, |w| w[i]) / (1.0 + s * s / (width * width));
            let by = |d: DVec3| j[3] * d.x + j[4] * d.y + j[5] * d.z;
            let row = SVector::<f64, 5>::new(j[0], j[1], j[2], by(u), by(v));
            h += row * row.transpose() * w;
            g += row * (w * s);
        }
        let floor = 1e-12 * h.diagonal().max();
        let mut improved = false;
        while damping < 1e8 {
            let mut damped = h;
            (0..5).for_each(|k| damped[(k, k)] += damping * h[(k, k)] + floor);
            let Some(factor) = damped.cholesky() else { return (pose, cost) };
            let d = -factor.solve(&g);
            let next = Pose::new(
                exp_so3(DVec3::new(d[0], d[1], d[2])) * pose.rotation,
                (pose.translation + u * d[3] + v * d[4]).normalize_or(pose.translation),
            );
            let next_cost = relative_cost(&next, ka, kb, pairs, weights, width);
            if next_cost < cost {
                improved = cost - next_cost > 1e-9 * cost;
                (pose, cost) = (next, next_cost);
                damping = (damping * 0.1).max(1e-12);
                break;
            }
            damping *= 10.0;
        }
        if !improved {
            break;
        }
    }
    (pose, cost)
}

fn relative_cost(
    pose: &Pose,
    ka: &Intrinsics,
    kb: &Intrinsics,
    pairs: &[(DVec2, DVec2)],
    weights: Option<&[f64]>,
    width: f64,
) -> f64 {
    let f = fundamental_from_essential(&essential_from_pose(pose), ka, kb);
    let width2 = width * width;
    let rho = |(i, &(a, b)): (usize, &(DVec2, DVec2))| {
        // A pair at both epipoles has no defined distance and is uninformative.
        let s2 = super::epipolar::sampson_squared(&f, a, b);
        let s2 = if s2.is_finite() { s2 } else { 0.0 };
        weights.map_or(1.0, |w| w[i]) * width2 * (s2 / width2).ln_1p()
    };
    pairs.iter().enumerate().map(rho).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::se3::angle_between;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    fn cameras() -> (Intrinsics, Intrinsics) {
        (
            Intrinsics { fx: 500.0, fy: 480.0, cx: 310.0, cy: 250.0, width: 640, height: 480 },
            Intrinsics { fx: 600.0, fy: 590.0, cx: 330.0, cy: 240.0, width: 640, height: 480 },
        )
    }

    fn truth() -> Pose {
        Pose::new(exp_so3(DVec3::new(0.05, -0.1, 0.2)), DVec3::new(0.6, 0.1, -0.3).normalize())
    }

    #[test]
    fn jacobian_matches_central_differences() {
        let (ka, kb) = cameras();
        let (a, b) = (DVec2::new(100.0, 300.0), DVec2::new(140.0, 333.0));
        let (s, j) = sampson_with_jacobian(&truth(), &ka, &kb, a, b).unwrap();
        let f = fundamental_from_essential(&essential_from_pose(&truth()), &ka, &kb);
        let squared = super::super::epipolar::sampson_squared(&f, a, b);
        assert!((s * s - squared).abs() < 1e-9 * squared);
        let h = 1e-6;
        for c in 0..6 {
            let at = |step: f64| {
                let mut d = DVec3::ZERO;
                d[c % 3] = step;
                let mut pose = truth();
                if c < 3 {
                    pose.rotation = exp_so3(d) * pose.rotation;
                } else {
                    pose.translation += d;
                }
                sampson_with_jacobian(&pose, &ka, &kb, a, b).unwrap().0
            };
            let numeric = (at(h) - at(-h)) / (2.0 * h);
            assert!((numeric - j[c]).abs() < 1e-6 * (1.0 + j[c].abs()), "{c}: {numeric} {}", j[c]);
        }
    }

    #[test]
    fn finds_the_pose_from_a_disturbed_one_under_outliers() {
        let (ka, kb) = cameras();
        let mut rng = ChaCha8Rng::seed_from_u64(6);
        let pairs: Vec<_> = (0..300)
            .map(|i| {
                let a = DVec2::new(rng.random_range(0.0..640.0), rng.random_range(0.0..480.0));
                let b = kb.project(truth().apply(ka.ray(a) * rng.random_range(3.0..9.0)));
                let off = if i % 6 == 0 { 25.0 } else { 0.0 };
                (a, b + DVec2::new(0.0, off))
            })
            .collect();
        let start = Pose::new(
            exp_so3(DVec3::new(0.02, 0.01, -0.02)) * truth().rotation,
            (truth().translation + DVec3::new(0.1, -0.1, 0.1)).normalize(),
        );
        let (pose, cost) = refine_relative(&start, &ka, &kb, &pairs, None, 1.0, 40);
        assert!(cost.is_finite());
        assert!(angle_between(pose.rotation, truth().rotation).to_degrees() < 0.1);
        assert!(pose.translation.angle_between(truth().translation).to_degrees() < 0.5);
        let (still, _) = refine_relative(&start, &ka, &kb, &[], None, 1.0, 10);
        assert_eq!(still, start);
    }
}
