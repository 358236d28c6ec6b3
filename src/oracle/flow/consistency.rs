//! Forward–backward consistency: the weights of the data terms during refinement, and the
//! confidence of the result.

use super::Level;
use crate::oracle::Real;

/// The squared forward–backward error relative to its tolerance `0.01 (|f|² + |b|²) + 0.5`
/// (Sundaram et al. 2010). `None` where the flow leaves the image.
fn miss<T: Real>(
    forward: [T; 2],
    backward: &[[T; 2]],
    width: usize,
    height: usize,
    x: usize,
    y: usize,
) -> Option<T> {
    let [u, v] = forward;
    let (tx, ty) = (T::of(x as f64) + u, T::of(y as f64) + v);
    let half = T::of(0.5);
    let inside = tx >= -half
        && ty >= -half
        && tx <= T::of(width as f64) - half
        && ty <= T::of(height as f64) - half;
    if !inside {
        return None;
    }
    let [p, q] = super::sample(|i, j| backward[j * width + i], width, height, tx, ty);
    let (du, dv) = (u + p, v + q);
    let tolerated = T::of(0.01) * (u * u + v * v + p * p + q * q) + half;
    Some((du * du + dv * dv) / tolerated)
}

/// Weight of the data terms of each pixel of `forward`, in (0, 1].
pub fn trust<T: Real>(
    forward: &[[T; 2]],
    backward: &[[T; 2]],
    width: usize,
    height: usize,
) -> Vec<T> {
    let mut out = Vec::with_capacity(forward.len());
    for y in 0..height {
        for x in 0..width {
            let miss = miss(forward[y * width + x], backward, width, height, x, y);
            let t = miss.map_or(T::zero(), |m| (T::one() + m * m).recip());
            out.push(t.max(T::of(LEAST_TRUST)));
        }
    }
    out
}

/// The weight where the directions disagree; it is not zero, so that a pixel without neighbours
/// still moves.
const LEAST_TRUST: f64 = 0.001;

/// Confidence of each pixel of `forward`, in [0, 1]: agreement of the two directions times
/// agreement of the images over a 5×5 window with its mean taken off.
pub fn confidence<T: Real>(
    a: &Level<T>,
    b: &Level<T>,
    forward: &[[T; 2]],
    backward: &[[T; 2]],
) -> Vec<T> {
    let (w, h) = (a.width, a.height);
    let mut out = Vec::with_capacity(w * h);
    for y in 0..h {
        for x in 0..w {
            let Some(miss) = miss(forward[y * w + x], backward, w, h, x, y) else {
                out.push(T::zero());
                continue;
            };
            let (mut n, mut sum, mut square) = (T::zero(), T::zero(), T::zero());
            let (mut mean, mut power) = (T::zero(), T::zero());
            for qy in y.saturating_sub(2)..(y + 3).min(h) {
                for qx in x.saturating_sub(2)..(x + 3).min(w) {
                    let q = qy * w + qx;
                    let tx = T::of(qx as f64) + forward[q][0];
                    let ty = T::of(qy as f64) + forward[q][1];
                    let [v] = super::sample(|i, j| [b.luma[j * w + i]], w, h, tx, ty);
                    let d = v - a.luma[q];
                    n += T::one();
                    sum += d;
                    square += d * d;
                    mean += a.luma[q];
                    power += a.luma[q] * a.luma[q];
                }
            }
            let residual = ((square - sum * sum / n) / n).max(T::zero());
            let contrast = ((power - mean * mean / n) / n).max(T::zero());
            // Residuals are judged against the window's own contrast and a noise floor.
            let ratio = residual / (T::of(0.5) * contrast + T::of(4e-4));
            out.push((-miss - ratio).exp());
        }
    }
    out
}
