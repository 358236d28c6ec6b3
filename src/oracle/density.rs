//! Density control: where Gaussians are added, moved and removed.
//!
//! Two strategies share the bookkeeping. *MCMC* (Kheradmand et al. 2024) keeps their number: dead
//! Gaussians move onto live ones drawn by opacity, whose opacity and scale shrink so that the
//! rendered image stays the same; positions get noise. *Adaptive* (Kerbl et al. 2023) clones,
//! splits and prunes by the screen-space gradient.
//!
//! Random numbers are counter-based: the same seed, step and index give the same number on every
//! device.

use super::Real;
use super::deform::NONE;
use super::rotation::{add, apply, dot, identity, matrix, scale, transpose, unit};
use crate::types::{AdaptSettings, MotionClass};

/// A Gaussian of this opacity or less is dead.
pub const DEAD_OPACITY: f64 = 0.005;

/// At most this many Gaussians share one place after a round of relocation.
pub const LARGEST_SHARE: u32 = 51;

/// Four random words for a counter (pcg4d of Jarzynski and Olano 2020).
pub fn random(counter: [u32; 4]) -> [u32; 4] {
    let mut v = counter.map(|c| c.wrapping_mul(1_664_525).wrapping_add(1_013_904_223));
    let mix = |v: &mut [u32; 4]| {
        v[0] = v[0].wrapping_add(v[1].wrapping_mul(v[3]));
        v[1] = v[1].wrapping_add(v[2].wrapping_mul(v[0]));
        v[2] = v[2].wrapping_add(v[0].wrapping_mul(v[1]));
        v[3] = v[3].wrapping_add(v[1].wrapping_mul(v[2]));
    };
    mix(&mut v);
    v = v.map(|x| x ^ (x >> 16));
    mix(&mut v);
    v
}

/// Three independent standard normal numbers for a counter (Box and Muller).
pub fn normals<R: Real>(counter: [u32; 4]) -> [R; 3] {
    let step = R::of(1.0 / 16_777_216.0);
    let unit = |word: u32, shift: u32| R::of(f64::from((word >> 8) + shift)) * step;
    let [a, b, c, d] = random(counter);
    // A radius from (0, 1]: its logarithm is finite.
    let radius = |word| (R::of(-2.0) * unit(word, 1).ln()).sqrt();
    let (first, second) = (radius(a), radius(c));
    let (angle, other) = (R::TAU() * unit(b, 0), R::TAU() * unit(d, 0));
    [first * angle.cos(), first * angle.sin(), second * other.cos()]
}

fn sigmoid<R: Real>(x: R) -> R {
    R::one() / (R::one() + (-x).exp())
}

/// ln(1 + eˣ) without overflow.
fn softplus<R: Real>(x: R) -> R {
    x.max(R::zero()) + (-x.abs()).exp().ln_1p()
}

/// Whether a Gaussian with this opacity logit is dead; NaN counts as dead.
pub fn is_dead<R: Real>(logit: R) -> bool {
    let limit = R::of((DEAD_OPACITY / (1.0 - DEAD_OPACITY)).ln());
    logit.is_nan() || logit <= limit
}

/// Whether a Gaussian belongs to a class.
fn holds<R: Real>(class: MotionClass, motion_logits: &[R], j: usize) -> bool {
    let moves = motion_logits.get(j).is_some_and(|&m| m > R::zero());
    match class {
        MotionClass::Any => true,
        MotionClass::Static => !moves,
        MotionClass::Dynamic => moves,
    }
}

/// Integer weights of the draw by opacity: zero for the dead and for the other class, else the
/// opacity times [`MotionClass::largest_weight`], rounded down, at least 1.
pub fn draw_weights<R: Real>(
    opacity_logits: &[R],
    motion_logits: &[R],
    class: MotionClass,
) -> Vec<u32> {
    let largest = MotionClass::largest_weight(opacity_logits.len());
    (0..opacity_logits.len())
        .map(|j| {
            if is_dead(opacity_logits[j]) || !holds(class, motion_logits, j) {
                return 0;
            }
            let scaled = sigmoid(opacity_logits[j]) * R::of(f64::from(largest));
            (scaled.f64() as u32).clamp(1, largest)
        })
        .collect()
}

/// The dead of a class, by index.
pub fn dead<R: Real>(opacity_logits: &[R], motion_logits: &[R], class: MotionClass) -> Vec<u32> {
    (0..opacity_logits.len())
        .filter(|&j| is_dead(opacity_logits[j]) && holds(class, motion_logits, j))
        .map(|j| j as u32)
        .collect()
}

/// `draws` Gaussians drawn in proportion to `weights`; [`NONE`] where all weights are zero.
pub fn draw(weights: &[u32], draws: usize, seed: u32, step: u32) -> Vec<u32> {
    let total: u64 = weights.iter().map(|&w| u64::from(w)).sum();
    (0..draws as u32)
        .map(|index| {
            if total == 0 {
                return NONE;
            }
            let word = u64::from(random([index, step, seed, 0])[0]);
            let mut rest = (word * total) >> 32;
            for (j, &w) in weights.iter().enumerate() {
                if rest < u64::from(w) {
                    return j as u32;
                }
                rest -= u64::from(w);
            }
            unreachable!("the draw is below the total")
        })
        .collect()
}

/// Opacity logit and log-scales of each of `share` equal Gaussians that together have the
/// appearance of one with the given values: `o' = 1 − (1 − o)^{1/N}` and
///
/// ```text
/// s' = s · o / Σ_{i=1..N} Σ_{k=0..i−1} C(i−1, k) (−1)^k o'^{k+1} / √(k+1)
/// ```
///
/// (3DGS-MCMC, equation 9), the sum by `coverage`. The opacity is kept above [`DEAD_OPACITY`], or
/// else a relocated Gaussian could be dead at once. `share` is limited to [`LARGEST_SHARE`].
pub fn split_mass<R: Real>(opacity_logit: R, log_scales: [R; 3], share: u32) -> (R, [R; 3]) {
    let share = share.clamp(1, LARGEST_SHARE);
    if share == 1 {
        return (opacity_logit, log_scales);
    }
    // −ln(1 − o') = softplus(logit)/N, without forming 1 − o.
    let density = softplus(opacity_logit) / R::of(f64::from(share));
    let part = -(-density).exp_m1();
    let shrink = -softplus(-opacity_logit) - coverage(part, share).ln();
    let dead = R::of((DEAD_OPACITY / (1.0 - DEAD_OPACITY)).ln());
    // For large d, ln(expm1 d) = d; this avoids the overflow of exp.
    let logit = if density > R::of(30.0) { density } else { density.exp_m1().ln() };
    (logit.max(dead), log_scales.map(|s| s + shrink))
}

/// The integral of opacity along a line of `share` blended Gaussians of one opacity, over √π. The
/// source's double sum, whose terms alternate and cancel, equals
///
/// ```text
/// 2/√π ∫_{s≥0} 1 − (1 − o e^{−s²})^N ds
/// ```
///
/// by the trapezoid rule, which converges exponentially: with this step to 1e-16.
fn coverage<R: Real>(opacity: R, share: u32) -> R {
    const STEP: f64 = 0.125;
    let mut sum = R::zero();
    for i in 0..52 {
        let s = STEP * f64::from(i);
        let alpha = opacity * R::of(-s * s).exp();
        let covered = -(R::of(f64::from(share)) * (-alpha).ln_1p()).exp_m1();
        sum += if i == 0 { R::of(0.5) * covered } else { covered };
    }
    R::of(STEP * std::f64::consts::FRAC_2_SQRT_PI) * sum
}

/// One round of relocation: updates the drawn targets. `targets` is the result of [`draw`]. Slot
/// `d` then copies every parameter of `targets[d]` *after* the update, and the moments of both are
/// zeroed. Returns how often each Gaussian was drawn.
pub fn relocate<R: Real>(
    targets: &[u32],
    opacity_logits: &mut [R],
    log_scales: &mut [[R; 3]],
) -> Vec<u32> {
    let mut drawn = vec![0u32; opacity_logits.len()];
    for &target in targets {
        if target != NONE {
            drawn[target as usize] += 1;
        }
    }
    for j in 0..drawn.len() {
        if drawn[j] > 0 {
            (opacity_logits[j], log_scales[j]) =
                split_mass(opacity_logits[j], log_scales[j], drawn[j].saturating_add(1));
        }
    }
    drawn
}

/// MCMC's exploration: every centre moves by `Σ ε σ(100 (0.005 − o)) · size` with ε standard normal
/// and Σ the covariance. A Gaussian whose step is not finite stays unchanged. In the source `size`
/// is the learning rate of positions times 5e5.
pub fn jitter<R: Real>(
    positions: &mut [[R; 3]],
    log_scales: &[[R; 3]],
    rotations: &[[R; 4]],
    opacity_logits: &[R],
    size: R,
    seed: u32,
    step: u32,
) {
    for j in 0..positions.len() {
        let noise: [R; 3] = normals([j as u32, step, seed, 1]);
        let gate = sigmoid(R::of(100.0) * (R::of(0.005) - sigmoid(opacity_logits[j])));
        let turn = matrix(unit(rotations[j]).map_or_else(identity, |(u, _)| u));
        let local = apply(transpose(turn), noise);
        let stretched = std::array::from_fn(|c| local[c] * (R::of(2.0) * log_scales[j][c]).exp());
        let moved = scale(apply(turn, stretched), gate * size);
        if moved.iter().all(|v| v.is_finite()) {
            positions[j] = add(positions[j], moved);
        }
    }
}

/// The action of adaptive control on a Gaussian.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub enum Action {
    /// The Gaussian is removed.
    Prune = 0,
    /// The Gaussian stays unchanged.
    Keep = 1,
    /// The Gaussian stays, and a copy is added.
    Clone = 2,
    /// The Gaussian is replaced by two smaller ones sampled from it.
    Split = 3,
}

/// The actions of adaptive control. `statistics` holds per Gaussian the sum of screen-space gradient
/// norms and the number of views summed. A Gaussian with a parameter that is not finite is pruned.
pub fn decide<R: Real>(
    settings: &AdaptSettings,
    statistics: &[[R; 2]],
    opacity_logits: &[R],
    log_scales: &[[R; 3]],
) -> Vec<Action> {
    let logit = (settings.opacity / (1.0 - settings.opacity)).ln();
    (0..statistics.len())
        .map(|j| {
            let [sum, views] = statistics[j];
            let largest = log_scales[j].iter().fold(R::neg_infinity(), |m, &s| m.max(s));
            let broken = log_scales[j].iter().any(|s| s.is_nan()) || opacity_logits[j].is_nan();
            if broken || opacity_logits[j] < R::of(logit) || largest > R::of(settings.large.ln()) {
                return Action::Prune;
            }
            if views > R::zero() && sum / views > R::of(settings.gradient) {
                if largest <= R::of(settings.small.ln()) { Action::Clone } else { Action::Split }
            } else {
                Action::Keep
            }
        })
        .collect()
}

/// The origin of a row of the new arrays.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub enum Origin {
    /// The Gaussian itself; it keeps its optimiser moments.
    Kept = 0,
    /// A copy; its moments start at zero.
    Copied = 1,
    /// A part of a split Gaussian, sampled from it and smaller; its moments start at zero.
    Drawn = 2,
}

/// The new rows after adaptive control: the survivors in order, then the added ones in order of
/// their sources, at most `capacity` in all. Rows beyond the capacity are not added, and a split
/// Gaussian whose second part does not fit stays whole.
pub fn layout(actions: &[Action], capacity: usize) -> Vec<(u32, Origin)> {
    let survivors = actions.iter().filter(|&&a| a != Action::Prune).count();
    let mut free = capacity.saturating_sub(survivors);
    let (mut kept, mut added) = (Vec::new(), Vec::new());
    for (source, &action) in (0u32..).zip(actions) {
        if action == Action::Prune {
            continue;
        }
        let grows = matches!(action, Action::Clone | Action::Split) && free > 0;
        let part = if action == Action::Split { Origin::Drawn } else { Origin::Copied };
        if grows {
            free -= 1;
            added.push((source, part));
        }
        kept.push((source, if grows && part == Origin::Drawn { part } else { Origin::Kept }));
    }
    kept.extend(added);
    kept
}

/// Gathers rows of `width` values in the order of `rows`. With `fresh_zero` (for optimiser moments)
/// only kept rows have values, and the others are zero.
pub fn gather<R: Real>(
    rows: &[(u32, Origin)],
    width: usize,
    values: &[R],
    fresh_zero: bool,
) -> Vec<R> {
    rows.iter()
        .flat_map(|&(source, origin)| {
            let row = &values[source as usize * width..][..width];
            let zero = fresh_zero && origin != Origin::Kept;
            row.iter().map(move |&v| if zero { R::zero() } else { v })
        })
        .collect()
}

/// Samples the parts of split Gaussians, after [`gather`]: each is displaced by a sample of its
/// source, and its scales are divided by [`AdaptSettings::SPLIT_SHRINK`].
pub fn draw_parts<R: Real>(
    rows: &[(u32, Origin)],
    positions: &mut [[R; 3]],
    log_scales: &mut [[R; 3]],
    rotations: &[[R; 4]],
    seed: u32,
    step: u32,
) {
    for (j, &(_, origin)) in rows.iter().enumerate() {
        if origin != Origin::Drawn {
            continue;
        }
        let noise: [R; 3] = normals([j as u32, step, seed, 2]);
        let turn = matrix(unit(rotations[j]).map_or_else(identity, |(u, _)| u));
        let stretched = std::array::from_fn(|c| noise[c] * log_scales[j][c].exp());
        positions[j] = add(positions[j], apply(turn, stretched));
        log_scales[j] = log_scales[j].map(|s| s - R::of(AdaptSettings::SPLIT_SHRINK.ln()));
    }
}

/// Adds one view's screen-space gradients (pixels) to the statistics of [`decide`]: the norm of the
/// gradient in units of half the image, for Gaussians that are visible in the view.
pub fn accumulate<R: Real>(
    statistics: &mut [[R; 2]],
    screen_gradients: &[[R; 2]],
    visible: &[u32],
    half_image: [R; 2],
) {
    for j in 0..statistics.len() {
        let g = [screen_gradients[j][0] * half_image[0], screen_gradients[j][1] * half_image[1]];
        let norm = dot(g, g).sqrt();
        if visible[j] != 0 && norm.is_finite() {
            statistics[j][0] += norm;
            statistics[j][1] += R::one();
        }
    }
}

/// Opacity reset: clamps all logits to at most `limit`.
pub fn reset_opacity<R: Real>(opacity_logits: &mut [R], limit: R) {
    for logit in opacity_logits {
        *logit = logit.min(limit);
    }
}

/// Adds the gradients of `opacity_weight · mean opacity + scale_weight · mean scale` (3dgs-mcmc's
/// regularisers) to those of the opacity logits and of the log-scales.
pub fn regularise<R: Real>(
    opacity_logits: &[R],
    log_scales: &[R],
    opacity_weight: R,
    scale_weight: R,
    opacity_gradients: &mut [R],
    log_scale_gradients: &mut [R],
) {
    let count = R::of(opacity_logits.len().max(1) as f64);
    for (gradient, &logit) in opacity_gradients.iter_mut().zip(opacity_logits) {
        let e = (-logit.abs()).exp();
        *gradient += opacity_weight / count * e / ((R::one() + e) * (R::one() + e));
    }
    for (gradient, &log_scale) in log_scale_gradients.iter_mut().zip(log_scales) {
        *gradient += scale_weight / (R::of(3.0) * count) * log_scale.exp();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn random_words_are_even() {
        let mut sums = [0.0f64; 4];
        for index in 0..4096 {
            for (sum, word) in sums.iter_mut().zip(random([index, 7, 1, 0])) {
                *sum += f64::from(word) / 4_294_967_296.0;
            }
        }
        // The mean of 4096 uniform numbers deviates by 0.0045.
        assert!(sums.iter().all(|s| (s / 4096.0 - 0.5).abs() < 0.02), "{sums:?}");
        let mut second = [0.0f64; 3];
        for index in 0..4096 {
            for (s, n) in second.iter_mut().zip(normals::<f64>([index, 0, 0, 1])) {
                *s += n * n;
            }
        }
        assert!(second.iter().all(|s| (s / 4096.0 - 1.0).abs() < 0.1), "{second:?}");
    }

    #[test]
    fn coverage_is_the_sources_sum() {
        for share in 2..=LARGEST_SHARE {
            for step in 0..60 {
                let density = softplus(-6.0 + 0.4 * f64::from(step)) / f64::from(share);
                let part = -(-density).exp_m1();
                let (mut sum, mut largest) = (0.0, 0.0f64);
                for i in 1..=share {
                    let mut term = part;
                    for k in 0..i {
                        sum += term / f64::from(k + 1).sqrt();
                        largest = largest.max(term.abs());
                        term *= -part * f64::from(i - 1 - k) / f64::from(k + 1);
                    }
                }
                // The rounding error of the alternating sum.
                let bound = 1e-13 * largest.max(sum);
                let off = (coverage(part, share) - sum).abs();
                assert!(off <= bound, "{share} of {part}: {off:e} off, {bound:e} allowed");
                let twin = f64::from(coverage(part as f32, share));
                assert!(
                    (twin / coverage(part, share) - 1.0).abs() < 2e-6,
                    "{share} of {part}: f32 {twin}"
                );
            }
        }
    }

    #[test]
    fn draws_follow_the_weights() {
        let weights = [0, 300, 0, 100, 0];
        let drawn = draw(&weights, 4000, 3, 9);
        let ones = drawn.iter().filter(|&&j| j == 1).count();
        assert!(drawn.iter().all(|&j| j == 1 || j == 3));
        assert!((2850..3150).contains(&ones), "{ones}");
        assert_eq!(draw(&[0, 0], 2, 3, 9), [NONE, NONE]);
        assert_eq!(draw(&weights, 10, 3, 9), draw(&weights, 10, 3, 9));
        assert_ne!(draw(&weights, 99, 3, 9), draw(&weights, 99, 3, 10));
    }

    #[test]
    fn weights_fit_in_32_bits_and_respect_life_and_class() {
        for count in [1, 2, 65_536, 65_538, 1 << 20, 10_000_000] {
            assert!(
                u64::from(MotionClass::largest_weight(count)) * count as u64 <= u64::from(u32::MAX)
            );
        }
        let logits = [40.0f32, -40.0, 0.0, f32::NAN, -5.0];
        let motion = [1.0, 1.0, -1.0, -1.0, 0.0];
        assert_eq!(draw_weights(&logits, &motion, MotionClass::Any), [65_535, 0, 32_767, 0, 438]);
        assert_eq!(draw_weights(&logits, &motion, MotionClass::Dynamic), [65_535, 0, 0, 0, 0]);
        assert_eq!(dead(&logits, &motion, MotionClass::Static), [3]);
        assert_eq!(dead(&logits, &[], MotionClass::Static), [1, 3]);
    }

    /// The quantity that the formula conserves: N parts blended over each other carry, along a line
    /// through the centre, the same integral of opacity as the whole.
    #[test]
    fn splitting_conserves_the_integral_along_a_line() {
        for logit in [-3.0f64, 0.0, 2.0, 8.0] {
            for share in [2, 3, 10, 51] {
                let (part, [log_scale, ..]) = split_mass(logit, [0.0; 3], share);
                if part <= (DEAD_OPACITY / (1.0 - DEAD_OPACITY)).ln() {
                    continue;
                }
                let (mut whole, mut parts) = (0.0, 0.0);
                for i in -4000..=4000 {
                    let x = f64::from(i) * 2e-3;
                    whole += sigmoid(logit) * (-0.5 * x * x).exp();
                    let y = x / log_scale.exp();
                    let alpha = sigmoid(part) * (-0.5 * y * y).exp();
                    parts += 1.0 - (1.0 - alpha).powi(share as i32);
                }
                assert!((whole / parts - 1.0).abs() < 1e-3, "{logit} {share}: {whole} {parts}");
            }
        }
    }

    #[test]
    fn extreme_opacities_split_to_finite_parts() {
        for logit in [-40.0f64, 40.0, 1e4] {
            for share in [1, 2, 51, 1000] {
                let (part, scales) = split_mass(logit, [1.0, -50.0, 50.0], share);
                assert!(
                    part.is_finite() && scales.iter().all(|s| s.is_finite()),
                    "{logit} {share}"
                );
            }
        }
        assert_eq!(split_mass(0.3, [1.0, 2.0, 3.0], 1), (0.3, [1.0, 2.0, 3.0]));
        // Two parts of an opaque one: half the optical depth.
        let (part, _) = split_mass(40.0f64, [0.0; 3], 2);
        assert!((part - 20.0).abs() < 1e-6);
    }

    #[test]
    fn relocation_changes_only_the_drawn() {
        let mut logits = [1.0f64, 2.0, -9.0];
        let mut scales = [[0.0; 3]; 3];
        let drawn = relocate(&[1, 1, NONE], &mut logits, &mut scales);
        assert_eq!(drawn, [0, 2, 0]);
        assert_eq!((logits[0], logits[2]), (1.0, -9.0));
        assert!((1.0 - sigmoid(logits[1])).powi(3) - (1.0 - sigmoid(2.0)) < 1e-12);
        assert!(scales[1][0] < 0.0);
    }

    #[test]
    fn noise_moves_the_faint_along_their_shape() {
        let mut positions = [[0.0f64; 3]; 3];
        let log_scales = [[0.0, -20.0, -20.0]; 3];
        let half_turn = [0.5f64.sqrt(), 0.0, 0.0, 0.5f64.sqrt()];
        let rotations = [half_turn, half_turn, [0.0; 4]];
        jitter(&mut positions, &log_scales, &rotations, &[-9.0, 9.0, -9.0], 0.1, 1, 2);
        // A needle turned from x to y.
        assert!(positions[0][1].abs() > 1e-3 && positions[0][0].abs() < 1e-9);
        assert!(positions[1].iter().all(|v| v.abs() < 1e-30));
        assert!(positions[2][0].abs() > 1e-3);
        let mut p = [[1.0f32; 3]];
        jitter(&mut p, &[[60.0; 3]], &[[1.0, 0.0, 0.0, 0.0]], &[-9.0], 1.0, 1, 2);
        assert_eq!(p, [[1.0; 3]]);
    }

    #[test]
    fn adaptive_control_decides_lays_out_and_gathers() {
        let settings = AdaptSettings { large: 1.0, ..Default::default() };
        let statistics =
            [[1e-3, 10.0], [1e-2, 10.0], [1e-2, 10.0], [0.0, 0.0], [1.0, 1.0], [1.0, 1.0]];
        let logits = [0.0, 0.0, 0.0, 0.0, -40.0, f64::NAN];
        let scales = [[-6.0; 3], [-6.0; 3], [-2.0; 3], [0.5; 3], [-6.0; 3], [-6.0; 3]];
        let actions = decide(&settings, &statistics, &logits, &scales);
        use Action::{Clone as C, Keep as K, Prune as P, Split as S};
        assert_eq!(actions, [K, C, S, P, P, P]);
        let rows = layout(&actions, 10);
        use Origin::{Copied, Drawn, Kept};
        assert_eq!(rows, [(0, Kept), (1, Kept), (2, Drawn), (1, Copied), (2, Drawn)]);
        assert_eq!(
            layout(&actions, 4),
            [(0, Kept), (1, Kept), (2, Kept), (1, Copied)],
            "what does not fit stays whole"
        );
        let values = [0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 4.5, 5.0, 5.5];
        assert_eq!(
            gather(&rows, 2, &values, false),
            [0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 1.0, 1.5, 2.0, 2.5]
        );
        assert_eq!(gather(&rows, 2, &values, true)[4..], [0.0; 6]);
        let mut positions = vec![[0.0f64; 3]; 5];
        let mut log_scales = vec![[-2.0; 3]; 5];
        draw_parts(&rows, &mut positions, &mut log_scales, &[[1.0, 0.0, 0.0, 0.0]; 5], 1, 1);
        assert_eq!(positions[0], [0.0; 3]);
        assert_ne!(positions[2], positions[4]);
        assert!((log_scales[4][0] + 2.0 + AdaptSettings::SPLIT_SHRINK.ln()).abs() < 1e-12);
    }

    #[test]
    fn regularisers_agree_with_central_differences() {
        let (logits, scales) = ([0.3f64, -2.0], [-1.0, 0.5, 0.0, -3.0, 1.0, -0.2]);
        let loss = |logits: &[f64], scales: &[f64]| {
            0.2 * logits.iter().map(|&l| sigmoid(l)).sum::<f64>() / 2.0
                + 0.7 * scales.iter().map(|s| s.exp()).sum::<f64>() / 6.0
        };
        let (mut by_logit, mut by_scale) = ([0.0; 2], [0.0; 6]);
        regularise(&logits, &scales, 0.2, 0.7, &mut by_logit, &mut by_scale);
        let h = 1e-6;
        for i in 0..2 {
            let (mut up, mut down) = (logits, logits);
            up[i] += h;
            down[i] -= h;
            let numeric = (loss(&up, &scales) - loss(&down, &scales)) / (2.0 * h);
            assert!((numeric - by_logit[i]).abs() < 1e-9);
        }
        for i in 0..6 {
            let (mut up, mut down) = (scales, scales);
            up[i] += h;
            down[i] -= h;
            let numeric = (loss(&logits, &up) - loss(&logits, &down)) / (2.0 * h);
            assert!((numeric - by_scale[i]).abs() < 1e-9);
        }
    }

    #[test]
    fn statistics_count_only_what_is_seen() {
        let mut s = [[0.0f64; 2]; 3];
        accumulate(&mut s, &[[3.0, 4.0], [1.0, 1.0], [f64::NAN, 0.0]], &[1, 0, 1], [2.0, 2.0]);
        assert_eq!(s, [[10.0, 1.0], [0.0, 0.0], [0.0, 0.0]]);
        let mut logits = [3.0f32, -8.0];
        reset_opacity(&mut logits, -4.595);
        assert_eq!(logits, [-4.595, -8.0]);
    }
}
