//! Fundamental and essential matrices.
//!
//! Both matrices relate pixel pairs by x_bᵀ F x_a = 0; the essential matrix relates rays of calibrated
//! cameras, with `E = [t]× R` for `b_from_a = (R, t)`.

use super::se3::matrix3;
use crate::types::{Intrinsics, Pose};
use glam::{DMat3, DQuat, DVec2, DVec3};
use nalgebra::SMatrix;

/// Normalises pixels so that their centroid is the origin and their mean distance from it √2 (Hartley, PAMI
/// 1997); also returns the transform.
pub(crate) fn normalised(pixels: impl Iterator<Item = DVec2> + Clone) -> (Vec<DVec2>, DMat3) {
    let count = pixels.clone().count().max(1) as f64;
    let mean = pixels.clone().sum::<DVec2>() / count;
    let distance = pixels.clone().map(|p| (p - mean).length()).sum::<f64>() / count;
    let scale = if distance > 1e-12 { std::f64::consts::SQRT_2 / distance } else { 1.0 };
    let matrix = DMat3::from_cols(
        DVec3::new(scale, 0.0, 0.0),
        DVec3::new(0.0, scale, 0.0),
        DVec3::new(-scale * mean.x, -scale * mean.y, 1.0),
    );
    (pixels.map(|p| (p - mean) * scale).collect(), matrix)
}

/// The unit vector that a sum of outer products (the normal matrix of a homogeneous system) maps closest to
/// zero, and a measure of its uniqueness: the second smallest eigenvalue over the largest.
pub(crate) fn null_vector<const N: usize>(normal: SMatrix<f64, N, N>) -> Option<([f64; N], f64)> {
    if normal.iter().any(|v| !v.is_finite()) {
        return None;
    }
    let svd = nalgebra::DMatrix::from_column_slice(N, N, normal.as_slice()).svd(false, true);
    let gap = svd.singular_values[N - 2] / svd.singular_values[0];
    let row = svd.v_t?.row(N - 1).clone_owned();
    Some((std::array::from_fn(|k| row[k]), gap))
}

fn row_major(v: &[f64]) -> DMat3 {
    DMat3::from_cols(
        DVec3::new(v[0], v[3], v[6]),
        DVec3::new(v[1], v[4], v[7]),
        DVec3::new(v[2], v[5], v[8]),
    )
}

/// A matrix with its singular values replaced by those that `change` returns.
fn with_singular_values(m: &DMat3, change: impl Fn(f64, f64, f64) -> [f64; 3]) -> Option<DMat3> {
    if !m.is_finite() {
        return None;
    }
    let mut svd = matrix3(m).svd(true, true);
    let s = svd.singular_values;
    svd.singular_values = change(s[0], s[1], s[2]).into();
    let fixed = svd.recompose().ok()?;
    Some(DMat3::from_cols_slice(fixed.as_slice()))
}

/// The fundamental matrix of at least eight pixel pairs: normalised eight-point algorithm with rank 2
/// enforced, Frobenius norm 1. `weights` are per pair.
///
/// `None` for fewer than eight pairs, or for non-finite values.
pub fn eight_point(pairs: &[(DVec2, DVec2)], weights: Option<&[f64]>) -> Option<DMat3> {
    if pairs.len() < 8 || weights.is_some_and(|w| w.len() != pairs.len()) {
        return None;
    }
    let (a, ta) = normalised(pairs.iter().map(|p| p.0));
    let (b, tb) = normalised(pairs.iter().map(|p| p.1));
    let mut normal = SMatrix::<f64, 9, 9>::zeros();
    for i in 0..pairs.len() {
        let (p, q) = (a[i], b[i]);
        let row = SMatrix::<f64, 9, 1>::from([
            q.x * p.x,
            q.x * p.y,
            q.x,
            q.y * p.x,
            q.y * p.y,
            q.y,
            p.x,
            p.y,
            1.0,
        ]);
        normal += row * row.transpose() * weights.map_or(1.0, |w| w[i]);
    }
    let f = with_singular_values(&row_major(&null_vector(normal)?.0), |x, y, _| [x, y, 0.0])?;
    let f = tb.transpose() * f * ta;
    let norm = f.to_cols_array().iter().map(|v| v * v).sum::<f64>().sqrt();
    (norm > 0.0 && norm.is_finite()).then(|| f * (1.0 / norm))
}

/// The squared Sampson distance of a pixel pair to a fundamental matrix, pixels²: first-order squared
/// distance in the four-dimensional space of both pixels.
pub fn sampson_squared(f: &DMat3, a: DVec2, b: DVec2) -> f64 {
    let (xa, xb) = (a.extend(1.0), b.extend(1.0));
    let (lb, la) = (*f * xa, f.transpose() * xb);
    let gradient = lb.x * lb.x + lb.y * lb.y + la.x * la.x + la.y * la.y;
    let value = xb.dot(lb);
    if gradient > 0.0 { value * value / gradient } else { f64::INFINITY }
}

/// `E = [t]× R`.
pub fn essential_from_pose(b_from_a: &Pose) -> DMat3 {
    super::se3::skew(b_from_a.translation) * b_from_a.rotation_matrix()
}

/// F = K_b⁻ᵀ E K_a⁻¹, which relates pixels instead of rays.
pub fn fundamental_from_essential(e: &DMat3, ka: &Intrinsics, kb: &Intrinsics) -> DMat3 {
    inverse_matrix(kb).transpose() * *e * inverse_matrix(ka)
}

/// E = K_bᵀ F K_a.
pub fn essential_from_fundamental(f: &DMat3, ka: &Intrinsics, kb: &Intrinsics) -> DMat3 {
    inverse_matrix(kb).inverse().transpose() * *f * inverse_matrix(ka).inverse()
}

fn inverse_matrix(k: &Intrinsics) -> DMat3 {
    DMat3::from_cols(
        DVec3::new(1.0 / k.fx, 0.0, 0.0),
        DVec3::new(0.0, 1.0 / k.fy, 0.0),
        DVec3::new(-k.cx / k.fx, -k.cy / k.fy, 1.0),
    )
}

/// The four poses `b_from_a` (unit translation) of an essential matrix; a matrix that is only approximately
/// essential is projected to the nearest one. Empty where it is zero or not finite.
pub fn decompose_essential(e: &DMat3) -> Vec<Pose> {
    if !e.is_finite() {
        return Vec::new();
    }
    let svd = matrix3(e).svd(true, true);
    let (Some(u), Some(vt)) = (svd.u, svd.v_t) else { return Vec::new() };
    if svd.singular_values[1] <= 1e-12 * svd.singular_values[0] || svd.singular_values[0] <= 0.0 {
        return Vec::new();
    }
    let column = |k: usize| DVec3::new(u[(0, k)], u[(1, k)], u[(2, k)]);
    let row = |k: usize| DVec3::new(vt[(k, 0)], vt[(k, 1)], vt[(k, 2)]);
    let (u0, u1, v0, v1) = (column(0), column(1), row(0), row(1));
    // Right-handed bases on both sides, whatever the signs of the SVD.
    let (u2, v2) = (u0.cross(u1), v0.cross(v1));
    let right = DMat3::from_cols(v0, v1, v2).transpose();
    let mut poses = Vec::with_capacity(4);
    // R = U W Vᵀ and U Wᵀ Vᵀ with W a quarter turn about z; t is the left null vector.
    for left in [DMat3::from_cols(u1, -u0, u2), DMat3::from_cols(-u1, u0, u2)] {
        let rotation = DQuat::from_mat3(&(left * right)).normalize();
        for translation in [u2, -u2] {
            poses.push(Pose { rotation, translation });
        }
    }
    poses
}

/// The pose of an essential matrix that puts most ray pairs in front of both cameras, and the number of
/// those pairs. Nearly parallel rays are undetermined and do not count.
pub fn cheiral_pose(e: &DMat3, rays: &[(DVec3, DVec3)]) -> Option<(Pose, usize)> {
    decompose_essential(e)
        .into_iter()
        .map(|pose| {
            let count = rays.iter().filter(|(a, b)| in_front(&pose, *a, *b)).count();
            (pose, count)
        })
        .max_by_key(|(_, count)| *count)
}

/// Whether two rays meet (nearly) in front of both cameras.
pub fn in_front(b_from_a: &Pose, ray_a: DVec3, ray_b: DVec3) -> bool {
    // λ_b ray_b = λ_a R ray_a + t in the least-squares sense.
    let turned = b_from_a.rotation * ray_a;
    let cross = ray_b.cross(turned);
    let squared = cross.length_squared();
    if squared <= 1e-14 * ray_b.length_squared() * turned.length_squared() {
        return false;
    }
    let depth_a = -ray_b.cross(b_from_a.translation).dot(cross);
    let depth_b = turned.cross(b_from_a.translation).dot(-cross);
    depth_a > 0.0 && depth_b > 0.0
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::se3::{angle_between, exp_so3};
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    fn pairs(n: usize, pose: &Pose, k: &Intrinsics) -> Vec<(DVec2, DVec2)> {
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        let mut out = Vec::new();
        while out.len() < n {
            let pixel = DVec2::new(rng.random_range(0.0..640.0), rng.random_range(0.0..480.0));
            let p = pose.apply(k.ray(pixel) * rng.random_range(2.0..9.0));
            if p.z > 0.2 {
                out.push((pixel, k.project(p)));
            }
        }
        out
    }

    fn truth() -> Pose {
        Pose::new(exp_so3(DVec3::new(0.05, -0.1, 0.2)), DVec3::new(0.6, 0.1, -0.3).normalize())
    }

    #[test]
    fn eight_points_give_the_fundamental_matrix_and_its_pose() {
        let k = Intrinsics { fx: 500.0, fy: 480.0, cx: 310.0, cy: 250.0, width: 640, height: 480 };
        let pairs = pairs(30, &truth(), &k);
        for n in [8, 30] {
            let f = eight_point(&pairs[..n], None).unwrap();
            assert!(f.determinant().abs() < 1e-12);
            assert!(pairs.iter().all(|&(a, b)| sampson_squared(&f, a, b) < 1e-10));
            let rays: Vec<_> = pairs.iter().map(|&(a, b)| (k.ray(a), k.ray(b))).collect();
            let e = essential_from_fundamental(&f, &k, &k);
            let (pose, count) = cheiral_pose(&e, &rays).unwrap();
            assert_eq!(count, 30);
            assert!(angle_between(pose.rotation, truth().rotation) < 1e-6);
            assert!((pose.translation - truth().translation).length() < 1e-6);
        }
        assert!(eight_point(&pairs[..7], None).is_none());
    }

    #[test]
    fn sampson_distance_is_the_pixel_distance_to_first_order() {
        // A camera that moves sideways: epipolar lines are rows, so the row difference d is shared by both
        // pixels and the squared distance is d²/2.
        let k = Intrinsics::centred(400.0, 640, 480);
        let slide = Pose::new(DQuat::IDENTITY, DVec3::X);
        let f = fundamental_from_essential(&essential_from_pose(&slide), &k, &k);
        let d2 = sampson_squared(&f, DVec2::new(100.0, 50.0), DVec2::new(80.0, 53.0));
        assert!((d2 - 4.5).abs() < 1e-9, "{d2}");
    }

    #[test]
    fn the_true_pose_is_among_the_four() {
        for pose in [truth(), Pose::new(DQuat::IDENTITY, DVec3::Z)] {
            let four = decompose_essential(&(essential_from_pose(&pose) * -3.0));
            assert_eq!(four.len(), 4);
            assert!(four.iter().any(|p| {
                angle_between(p.rotation, pose.rotation) < 1e-7
                    && (p.translation - pose.translation).length() < 1e-9
            }));
        }
        assert!(decompose_essential(&DMat3::ZERO).is_empty());
        assert!(decompose_essential(&DMat3::from_cols(DVec3::NAN, DVec3::X, DVec3::Y)).is_empty());
    }

    #[test]
    fn degenerate_pairs_do_not_panic() {
        let same = vec![(DVec2::ONE, DVec2::ONE); 12];
        if let Some(f) = eight_point(&same, None) {
            assert!(f.is_finite());
        }
        assert!(eight_point(&[(DVec2::NAN, DVec2::ONE); 9], None).is_none());
    }
}
