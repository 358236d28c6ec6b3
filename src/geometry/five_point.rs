//! The five-point relative pose problem.

use super::polynomial::{evaluate, real_roots};
use glam::{DMat3, DVec3};
use nalgebra::{DMatrix, SMatrix};

/// Exponents of x, y, z in elimination order: the first ten monomials are solved for, the last ten hold x,
/// y and 1 times powers of z.
const MONOMIALS: [[u8; 3]; 20] = [
    [3, 0, 0],
    [0, 3, 0],
    [2, 1, 0],
    [1, 2, 0],
    [2, 0, 1],
    [2, 0, 0],
    [0, 2, 1],
    [0, 2, 0],
    [1, 1, 1],
    [1, 1, 0],
    [1, 0, 2],
    [1, 0, 1],
    [1, 0, 0],
    [0, 1, 2],
    [0, 1, 1],
    [0, 1, 0],
    [0, 0, 3],
    [0, 0, 2],
    [0, 0, 1],
    [0, 0, 0],
];

/// A polynomial in x, y, z of degree at most 3.
type Cubic = [f64; 20];
const X: usize = 12;
const Y: usize = 15;
const Z: usize = 18;
const ONE: usize = 19;

/// Index of the product of two monomials; 255 where its degree exceeds 3.
const PRODUCT: [[u8; 20]; 20] = {
    let mut table = [[255u8; 20]; 20];
    let mut i = 0;
    while i < 20 {
        let mut j = 0;
        while j < 20 {
            let mut k = 0;
            while k < 20 {
                let (a, b, c) = (MONOMIALS[i], MONOMIALS[j], MONOMIALS[k]);
                if a[0] + b[0] == c[0] && a[1] + b[1] == c[1] && a[2] + b[2] == c[2] {
                    table[i][j] = k as u8;
                }
                k += 1;
            }
            j += 1;
        }
        i += 1;
    }
    table
};

/// sum += factor · a · b, for the terms of degree at most 3.
fn multiply_add(sum: &mut Cubic, a: &Cubic, b: &Cubic, factor: f64) {
    for (i, x) in a.iter().enumerate().filter(|(_, x)| **x != 0.0) {
        for (j, y) in b.iter().enumerate() {
            let k = PRODUCT[i][j];
            if k != 255 {
                sum[k as usize] += factor * x * y;
            }
        }
    }
}

fn product(a: &Cubic, b: &Cubic) -> Cubic {
    let mut out = [0.0; 20];
    multiply_add(&mut out, a, b, 1.0);
    out
}

/// All essential matrices (at most ten, Frobenius norm 1) that satisfy five ray pairs; with more pairs,
/// those that satisfy all best in the algebraic sense.
///
/// Nistér, PAMI 2004: E lies in the four-dimensional null space of the epipolar constraints; the ten cubic
/// constraints on an essential matrix are eliminated to a polynomial of degree ten. Empty for fewer than
/// five pairs and for non-finite values.
pub fn five_point(rays: &[(DVec3, DVec3)]) -> Vec<DMat3> {
    if rays.len() < 5 || rays.iter().any(|(a, b)| !(a.is_finite() && b.is_finite())) {
        return Vec::new();
    }
    let Some(basis) = null_space(rays) else { return Vec::new() };
    // E = x X + y Y + z Z + W, entry by entry.
    let entry = |r: usize, c: usize| -> Cubic {
        let mut p = [0.0; 20];
        for (k, monomial) in [X, Y, Z, ONE].into_iter().enumerate() {
            p[monomial] = basis[k][3 * r + c];
        }
        p
    };
    let e: [[Cubic; 3]; 3] = std::array::from_fn(|r| std::array::from_fn(|c| entry(r, c)));
    let Some(m) = eliminated(&constraints(&e)) else { return Vec::new() };
    // Row pairs (4,5), (6,7), (8,9) give three equations linear in x and y, polynomial in z.
    let rows: [[Vec<f64>; 3]; 3] =
        std::array::from_fn(|k| difference(&m[4 + 2 * k], &m[5 + 2 * k]));
    let mut determinant = vec![0.0; 11];
    for (a, b, c, sign) in [
        (0, 1, 2, 1.0),
        (1, 2, 0, 1.0),
        (2, 0, 1, 1.0),
        (0, 2, 1, -1.0),
        (1, 0, 2, -1.0),
        (2, 1, 0, -1.0),
    ] {
        let p = convolve(&convolve(&rows[0][a], &rows[1][b]), &rows[2][c]);
        p.iter().enumerate().for_each(|(k, v)| determinant[k] += sign * v);
    }
    let mut found = Vec::new();
    for z in real_roots(&determinant) {
        let at: [DVec3; 3] = std::array::from_fn(|k| {
            DVec3::from_array(std::array::from_fn(|c| evaluate(&rows[k][c], z)))
        });
        // (x, y, 1) is orthogonal to all three rows; the largest cross product is the most accurate one.
        let best = [(0, 1), (0, 2), (1, 2)]
            .map(|(i, j)| at[i].normalize_or_zero().cross(at[j].normalize_or_zero()))
            .into_iter()
            .max_by(|a, b| a.length_squared().total_cmp(&b.length_squared()))
            .unwrap_or(DVec3::ZERO);
        if best.z.abs() <= 1e-12 * best.length() || best == DVec3::ZERO {
            continue;
        }
        let (x, y) = (best.x / best.z, best.y / best.z);
        let v: [f64; 9] = std::array::from_fn(|i| {
            x * basis[0][i] + y * basis[1][i] + z * basis[2][i] + basis[3][i]
        });
        let norm = v.iter().map(|c| c * c).sum::<f64>().sqrt();
        if norm.is_finite() && norm > 0.0 {
            found.push(DMat3::from_cols_array(&v).transpose() * (1.0 / norm));
        }
    }
    found
}

/// Four row-major matrices that span the null space of the epipolar constraints.
fn null_space(rays: &[(DVec3, DVec3)]) -> Option<[[f64; 9]; 4]> {
    let mut rows = DMatrix::<f64>::zeros(rays.len().max(9), 9);
    for (i, (a, b)) in rays.iter().enumerate() {
        let (a, b) = (a.normalize_or_zero(), b.normalize_or_zero());
        for r in 0..3 {
            for c in 0..3 {
                rows[(i, 3 * r + c)] = b[r] * a[c];
            }
        }
    }
    let vt = rows.svd(false, true).v_t?;
    Some(std::array::from_fn(|k| std::array::from_fn(|c| vt[(5 + k, c)])))
}

/// det E = 0 and 2 E Eᵀ E − tr(E Eᵀ) E = 0, as ten rows of coefficients.
fn constraints(e: &[[Cubic; 3]; 3]) -> [Cubic; 10] {
    let mut out = [[0.0; 20]; 10];
    // E Eᵀ − ½ tr(E Eᵀ) I.
    let mut gram = [[[0.0; 20]; 3]; 3];
    for r in 0..3 {
        for c in 0..3 {
            for k in 0..3 {
                multiply_add(&mut gram[r][c], &e[r][k], &e[c][k], 1.0);
            }
        }
    }
    let half_trace: Cubic =
        std::array::from_fn(|i| 0.5 * (gram[0][0][i] + gram[1][1][i] + gram[2][2][i]));
    for k in 0..3 {
        (0..20).for_each(|i| gram[k][k][i] -= half_trace[i]);
    }
    for r in 0..3 {
        for c in 0..3 {
            for k in 0..3 {
                multiply_add(&mut out[3 * r + c], &gram[r][k], &e[k][c], 1.0);
            }
        }
    }
    for k in 0..3 {
        let (i, j) = ((k + 1) % 3, (k + 2) % 3);
        let mut minor = product(&e[1][i], &e[2][j]);
        multiply_add(&mut minor, &e[1][j], &e[2][i], -1.0);
        multiply_add(&mut out[9], &e[0][k], &minor, 1.0);
    }
    out
}

/// Gauss–Jordan elimination on the first ten columns, so that row k then starts with monomial k alone.
fn eliminated(rows: &[Cubic; 10]) -> Option<[Cubic; 10]> {
    let left = SMatrix::<f64, 10, 10>::from_fn(|r, c| rows[r][c]);
    let right = SMatrix::<f64, 10, 10>::from_fn(|r, c| rows[r][10 + c]);
    let solved = left.full_piv_lu().solve(&right)?;
    if solved.iter().any(|v| !v.is_finite()) {
        return None;
    }
    Some(std::array::from_fn(|r| {
        std::array::from_fn(
            |c| if c < 10 { f64::from(u8::from(c == r)) } else { solved[(r, c - 10)] },
        )
    }))
}

/// `e − z f`, where the leading monomials of the two rows differ by the factor z: the polynomials in z that
/// multiply x, y and 1.
fn difference(e: &Cubic, f: &Cubic) -> [Vec<f64>; 3] {
    let linear = |at: usize| vec![e[at + 2], e[at + 1] - f[at + 2], e[at] - f[at + 1], -f[at]];
    let constant = vec![e[19], e[18] - f[19], e[17] - f[18], e[16] - f[17], -f[16]];
    [linear(10), linear(13), constant]
}

fn convolve(a: &[f64], b: &[f64]) -> Vec<f64> {
    let mut out = vec![0.0; a.len() + b.len() - 1];
    for (i, x) in a.iter().enumerate() {
        for (j, y) in b.iter().enumerate() {
            out[i + j] += x * y;
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::epipolar::essential_from_pose;
    use crate::geometry::se3::exp_so3;
    use crate::types::Pose;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// Distance between two matrices of the same norm, up to sign.
    fn apart(a: &DMat3, b: &DMat3) -> f64 {
        let norm = |m: DMat3| m.to_cols_array().iter().map(|v| v * v).sum::<f64>().sqrt();
        norm(*a - *b).min(norm(*a + *b))
    }

    #[test]
    fn the_true_matrix_is_found_and_all_found_are_essential() {
        let mut rng = ChaCha8Rng::seed_from_u64(8);
        let random = |rng: &mut ChaCha8Rng| {
            DVec3::from_array(std::array::from_fn(|_| rng.random_range(-1.0..1.0)))
        };
        let (mut missed, trials) = (0, 1000);
        for trial in 0..trials {
            let t = random(&mut rng).normalize();
            let pose = Pose::new(exp_so3(random(&mut rng) * 0.5), t);
            // Every other scene is a plane, for which five points still suffice.
            let rays: Vec<_> = (0..5)
                .map(|_| {
                    let mut p = random(&mut rng) * 2.0;
                    p.z = if trial % 2 == 0 { p.z + 5.0 } else { 5.0 + 0.3 * p.x };
                    (p / p.z, pose.apply(p))
                })
                .collect();
            let found = five_point(&rays);
            assert!(found.len() <= 10);
            for e in &found {
                for (a, b) in &rays {
                    assert!(b.normalize().dot(*e * a.normalize()).abs() < 1e-6);
                }
            }
            let truth = essential_from_pose(&pose) * std::f64::consts::FRAC_1_SQRT_2;
            let best = found.iter().map(|e| apart(e, &truth)).fold(f64::INFINITY, f64::min);
            missed += usize::from(best > 1e-4);
        }
        assert!(missed <= trials / 100, "missed {missed} of {trials}");
    }

    #[test]
    fn nonsense_gives_no_matrix_or_a_finite_one() {
        assert!(five_point(&[(DVec3::Z, DVec3::Z); 4]).is_empty());
        assert!(five_point(&[(DVec3::NAN, DVec3::Z); 5]).is_empty());
        for rays in [[(DVec3::Z, DVec3::Z); 5], [(DVec3::ZERO, DVec3::ZERO); 5]] {
            assert!(five_point(&rays).iter().all(|e| e.is_finite()));
        }
    }
}
