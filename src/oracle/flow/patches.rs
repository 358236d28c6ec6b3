//! Dense inverse search: overlapping patches find their displacements.

use super::Level;
use crate::oracle::Real;
use crate::types::FlowSettings;

/// Side of a patch in pixels.
pub const PATCH: usize = 8;
/// Distance between neighbouring patches in pixels.
pub const STRIDE: usize = 4;

/// The displacement found by a patch.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Patch<T> {
    /// Displacement of the patch's centre, pixels.
    pub flow: [T; 2],
    /// Spatial derivatives of the displacement: ∂u/∂x, ∂u/∂y, ∂v/∂x, ∂v/∂y.
    pub slope: [T; 4],
    /// Mean of the second image minus the first over the patch: the change of brightness.
    pub shift: T,
    /// Mean squared residual after subtracting `shift`.
    pub cost: T,
}

/// How many patches there are along an axis of `n` pixels; patch i covers the pixels from
/// `STRIDE·i − 2` on, `PATCH` of them, those outside the image left out.
pub fn patch_grid(n: usize) -> usize {
    n.div_ceil(STRIDE)
}

/// The pixels of a patch along one axis of `n`.
fn span(i: usize, n: usize) -> std::ops::Range<usize> {
    let start = (i * STRIDE) as isize - ((PATCH - STRIDE) / 2) as isize;
    let end = start + PATCH as isize;
    start.max(0) as usize..(end as usize).min(n)
}

impl<T: Real> Patch<T> {
    /// The displacement that the patch gives a point (dx, dy) from its centre.
    fn at(&self, dx: T, dy: T) -> [T; 2] {
        let [ux, uy, vx, vy] = self.slope;
        [self.flow[0] + ux * dx + uy * dy, self.flow[1] + vx * dx + vy * dy]
    }
}

/// The centre of patch i along its axis.
fn centre<T: Real>(i: usize) -> T {
    T::of((i * STRIDE) as f64 + (STRIDE as f64 - 1.0) / 2.0)
}

/// The patches' sums at one displacement: the system of a Gauss–Newton step with the mean
/// residual eliminated.
struct Sums<T> {
    shift: T,
    cost: T,
    gradient: [T; 2],
}

/// The part that does not depend on the displacement: mean gradient and its scatter.
struct Template<T> {
    mean: [T; 2],
    scatter: [T; 3],
    count: T,
}

fn template<T: Real>(a: &Level<T>, i: usize, j: usize) -> Template<T> {
    let (mut sum, mut scatter, mut n) = ([T::zero(); 2], [T::zero(); 3], T::zero());
    for y in span(j, a.height) {
        for x in span(i, a.width) {
            let [gx, gy, ..] = a.derivatives[y * a.width + x];
            sum = [sum[0] + gx, sum[1] + gy];
            scatter = [scatter[0] + gx * gx, scatter[1] + gx * gy, scatter[2] + gy * gy];
            n += T::one();
        }
    }
    let mean = sum.map(|s| s / n);
    let scatter = [
        scatter[0] - sum[0] * mean[0],
        scatter[1] - sum[0] * mean[1],
        scatter[2] - sum[1] * mean[1],
    ];
    Template { mean, scatter, count: n }
}

fn evaluate<T: Real>(
    a: &Level<T>,
    b: &Level<T>,
    i: usize,
    j: usize,
    patch: &Patch<T>,
    mean: [T; 2],
) -> Sums<T> {
    let (mut sum, mut square, mut n) = (T::zero(), T::zero(), T::zero());
    let mut gradient = [T::zero(); 2];
    for y in span(j, a.height) {
        for x in span(i, a.width) {
            let p = y * a.width + x;
            let (px, py) = (T::of(x as f64), T::of(y as f64));
            let [u, v] = patch.at(px - centre(i), py - centre(j));
            let (tx, ty) = (px + u, py + v);
            let [v] = super::sample(|i, j| [b.luma[j * b.width + i]], b.width, b.height, tx, ty);
            let d = v - a.luma[p];
            let [gx, gy, ..] = a.derivatives[p];
            sum += d;
            square += d * d;
            gradient = [gradient[0] + gx * d, gradient[1] + gy * d];
            n += T::one();
        }
    }
    let shift = sum / n;
    let cost = ((square - sum * shift) / n).max(T::zero());
    let gradient = [gradient[0] - mean[0] * sum, gradient[1] - mean[1] * sum];
    Sums { shift, cost, gradient }
}

/// Improves a patch's displacement by Gauss–Newton steps on the first image's gradients; keeps the
/// best displacement seen.
fn descend<T: Real>(
    a: &Level<T>,
    b: &Level<T>,
    i: usize,
    j: usize,
    from: Patch<T>,
    settings: &FlowSettings,
) -> Patch<T> {
    let t = template(a, i, j);
    let noise = T::of(f64::from(settings.noise));
    // Damping by a fraction of the noise power limits the step of a patch without texture.
    let damping = t.count * noise * noise * T::of(DAMPING);
    let (hxx, hxy, hyy) = (t.scatter[0] + damping, t.scatter[1], t.scatter[2] + damping);
    let inverse = (hxx * hyy - hxy * hxy).recip();
    let mut sums = evaluate(a, b, i, j, &from, t.mean);
    let mut now = Patch { shift: sums.shift, cost: sums.cost, ..from };
    let mut best = now;
    for _ in 0..settings.search_steps {
        let [gx, gy] = sums.gradient;
        let step = [(hyy * gx - hxy * gy) * inverse, (hxx * gy - hxy * gx) * inverse];
        now.flow = [now.flow[0] - step[0], now.flow[1] - step[1]];
        let away = (now.flow[0] - from.flow[0]).abs().max((now.flow[1] - from.flow[1]).abs());
        // A patch that moves farther than its own size has diverged.
        if away > T::of(PATCH as f64) {
            break;
        }
        sums = evaluate(a, b, i, j, &now, t.mean);
        (now.shift, now.cost) = (sums.shift, sums.cost);
        if now.cost < best.cost {
            best = now;
        }
        if step[0].abs().max(step[1].abs()) < T::of(0.01) {
            break;
        }
    }
    best
}

/// Fraction of the noise power that damps a step.
const DAMPING: f64 = 0.1;

/// Every patch takes the best of its candidates (the start flow with its slope, without it, zero
/// motion, the guess) and descends from there. The slope lets a patch follow a slanted surface such
/// as the ground, on which a constant displacement fits only along one line.
///
/// `guess`: a flow over the full image, its width and height, and this level's number.
pub fn search<T: Real>(
    a: &Level<T>,
    b: &Level<T>,
    start: &[[T; 2]],
    guess: Option<(&[[T; 2]], usize, usize, usize)>,
    settings: &FlowSettings,
) -> Vec<Patch<T>> {
    let (nx, ny) = (patch_grid(a.width), patch_grid(a.height));
    let mut out = Vec::with_capacity(nx * ny);
    for j in 0..ny {
        for i in 0..nx {
            let value = |dx: i64, dy: i64| {
                let (x, y) = (centre::<T>(i) + T::of(dx as f64), centre::<T>(j) + T::of(dy as f64));
                super::sample(|i, j| start[j * a.width + i], a.width, a.height, x, y)
            };
            let r = (PATCH / 2) as i64;
            let (e, w, s, n) = (value(r, 0), value(-r, 0), value(0, r), value(0, -r));
            let limit = T::of(STEEPEST);
            let slope = [e[0] - w[0], s[0] - n[0], e[1] - w[1], s[1] - n[1]]
                .map(|d| (d / T::of(PATCH as f64)).max(-limit).min(limit));
            let mut best = Patch { flow: value(0, 0), slope, ..Patch::default() };
            let cost = |p: &Patch<T>| evaluate(a, b, i, j, p, [T::zero(); 2]).cost;
            let mut best_cost = cost(&best);
            let mut consider = |p: Patch<T>| {
                let c = cost(&p);
                if c < best_cost * T::of(HYSTERESIS) {
                    (best, best_cost) = (p, c);
                }
            };
            let flat = Patch { flow: value(0, 0), ..Patch::default() };
            consider(flat);
            consider(Patch::default());
            if let Some((guess, width, height, level)) = guess {
                let scale = T::of((1usize << level) as f64);
                let half = T::of(0.5);
                let (x, y) = (centre::<T>(i) + half, centre::<T>(j) + half);
                let f = super::sample(
                    |i, j| guess[j * width + i],
                    width,
                    height,
                    x * scale - half,
                    y * scale - half,
                );
                // False for NaN and for displacements out of range.
                let usable = f.iter().all(|c| c.abs() <= T::of(FARTHEST));
                if usable {
                    consider(Patch { flow: f.map(|c| c / scale), ..Patch::default() });
                }
            }
            out.push(descend(a, b, i, j, best, settings));
        }
    }
    out
}

/// A candidate must cost less than this fraction of the best candidate before it.
const HYSTERESIS: f64 = 0.9;

/// Guesses of larger magnitude are ignored, pixels of the full image.
const FARTHEST: f64 = 16384.0;

/// Maximum slope; a steeper start flow indicates an edge, not a slanted surface.
const STEEPEST: f64 = 0.5;

/// Whether two displacements are so near that descending from either ends in the same place.
fn alike<T: Real>(a: &Patch<T>, b: &Patch<T>) -> bool {
    let near = |a: T, b: T, limit: f64| (a - b).abs() < T::of(limit);
    (0..2).all(|k| near(a.flow[k], b.flow[k], ALIKE))
        && (0..4).all(|k| near(a.slope[k], b.slope[k], ALIKE / PATCH as f64))
}

/// Distance below which two displacements count as equal, pixels.
const ALIKE: f64 = 0.25;

/// Every patch tries the displacements of its neighbours and descends from the best, if that is
/// better than its own.
pub fn propagate<T: Real>(
    a: &Level<T>,
    b: &Level<T>,
    patches: &[Patch<T>],
    pass: u32,
    settings: &FlowSettings,
) -> Vec<Patch<T>> {
    let (nx, ny) = (patch_grid(a.width), patch_grid(a.height));
    let reach = 1 + (pass % 2) as isize;
    let mut out = Vec::with_capacity(nx * ny);
    for j in 0..ny as isize {
        for i in 0..nx as isize {
            let own = patches[j as usize * nx + i as usize];
            let (mut best, mut best_cost) = (own, own.cost * T::of(HYSTERESIS));
            for (di, dj) in [(-1, 0), (1, 0), (0, -1), (0, 1), (-1, -1), (1, -1), (-1, 1), (1, 1)] {
                let (qi, qj) = (i + di * reach, j + dj * reach);
                if qi < 0 || qj < 0 || qi >= nx as isize || qj >= ny as isize {
                    continue;
                }
                let q = patches[qj as usize * nx + qi as usize];
                let away = |d: isize| T::of((-d * reach * STRIDE as isize) as f64);
                let offered = Patch { flow: q.at(away(di), away(dj)), ..q };
                if alike(&offered, &own) {
                    continue;
                }
                let c = evaluate(a, b, i as usize, j as usize, &offered, [T::zero(); 2]).cost;
                if c < best_cost {
                    (best, best_cost) = (offered, c);
                }
            }
            let better = best != own;
            out.push(if better {
                descend(a, b, i as usize, j as usize, best, settings)
            } else {
                own
            });
        }
    }
    out
}

/// The flow of every pixel: the mean of the patches over it, weighted by each patch's residual at
/// this pixel and by its own cost.
pub fn densify<T: Real>(a: &Level<T>, b: &Level<T>, patches: &[Patch<T>]) -> Vec<[T; 2]> {
    let (nx, ny) = (patch_grid(a.width), patch_grid(a.height));
    let mut out = Vec::with_capacity(a.width * a.height);
    for y in 0..a.height {
        for x in 0..a.width {
            let (mut sum, mut total) = ([T::zero(); 2], T::zero());
            for j in covering(y, ny) {
                for i in covering(x, nx) {
                    let patch = patches[j * nx + i];
                    let [u, v] = patch.at(T::of(x as f64) - centre(i), T::of(y as f64) - centre(j));
                    let (tx, ty) = (T::of(x as f64) + u, T::of(y as f64) + v);
                    let [value] =
                        super::sample(|i, j| [b.luma[j * b.width + i]], b.width, b.height, tx, ty);
                    let d = value - a.luma[y * a.width + x] - patch.shift;
                    let weight = (d * d + patch.cost + T::of(FLOOR)).recip();
                    sum = [sum[0] + weight * u, sum[1] + weight * v];
                    total += weight;
                }
            }
            out.push(sum.map(|s| s / total));
        }
    }
    out
}

/// Residuals below about one grey level get equal weight.
const FLOOR: f64 = 2e-5;

/// The patches that cover a pixel along one axis.
fn covering(x: usize, patches: usize) -> std::ops::RangeInclusive<usize> {
    let overhang = (PATCH - STRIDE) / 2;
    let first = (x + overhang + 1).saturating_sub(PATCH).div_ceil(STRIDE);
    let last = ((x + overhang) / STRIDE).min(patches - 1);
    first..=last
}
