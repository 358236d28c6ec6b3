//! Quaternions (w, x, y, z) and 3-vectors over any [`Real`], with the derivatives that the twins
//! of deformation and density control need.

use super::Real;

/// Quaternions whose largest component does not lie within 1e-18 and 1e18 act as "no rotation", as
/// everywhere on the device: f32 hardware may flush or overflow what lies outside.
const QUATERNION_RANGE: [f64; 2] = [1e-18, 1e18];

pub(crate) fn sub<R: Real>(a: [R; 3], b: [R; 3]) -> [R; 3] {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

pub(crate) fn add<R: Real>(a: [R; 3], b: [R; 3]) -> [R; 3] {
    [a[0] + b[0], a[1] + b[1], a[2] + b[2]]
}

pub(crate) fn scale<R: Real>(a: [R; 3], s: R) -> [R; 3] {
    [a[0] * s, a[1] * s, a[2] * s]
}

pub(crate) fn dot<R: Real, const N: usize>(a: [R; N], b: [R; N]) -> R {
    a.iter().zip(b).map(|(&x, y)| x * y).sum()
}

/// The identity quaternion.
pub fn identity<R: Real>() -> [R; 4] {
    [R::one(), R::zero(), R::zero(), R::zero()]
}

/// The unit quaternion along `q` and the norm of `q`; `None` if a component of `q` is NaN or the
/// largest does not lie within 1e-18 and 1e18.
pub fn unit<R: Real>(q: [R; 4]) -> Option<([R; 4], R)> {
    let largest = q.iter().fold(R::zero(), |m, c| m.max(c.abs()));
    let [low, high] = QUATERNION_RANGE.map(R::of);
    if q.iter().any(|c| c.is_nan()) || largest <= low || largest > high {
        return None;
    }
    // Squares of the raw components could under- or overflow.
    let scaled = q.map(|c| c / largest);
    let norm = dot(scaled, scaled).sqrt();
    Some((scaled.map(|c| c / norm), norm * largest))
}

/// The gradient at `q` of a loss whose gradient at `unit(q)` is `gradient`; zero where `q` has no
/// direction.
pub fn unit_backward<R: Real>(q: [R; 4], gradient: [R; 4]) -> [R; 4] {
    match unit(q) {
        None => [R::zero(); 4],
        Some((u, norm)) => {
            let along = dot(u, gradient);
            std::array::from_fn(|c| (gradient[c] - u[c] * along) / norm)
        }
    }
}

/// The Hamilton product: first `b`, then `a`.
pub fn multiply<R: Real>(a: [R; 4], b: [R; 4]) -> [R; 4] {
    [
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    ]
}

/// The inverse of a unit quaternion.
pub fn conjugate<R: Real>(q: [R; 4]) -> [R; 4] {
    [q[0], -q[1], -q[2], -q[3]]
}

/// The rotation matrix, by rows, of a unit quaternion.
pub fn matrix<R: Real>([w, x, y, z]: [R; 4]) -> [[R; 3]; 3] {
    let (one, two) = (R::one(), R::of(2.0));
    [
        [one - two * (y * y + z * z), two * (x * y - w * z), two * (x * z + w * y)],
        [two * (x * y + w * z), one - two * (x * x + z * z), two * (y * z - w * x)],
        [two * (x * z - w * y), two * (y * z + w * x), one - two * (x * x + y * y)],
    ]
}

/// A matrix, by rows, times a vector.
pub fn apply<R: Real>(m: [[R; 3]; 3], v: [R; 3]) -> [R; 3] {
    m.map(|row| dot(row, v))
}

/// The transpose of a matrix.
pub fn transpose<R: Real>(m: [[R; 3]; 3]) -> [[R; 3]; 3] {
    std::array::from_fn(|r| std::array::from_fn(|c| m[c][r]))
}

/// The gradient at the four components of `matrix(q)·v`, seen as a polynomial in `q`, for a loss
/// whose gradient at the product is `gradient`.
pub fn apply_backward<R: Real>(q: [R; 4], v: [R; 3], gradient: [R; 3]) -> [R; 4] {
    let [w, x, y, z] = q;
    let two = R::of(2.0);
    let zero = R::zero();
    // ∂(matrix)/∂component / 2, by rows.
    let by_w = [[zero, -z, y], [z, zero, -x], [-y, x, zero]];
    let by_x = [[zero, y, z], [y, -two * x, -w], [z, w, -two * x]];
    let by_y = [[-two * y, x, w], [x, zero, z], [-w, z, -two * y]];
    let by_z = [[-two * z, -w, x], [w, -two * z, y], [x, y, zero]];
    [by_w, by_x, by_y, by_z].map(|m| two * dot(apply(m, v), gradient))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn derivatives_agree_with_central_differences() {
        let (q, v, g) = ([0.7, -0.3, 0.5, 0.2], [1.0, -2.0, 0.5], [0.3, 0.9, -0.4]);
        let loss = |q: [f64; 4]| dot(apply(matrix(unit(q).unwrap().0), v), g);
        let (u, _) = unit(q).unwrap();
        let analytic = unit_backward(q, apply_backward(u, v, g));
        for c in 0..4 {
            let h = 1e-6;
            let (mut up, mut down) = (q, q);
            up[c] += h;
            down[c] -= h;
            let numeric = (loss(up) - loss(down)) / (2.0 * h);
            assert!((numeric - analytic[c]).abs() < 1e-8, "{c}: {numeric} {}", analytic[c]);
        }
    }

    #[test]
    fn the_matrix_of_a_product_is_the_product_of_the_matrices() {
        let a = unit([0.7f64, -0.3, 0.5, 0.2]).unwrap().0;
        let b = unit([-0.1f64, 0.8, 0.5, 0.9]).unwrap().0;
        let v = [1.0, -2.0, 0.5];
        let (left, right) =
            (apply(matrix(multiply(a, b)), v), apply(matrix(a), apply(matrix(b), v)));
        for c in 0..3 {
            assert!((left[c] - right[c]).abs() < 1e-14);
        }
    }

    #[test]
    fn quaternions_without_a_direction_have_no_unit() {
        for q in [
            [0.0; 4],
            [f32::NAN, 1.0, 0.0, 0.0],
            [f32::INFINITY, 0.0, 0.0, 0.0],
            [1e-19; 4],
            [1e19; 4],
        ] {
            assert!(unit(q).is_none(), "{q:?}");
            assert_eq!(unit_backward(q, [1.0; 4]), [0.0; 4]);
        }
        for q in [[1e-17f32, 0.0, 0.0, 0.0], [1e17, -1e17, 1e17, 1e17]] {
            let (u, _) = unit(q).unwrap();
            assert!((dot(u, u) - 1.0).abs() < 1e-6);
        }
    }
}
