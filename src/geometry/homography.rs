//! Homographies of planes and of rotating cameras.

use super::epipolar::{normalised, null_vector};
use glam::{DMat3, DVec2};
use nalgebra::SMatrix;

/// The homography x_b ~ H x_a of at least four pixel pairs: normalised direct linear transform, scaled to
/// determinant ±1 where that is defined. `weights` are per pair.
///
/// `None` for fewer than four pairs, a degenerate set, or non-finite values.
pub fn homography(pairs: &[(DVec2, DVec2)], weights: Option<&[f64]>) -> Option<DMat3> {
    if pairs.len() < 4 || weights.is_some_and(|w| w.len() != pairs.len()) {
        return None;
    }
    let (a, ta) = normalised(pairs.iter().map(|p| p.0));
    let (b, tb) = normalised(pairs.iter().map(|p| p.1));
    let mut normal = SMatrix::<f64, 9, 9>::zeros();
    for i in 0..pairs.len() {
        let (p, q) = (a[i], b[i]);
        let w = weights.map_or(1.0, |w| w[i]);
        for row in [
            [p.x, p.y, 1.0, 0.0, 0.0, 0.0, -q.x * p.x, -q.x * p.y, -q.x],
            [0.0, 0.0, 0.0, p.x, p.y, 1.0, -q.y * p.x, -q.y * p.y, -q.y],
        ] {
            let row = SMatrix::<f64, 9, 1>::from(row);
            normal += row * row.transpose() * w;
        }
    }
    let (vector, gap) = null_vector(normal)?;
    // With three of four points collinear, or fewer than four distinct points, a family of homographies
    // fits. The bound covers the rounding error of a zero eigenvalue.
    if gap.is_nan() || gap < 1e-13 {
        return None;
    }
    let h = tb.inverse() * DMat3::from_cols_array(&vector).transpose() * ta;
    let determinant = h.determinant();
    let size = h.to_cols_array().iter().fold(0.0f64, |m, v| m.max(v.abs()));
    if !h.is_finite() || determinant.abs() <= 1e-14 * size.powi(3) {
        return None;
    }
    Some(h * determinant.abs().cbrt().recip())
}

/// The mean of the squared transfer errors in both images, pixels²; infinite where the homography maps a
/// pixel to infinity.
pub fn transfer_squared(h: &DMat3, inverse: &DMat3, a: DVec2, b: DVec2) -> f64 {
    let there = *h * a.extend(1.0);
    let back = *inverse * b.extend(1.0);
    if there.z.abs() < 1e-12 || back.z.abs() < 1e-12 {
        return f64::INFINITY;
    }
    0.5 * ((there.truncate() / there.z - b).length_squared()
        + (back.truncate() / back.z - a).length_squared())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn truth() -> DMat3 {
        DMat3::from_cols_array(&[1.1, 0.05, 1e-4, -0.1, 0.95, -5e-5, 20.0, -10.0, 1.0])
    }

    #[test]
    fn recovers_a_homography_from_four_and_from_many() {
        let h = truth();
        let pairs: Vec<_> = (0..20)
            .map(|i| {
                let a = DVec2::new(
                    ((i * i * 97 + 13) % 640) as f64,
                    ((i * 151 + i * i * 71) % 480) as f64,
                );
                let p = h * a.extend(1.0);
                (a, p.truncate() / p.z)
            })
            .collect();
        for n in [4, 20] {
            let found = homography(&pairs[..n], None).unwrap();
            let inverse = found.inverse();
            for &(a, b) in &pairs {
                assert!(transfer_squared(&found, &inverse, a, b) < 1e-8);
            }
        }
        assert!(homography(&pairs[..3], None).is_none());
    }

    #[test]
    fn collinear_or_equal_pairs_give_none() {
        let line: Vec<_> =
            (0..10).map(|i| (DVec2::splat(i as f64), DVec2::splat(2.0 * i as f64))).collect();
        assert!(homography(&line, None).is_none());
        assert!(homography(&[(DVec2::ONE, DVec2::ONE); 6], None).is_none());
        assert!(homography(&[(DVec2::NAN, DVec2::ONE); 6], None).is_none());
    }
}
