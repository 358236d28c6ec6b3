//! Variational refinement: brightness and gradient constancy against edge-aware smoothness.

use super::Level;
use super::pyramid::clamp;
use crate::oracle::Real;
use crate::types::FlowSettings;

/// The linearised equations of a pixel, without the smoothness term:
/// `[a, b; b, c] (u, v) = (r, s)`, and the weight of its smoothness.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Equation<T> {
    /// Upper left.
    pub a: T,
    /// Off the diagonal.
    pub b: T,
    /// Lower right.
    pub c: T,
    /// Right-hand side of u.
    pub r: T,
    /// Right-hand side of v.
    pub s: T,
    /// Smoothness of this pixel; an edge between two takes the mean of theirs.
    pub pull: T,
}

/// Linearises the energy about the flow.
///
/// Each data term `(∇f·(du, dv) + f_t)²/(|∇f|² + noise²)`, f being the luminance and its two
/// derivatives, is a squared distance in pixels; a robust penalty √(·² + kink²) covers brightness,
/// another the two gradients together, a third |∇u|² + |∇v|², weighted down at image edges.
/// `trust` scales the data terms; a pixel that leaves the image has none.
pub fn linearise<T: Real>(
    a: &Level<T>,
    b: &Level<T>,
    flow: &[[T; 2]],
    trust: &[T],
    settings: &FlowSettings,
) -> Vec<Equation<T>> {
    let (w, h) = (a.width, a.height);
    let of = |v: f32| T::of(f64::from(v));
    let noise = of(settings.noise) * of(settings.noise);
    let kink = of(settings.kink) * of(settings.kink);
    let robust = |squared: T| (squared + kink).sqrt().recip();
    let mut out = Vec::with_capacity(w * h);
    for y in 0..h {
        for x in 0..w {
            let p = y * w + x;
            let [u, v] = flow[p];
            let (tx, ty) = (T::of(x as f64) + u, T::of(y as f64) + v);
            let seen = tx >= T::zero()
                && ty >= T::zero()
                && tx <= T::of((w - 1) as f64)
                && ty <= T::of((h - 1) as f64);
            let mut e = Equation::default();
            if seen {
                let there: [T; 6] = super::sample(
                    |i, j| {
                        let q = j * w + i;
                        let [dx, dy, dxx, dxy, dyy] = b.derivatives[q];
                        [b.luma[q], dx, dy, dxx, dxy, dyy]
                    },
                    w,
                    h,
                    tx,
                    ty,
                );
                let [dx, dy, dxx, dxy, dyy] = a.derivatives[p];
                let here = [a.luma[p], dx, dy, dxx, dxy, dyy];
                let mean = |i: usize| (here[i] + there[i]) * T::of(0.5);
                let change = |i: usize| there[i] - here[i];
                let term = |fx: T, fy: T, ft: T| {
                    let n = (fx * fx + fy * fy + noise).recip();
                    ([fx, fy, ft], n, n * ft * ft)
                };
                let (lf, ln, le) = term(mean(1), mean(2), change(0));
                let (xf, xn, xe) = term(mean(3), mean(4), change(1));
                let (yf, yn, ye) = term(mean(4), mean(5), change(2));
                let bright = trust[p] * of(settings.brightness) * robust(le) * ln;
                let grad = trust[p] * of(settings.gradient) * robust(xe + ye);
                for (f, k) in [(lf, bright), (xf, grad * xn), (yf, grad * yn)] {
                    e.a += k * f[0] * f[0];
                    e.b += k * f[0] * f[1];
                    e.c += k * f[1] * f[1];
                    e.r -= k * f[0] * f[2];
                    e.s -= k * f[1] * f[2];
                }
                (e.r, e.s) = (e.r + e.a * u + e.b * v, e.s + e.b * u + e.c * v);
            }
            let at =
                |i: isize, j: isize| flow[clamp(y as isize + j, h) * w + clamp(x as isize + i, w)];
            let mut variation = T::zero();
            for (q, r) in [(at(1, 0), at(-1, 0)), (at(0, 1), at(0, -1))] {
                for k in 0..2 {
                    let d = (q[k] - r[k]) * T::of(0.5);
                    variation += d * d;
                }
            }
            let [dx, dy, ..] = a.derivatives[p];
            let edge = (-(dx * dx + dy * dy).sqrt() / of(settings.edge)).exp();
            e.pull = of(settings.smoothness) * (edge + T::of(0.02)) * robust(variation);
            out.push(e);
        }
    }
    out
}

/// One half-sweep of over-relaxation: solves the pixels with (x + y) mod 2 = `colour` for their own
/// flow, the neighbours' held.
pub fn relax<T: Real>(
    flow: &mut [[T; 2]],
    equations: &[Equation<T>],
    width: usize,
    height: usize,
    colour: usize,
    settings: &FlowSettings,
) {
    let omega = T::of(f64::from(settings.relaxation));
    for y in 0..height {
        for x in ((y + colour) % 2..width).step_by(2) {
            let p = y * width + x;
            let e = equations[p];
            let (mut weight, mut sum) = (T::zero(), [T::zero(); 2]);
            let mut pull = |q: usize| {
                let k = (e.pull + equations[q].pull) * T::of(0.5);
                weight += k;
                sum = [sum[0] + k * flow[q][0], sum[1] + k * flow[q][1]];
            };
            if x > 0 {
                pull(p - 1);
            }
            if x + 1 < width {
                pull(p + 1);
            }
            if y > 0 {
                pull(p - width);
            }
            if y + 1 < height {
                pull(p + width);
            }
            // A single pixel with nothing to see keeps its flow.
            let floor = T::of(1e-9);
            let (a, c) = (e.a + weight + floor, e.c + weight + floor);
            let (r, s) = (e.r + sum[0] + floor * flow[p][0], e.s + sum[1] + floor * flow[p][1]);
            let inverse = (a * c - e.b * e.b).recip();
            let solved = [(c * r - e.b * s) * inverse, (a * s - e.b * r) * inverse];
            for k in 0..2 {
                flow[p][k] += omega * (solved[k] - flow[p][k]);
            }
        }
    }
}

/// The median of the 3×3 neighbourhood of each component, edges repeated.
pub fn median<T: Real>(flow: &[[T; 2]], width: usize, height: usize) -> Vec<[T; 2]> {
    let mut out = Vec::with_capacity(flow.len());
    for y in 0..height as isize {
        for x in 0..width as isize {
            out.push(std::array::from_fn(|k| {
                let mut window = [T::zero(); 9];
                for (n, value) in window.iter_mut().enumerate() {
                    let (i, j) = (n as isize % 3 - 1, n as isize / 3 - 1);
                    *value = flow[clamp(y + j, height) * width + clamp(x + i, width)][k];
                }
                window.sort_by(|a, b| a.partial_cmp(b).unwrap_or(std::cmp::Ordering::Equal));
                window[4]
            }));
        }
    }
    out
}
