//! Real spherical harmonics up to degree 3, in the order and with the signs of 3DGS.

use super::Real;
use super::linear::{Vec3, of};

/// Coefficients of the harmonics' polynomials, band by band (Green, "Spherical Harmonic Lighting").
const SH0: f64 = 0.282_094_791_773_878_14;
const SH1: f64 = 0.488_602_511_902_919_9;
const SH2: [f64; 5] = [
    1.092_548_430_592_079_2,
    -1.092_548_430_592_079_2,
    0.315_391_565_252_520_05,
    -1.092_548_430_592_079_2,
    0.546_274_215_296_039_6,
];
const SH3: [f64; 7] = [
    -0.590_043_589_926_643_5,
    2.890_611_442_640_554,
    -0.457_045_799_464_465_8,
    0.373_176_332_590_115_4,
    -0.457_045_799_464_465_8,
    1.445_305_721_320_277,
    -0.590_043_589_926_643_5,
];

/// Values of the 16 harmonics at a unit direction.
pub fn basis<R: Real>(direction: Vec3<R>) -> [R; 16] {
    let [x, y, z] = direction;
    let c1 = R::of(SH1);
    let c2: [R; 5] = of(SH2);
    let c3: [R; 7] = of(SH3);
    let (two, three, four) = (R::of(2.0), R::of(3.0), R::of(4.0));
    let (xx, yy, zz) = (x * x, y * y, z * z);
    [
        R::of(SH0),
        -c1 * y,
        c1 * z,
        -c1 * x,
        c2[0] * x * y,
        c2[1] * y * z,
        c2[2] * (two * zz - xx - yy),
        c2[3] * x * z,
        c2[4] * (xx - yy),
        c3[0] * y * (three * xx - yy),
        c3[1] * x * y * z,
        c3[2] * y * (four * zz - xx - yy),
        c3[3] * z * (two * zz - three * xx - three * yy),
        c3[4] * x * (four * zz - xx - yy),
        c3[5] * z * (xx - yy),
        c3[6] * x * (xx - three * yy),
    ]
}

/// Derivatives of [`basis`] with respect to x, y and z as independent variables.
pub fn basis_gradient<R: Real>(direction: Vec3<R>) -> [Vec3<R>; 16] {
    let [x, y, z] = direction;
    let o = R::zero();
    let c1 = R::of(SH1);
    let c2: [R; 5] = of(SH2);
    let c3: [R; 7] = of(SH3);
    let [two, three, four, six, eight]: [R; 5] = of([2.0, 3.0, 4.0, 6.0, 8.0]);
    let (xx, yy, zz) = (x * x, y * y, z * z);
    let times = |c: R, g: Vec3<R>| g.map(|v| c * v);
    [
        [o; 3],
        [o, -c1, o],
        [o, o, c1],
        [-c1, o, o],
        times(c2[0], [y, x, o]),
        times(c2[1], [o, z, y]),
        times(c2[2], [-two * x, -two * y, four * z]),
        times(c2[3], [z, o, x]),
        times(c2[4], [two * x, -two * y, o]),
        times(c3[0], [six * x * y, three * (xx - yy), o]),
        times(c3[1], [y * z, x * z, x * y]),
        times(c3[2], [-two * x * y, four * zz - xx - three * yy, eight * y * z]),
        times(c3[3], [-six * x * z, -six * y * z, six * zz - three * xx - three * yy]),
        times(c3[4], [four * zz - three * xx - yy, -two * x * y, eight * x * z]),
        times(c3[5], [two * x * z, -two * y * z, xx - yy]),
        times(c3[6], [three * (xx - yy), -six * x * y, o]),
    ]
}

/// Colour seen along a unit direction, before the clamp at 0: `0.5 + Σ coefficient · basis`.
/// `coefficients` holds `(degree + 1)²` RGB rows.
pub fn colour<R: Real>(coefficients: &[Vec3<R>], direction: Vec3<R>) -> Vec3<R> {
    let basis = basis(direction);
    std::array::from_fn(|channel| {
        R::of(0.5) + coefficients.iter().zip(basis).map(|(c, b)| c[channel] * b).sum::<R>()
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gradient_matches_central_differences() {
        let direction = [0.36_f64, -0.48, 0.8];
        let gradient = basis_gradient(direction);
        for axis in 0..3 {
            let at = |h: f64| {
                let mut d = direction;
                d[axis] += h;
                basis(d)
            };
            let (above, below) = (at(1e-6), at(-1e-6));
            for k in 0..16 {
                let numeric = (above[k] - below[k]) / 2e-6;
                assert!((gradient[k][axis] - numeric).abs() < 1e-8, "harmonic {k} axis {axis}");
            }
        }
    }

    /// ∫ Yᵢ Yⱼ over the sphere is 1 for i = j, else 0.
    #[test]
    fn harmonics_are_orthonormal() {
        const RINGS: usize = 64;
        let mut gram = [[0.0; 16]; 16];
        for ring in 0..RINGS {
            let z = -1.0 + (ring as f64 + 0.5) * 2.0 / RINGS as f64;
            for step in 0..RINGS {
                let angle = (step as f64 + 0.5) * std::f64::consts::TAU / RINGS as f64;
                let r = (1.0 - z * z).sqrt();
                let b = basis([r * angle.cos(), r * angle.sin(), z]);
                for i in 0..16 {
                    for j in 0..16 {
                        gram[i][j] +=
                            b[i] * b[j] * 4.0 * std::f64::consts::PI / (RINGS * RINGS) as f64;
                    }
                }
            }
        }
        for i in 0..16 {
            for j in 0..16 {
                let expected = if i == j { 1.0 } else { 0.0 };
                assert!((gram[i][j] - expected).abs() < 5e-3, "{i} {j} {}", gram[i][j]);
            }
        }
    }
}
