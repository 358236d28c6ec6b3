//! Small vectors and matrices; matrices are rows of rows.

use super::Real;

/// Three components.
pub type Vec3<R> = [R; 3];
/// Three rows of three.
pub type Mat3<R> = [[R; 3]; 3];

/// Converts every component from f64.
pub fn of<R: Real, const N: usize>(v: [f64; N]) -> [R; N] {
    v.map(R::of)
}

/// `a · b`.
pub fn dot<R: Real, const N: usize>(a: [R; N], b: [R; N]) -> R {
    (0..N).map(|k| a[k] * b[k]).sum()
}

/// `a × b`.
pub fn cross<R: Real>(a: Vec3<R>, b: Vec3<R>) -> Vec3<R> {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// `a + b`.
pub fn add<R: Real, const N: usize>(a: [R; N], b: [R; N]) -> [R; N] {
    std::array::from_fn(|k| a[k] + b[k])
}

/// `a − b`.
pub fn sub<R: Real, const N: usize>(a: [R; N], b: [R; N]) -> [R; N] {
    std::array::from_fn(|k| a[k] - b[k])
}

/// `a · s`.
pub fn scale<R: Real, const N: usize>(a: [R; N], s: R) -> [R; N] {
    a.map(|x| x * s)
}

/// The largest magnitude; NaN components are ignored.
pub fn max_abs<R: Real, const N: usize>(a: [R; N]) -> R {
    a.iter().fold(R::zero(), |m, x| m.max(x.abs()))
}

/// Whether every component is finite.
pub fn finite<R: Real, const N: usize>(a: [R; N]) -> bool {
    a.iter().all(|x| x.is_finite())
}

/// The vector's length and direction, without overflow or underflow on the way. `None` for a
/// vector of zeros.
pub fn normalise<R: Real, const N: usize>(a: [R; N]) -> Option<(R, [R; N])> {
    let m = max_abs(a);
    if m == R::zero() {
        return None;
    }
    let b = a.map(|x| x / m);
    let length = dot(b, b).sqrt();
    Some((m * length, b.map(|x| x / length)))
}

/// Gradient with respect to a vector, given that with respect to its direction: `(g − d (d·g)) /
/// length`.
pub fn normalise_backward<R: Real, const N: usize>(
    length: R,
    direction: [R; N],
    gradient: [R; N],
) -> [R; N] {
    let along = dot(direction, gradient);
    std::array::from_fn(|k| (gradient[k] - direction[k] * along) / length)
}

/// `m · v`.
pub fn mul_vec<R: Real>(m: &Mat3<R>, v: Vec3<R>) -> Vec3<R> {
    m.map(|row| dot(row, v))
}

/// `mᵀ · v`.
pub fn tmul_vec<R: Real>(m: &Mat3<R>, v: Vec3<R>) -> Vec3<R> {
    std::array::from_fn(|c| m[0][c] * v[0] + m[1][c] * v[1] + m[2][c] * v[2])
}

/// `a · b`.
pub fn mul<R: Real>(a: &Mat3<R>, b: &Mat3<R>) -> Mat3<R> {
    std::array::from_fn(|r| std::array::from_fn(|c| (0..3).map(|k| a[r][k] * b[k][c]).sum()))
}

/// `mᵀ`.
pub fn transpose<R: Real>(m: &Mat3<R>) -> Mat3<R> {
    std::array::from_fn(|r| std::array::from_fn(|c| m[c][r]))
}

/// The rotation of a unit quaternion (w, x, y, z).
pub fn rotation<R: Real>(q: [R; 4]) -> Mat3<R> {
    let [w, x, y, z] = q;
    let (one, two) = (R::one(), R::of(2.0));
    [
        [one - two * (y * y + z * z), two * (x * y - w * z), two * (x * z + w * y)],
        [two * (x * y + w * z), one - two * (x * x + z * z), two * (y * z - w * x)],
        [two * (x * z - w * y), two * (y * z + w * x), one - two * (x * x + y * y)],
    ]
}

/// Gradient of [`rotation`] with respect to the quaternion's components as independent variables.
pub fn rotation_backward<R: Real>(q: [R; 4], g: &Mat3<R>) -> [R; 4] {
    let [w, x, y, z] = q;
    let two = R::of(2.0);
    let (skew_x, skew_y, skew_z) = (g[2][1] - g[1][2], g[0][2] - g[2][0], g[1][0] - g[0][1]);
    let (xy, xz, yz) = (g[0][1] + g[1][0], g[0][2] + g[2][0], g[1][2] + g[2][1]);
    [
        two * (x * skew_x + y * skew_y + z * skew_z),
        two * (w * skew_x + y * xy + z * xz - two * x * (g[1][1] + g[2][2])),
        two * (w * skew_y + x * xy + z * yz - two * y * (g[0][0] + g[2][2])),
        two * (w * skew_z + x * xz + y * yz - two * z * (g[0][0] + g[1][1])),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rotation_gradient_matches_central_differences() {
        let q = [0.3, -0.7, 0.4, 0.9];
        let weights = [[0.3, -1.0, 0.2], [0.8, 0.1, -0.6], [1.1, -0.4, 0.5]];
        let value = |q: [f64; 4]| {
            let (_, unit) = normalise(q).unwrap();
            let m = rotation(unit);
            (0..3).map(|r| dot(m[r], weights[r])).sum::<f64>()
        };
        let (length, unit) = normalise(q).unwrap();
        let gradient = normalise_backward(length, unit, rotation_backward(unit, &weights));
        for k in 0..4 {
            let at = |h: f64| {
                let mut p = q;
                p[k] += h;
                value(p)
            };
            let numeric = (at(1e-6) - at(-1e-6)) / 2e-6;
            assert!((gradient[k] - numeric).abs() < 1e-8, "{k}: {} {numeric}", gradient[k]);
        }
    }

    #[test]
    fn lengths_survive_extremes() {
        let (length, direction) = normalise([3e30_f32, 4e30, 0.0]).unwrap();
        assert_eq!(length, 5e30);
        assert!((direction[0] - 0.6).abs() < 1e-6);
        let (length, _) = normalise([3e-30_f32, 4e-30, 0.0]).unwrap();
        assert!((length / 5e-30 - 1.0).abs() < 1e-6);
        assert!(normalise([0.0_f32; 4]).is_none());
    }
}
