//! The mask loss: rendered motion against motion masks.
//!
//! Every Gaussian's probability of motion is blended like a colour, geometry and opacity held fixed,
//! and compared with the training view's motion mask by the mean absolute difference (the mask loss
//! of SC-GS, Huang et al. 2024). With `w_jp` the weight of Gaussian j in pixel p,
//!
//! ```text
//! X_p = Σ_j w_jp σ(m_j),   L = factor · Σ_p |X_p − M_p|
//! ∂L/∂m_j = σ'(m_j) Σ_p w_jp · factor · sign(X_p − M_p)
//! ```
//!
//! The evidence of motion of a Gaussian is the weighted mean of the mask over the pixels that the
//! Gaussian covers, `Σ_p w_jp M_p / Σ_p w_jp`, over all training views so far. Both sums are
//! gradients of blended colours, so one backward pass of blending computes them all.

use super::Real;

fn sigmoid<R: Real>(x: R) -> R {
    let e = (-x.abs()).exp();
    if x >= R::zero() { R::one() / (R::one() + e) } else { e / (R::one() + e) }
}

/// Probabilities of motion as the red channel of per-Gaussian colours.
pub fn paint<R: Real>(motion_logits: &[R]) -> Vec<[R; 3]> {
    motion_logits.iter().map(|&m| [sigmoid(m), R::zero(), R::zero()]).collect()
}

/// The gradient with respect to each pixel's colour: red holds that of the loss, green and blue
/// hold the weights of the votes.
pub fn compare<R: Real>(rendered_red: &[R], mask: &[R], factor: R) -> Vec<[R; 3]> {
    rendered_red
        .iter()
        .zip(mask)
        .map(|(&x, &m)| {
            let slope = match x - m {
                d if d > R::zero() => factor,
                d if d < R::zero() => -factor,
                _ => R::zero(),
            };
            [slope, m, R::one()]
        })
        .collect()
}

/// The accumulated gradients and votes of every Gaussian.
#[derive(Clone, Debug, PartialEq)]
pub struct Votes<R> {
    /// Gradients with respect to the motion logits.
    pub gradients: Vec<R>,
    /// Votes for motion, and all votes.
    pub votes: Vec<[R; 2]>,
    /// Evidence of motion in [0, 1]; unchanged for a Gaussian without votes.
    pub evidence: Vec<R>,
}

/// Adds the votes of a training view, given the gradients with respect to the Gaussians' colours
/// that result from [`compare`]. A Gaussian that is not visible in it, or whose gradient is not
/// finite, stays unchanged.
pub fn vote<R: Real>(
    colour_gradients: &[[R; 3]],
    visible: &[u32],
    motion_logits: &[R],
    so_far: &mut Votes<R>,
) {
    for (j, &[by_red, moving, all]) in colour_gradients.iter().enumerate() {
        let finite = by_red.is_finite() && moving.is_finite() && all.is_finite();
        if visible[j] == 0 || !finite {
            continue;
        }
        let m = sigmoid(motion_logits[j]);
        so_far.gradients[j] += by_red * m * (R::one() - m);
        let votes = &mut so_far.votes[j];
        votes[0] += moving;
        votes[1] += all;
        if votes[1] > R::zero() {
            so_far.evidence[j] = (votes[0] / votes[1]).max(R::zero()).min(R::one());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two Gaussians on three pixels with fixed weights: the gradient is the loss's central
    /// difference, and the evidence the weighted mean of the mask.
    #[test]
    fn gradient_is_the_losss() {
        let weights = [[0.7, 0.2, 0.0], [0.1, 0.5, 0.3]];
        let mask = [1.0, 0.0, 1.0];
        let logits = [0.4, -1.1];
        let render = |logits: &[f64; 2]| -> Vec<f64> {
            let colours = paint(logits);
            (0..3).map(|p| (0..2).map(|j| weights[j][p] * colours[j][0]).sum()).collect()
        };
        let loss = |logits: &[f64; 2]| -> f64 {
            render(logits).iter().zip(mask).map(|(x, m)| 0.25 * (x - m).abs()).sum()
        };
        let by_pixel = compare(&render(&logits), &mask, 0.25);
        let by_colour: Vec<[f64; 3]> = weights
            .iter()
            .map(|w| std::array::from_fn(|c| (0..3).map(|p| w[p] * by_pixel[p][c]).sum()))
            .collect();
        let mut votes =
            Votes { gradients: vec![0.0; 2], votes: vec![[0.0; 2]; 2], evidence: vec![1.0; 2] };
        vote(&by_colour, &[1, 1], &logits, &mut votes);
        for j in 0..2 {
            let mut moved = [logits; 2];
            moved[0][j] += 1e-5;
            moved[1][j] -= 1e-5;
            let slope = (loss(&moved[0]) - loss(&moved[1])) / 2e-5;
            assert!((votes.gradients[j] - slope).abs() < 1e-9, "{j}: {slope}");
        }
        assert!((votes.evidence[0] - 0.7 / 0.9).abs() < 1e-12);
        assert!((votes.evidence[1] - 0.4 / 0.9).abs() < 1e-12);
    }
}
