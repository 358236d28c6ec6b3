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
/// another the two gradients together, a third |∇u − slope|² + |∇v − slope|², weighted down at image edges
/// by `smoothness`. `slopes` holds du/dx, du/dy, dv/dx, dv/dy per pixel.
/// `trust` scales the data terms; a pixel that leaves the image has none.
pub fn linearise<T: Real>(
    a: &Level<T>,
    b: &Level<T>,
    flow: &[[T; 2]],
    trust: &[T],
    slopes: &[[T; 4]],
    smoothness: f32,
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
            // The differences span one pixel less at the image's edges.
            let span =
                |i: usize, n: usize| T::of(0.5 * ((i + 1).min(n - 1) - i.saturating_sub(1)) as f64);
            let along = [(at(1, 0), at(-1, 0), span(x, w)), (at(0, 1), at(0, -1), span(y, h))];
            for (axis, (q, r, span)) in along.into_iter().enumerate() {
                for k in 0..2 {
                    let d = (q[k] - r[k]) * T::of(0.5) - span * slopes[p][2 * k + axis];
                    variation += d * d;
                }
            }
            let [dx, dy, ..] = a.derivatives[p];
            let edge = (-(dx * dx + dy * dy).sqrt() / of(settings.edge)).exp();
            e.pull = of(smoothness) * (edge + T::of(0.02)) * robust(variation);
            out.push(e);
        }
    }
    out
}

/// Spacing of the pixels that a slope is fitted to, and the number of them to each side.
const SLOPE_STEP: usize = 4;
const SLOPE_REACH: isize = 6;
/// Difference of the flow at which the weight of a pixel has fallen to a quarter, pixels.
const SLOPE_ALIKE: f64 = 0.5;
/// Added to the moments of the positions, pixels².
const SLOPE_RIDGE: f64 = 500.0;

/// A pixel of the surroundings: its weight, its offset from the middle, and the difference of its flow.
struct Near<T> {
    weight: T,
    offset: [T; 2],
    change: [T; 2],
}

/// The slopes du/dx, du/dy, dv/dx, dv/dy of the flow around each pixel: a weighted least-squares fit of an
/// affine flow to the surroundings. The weight of a pixel is its `trust`, times a factor that falls with
/// the difference of its flow, because a different flow belongs to a different surface.
pub fn slopes<T: Real>(flow: &[[T; 2]], trust: &[T], width: usize, height: usize) -> Vec<[T; 4]> {
    let of_pixel = |p: usize| {
        let (x, y) = ((p % width) as isize, (p / width) as isize);
        let inside = |i: isize, n: usize| (0..n as isize).contains(&i);
        let mut near = Vec::new();
        for j in -SLOPE_REACH..=SLOPE_REACH {
            for i in -SLOPE_REACH..=SLOPE_REACH {
                let (dx, dy) = (i * SLOPE_STEP as isize, j * SLOPE_STEP as isize);
                if !(inside(x + dx, width) && inside(y + dy, height)) {
                    continue;
                }
                let q = (y + dy) as usize * width + (x + dx) as usize;
                let change = [0, 1].map(|k| flow[q][k] - flow[p][k]);
                let squared = change[0] * change[0] + change[1] * change[1];
                let alike = (T::one() + squared / T::of(SLOPE_ALIKE * SLOPE_ALIKE)).recip();
                let offset = [dx, dy].map(|d| T::of(d as f64));
                near.push(Near { weight: trust[q] * alike * alike, offset, change });
            }
        }
        let sum = |term: &dyn Fn(&Near<T>) -> T| {
            near.iter().map(|n| n.weight * term(n)).fold(T::zero(), |a, b| a + b)
        };
        let weight = sum(&|_| T::one());
        let mean = [0, 1].map(|i| sum(&|n| n.offset[i]) / weight);
        let moment =
            |i: usize, j: usize| sum(&|n| (n.offset[i] - mean[i]) * (n.offset[j] - mean[j]));
        let (a, b, c) =
            (moment(0, 0) + T::of(SLOPE_RIDGE), moment(0, 1), moment(1, 1) + T::of(SLOPE_RIDGE));
        let inverse = (a * c - b * b).recip();
        let [u, v] = [0, 1].map(|k| {
            let [r, s] = [0, 1].map(|i| sum(&|n| n.change[k] * (n.offset[i] - mean[i])));
            [(c * r - b * s) * inverse, (a * s - b * r) * inverse]
        });
        [u[0], u[1], v[0], v[1]]
    };
    (0..flow.len()).map(of_pixel).collect()
}

/// Adds to the right-hand sides the differences between neighbouring pixels that the slopes predict.
pub fn slant<T: Real>(
    equations: &mut [Equation<T>],
    slopes: &[[T; 4]],
    width: usize,
    height: usize,
) {
    let pulls: Vec<T> = equations.iter().map(|e| e.pull).collect();
    for (p, e) in equations.iter_mut().enumerate() {
        let (x, y) = (p % width, p / width);
        let mut add = |q: usize, axis: usize, sign: f64| {
            let pull = (pulls[p] + pulls[q]) * T::of(0.5);
            let mean = |k: usize| (slopes[p][2 * k + axis] + slopes[q][2 * k + axis]) * T::of(0.5);
            e.r += T::of(sign) * pull * mean(0);
            e.s += T::of(sign) * pull * mean(1);
        };
        if x > 0 {
            add(p - 1, 0, 1.0);
        }
        if x + 1 < width {
            add(p + 1, 0, -1.0);
        }
        if y > 0 {
            add(p - width, 1, 1.0);
        }
        if y + 1 < height {
            add(p + width, 1, -1.0);
        }
    }
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
