//! Random sample consensus with MSAC scoring, adaptive termination, early rejection and local optimisation.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Termination and inlier criteria.
#[derive(Clone, Copy, Debug)]
pub struct RansacOptions {
    /// Maximum error of an inlier, in the estimator's units (pixels throughout this crate).
    pub threshold: f64,
    /// Required probability that at least one sample is free of outliers.
    pub confidence: f64,
    /// Minimum number of samples.
    pub min_iterations: usize,
    /// Maximum number of samples.
    pub max_iterations: usize,
    /// The number of samples is bounded by what this share of inliers requires.
    pub min_inlier_ratio: f64,
    /// Random seed; the same seed gives the same result, bit for bit.
    pub seed: u64,
}

impl Default for RansacOptions {
    fn default() -> Self {
        RansacOptions {
            threshold: 1.0,
            confidence: 0.9999,
            min_iterations: 100,
            max_iterations: 2000,
            min_inlier_ratio: 0.1,
            seed: 0,
        }
    }
}

/// The model-specific functions that RANSAC needs.
pub trait Estimator {
    /// The fitted model.
    type Model: Clone;
    /// Size of a minimal sample.
    const SAMPLE: usize;
    /// Size of a local optimisation's sample.
    const LOCAL_SAMPLE: usize;

    /// Number of data.
    fn len(&self) -> usize;
    /// Whether there are no data.
    fn is_empty(&self) -> bool {
        self.len() == 0
    }
    /// Appends all models through a minimal sample to `out`.
    fn minimal(&self, sample: &[usize], out: &mut Vec<Self::Model>);
    /// Squared error of a datum; infinite where it contradicts the model.
    fn squared_error(&self, model: &Self::Model, index: usize) -> f64;
    /// A refined model from a larger sample, starting from an approximate one.
    fn refine(&self, model: &Self::Model, sample: &[usize]) -> Option<Self::Model>;
    /// Weight of a datum, in (0, 1].
    fn weight(&self, _index: usize) -> f64 {
        1.0
    }
}

/// The best model with its inliers.
#[derive(Clone, Debug)]
pub struct Consensus<M> {
    /// The model.
    pub model: M,
    /// Indices of the inliers, ascending.
    pub inliers: Vec<usize>,
    /// MSAC cost: Σ weight · min(error², threshold²).
    pub cost: f64,
    /// Number of samples drawn.
    pub iterations: usize,
}

/// Number of data that a model is scored on before it may be rejected early.
const PROBE: usize = 256;
/// Number of local optimisations from random subsets of the inliers, each time the best model improves.
const LOCAL_ROUNDS: usize = 6;
/// Maximum number of inliers, evenly sampled, in a local fit to all inliers.
const LOCAL_CAP: usize = 400;

/// Fits a model to data with outliers; `guesses` (for example a prediction) compete with the samples.
///
/// MSAC (Torr and Zisserman 2000), inner local optimisation (Chum, Matas and Kittler 2003). `None` when
/// there are fewer data than a minimal sample or no sample gave a model.
pub fn ransac<E: Estimator>(
    estimator: &E,
    options: &RansacOptions,
    guesses: &[E::Model],
) -> Option<Consensus<E::Model>> {
    let n = estimator.len();
    if n < E::SAMPLE {
        return None;
    }
    let mut rng = ChaCha8Rng::seed_from_u64(options.seed);
    let mut search = Search {
        estimator,
        threshold2: options.threshold * options.threshold,
        order: shuffled(n, &mut rng),
        best: None,
    };
    for guess in guesses {
        search.offer(guess.clone(), &mut rng);
    }
    let mut models = Vec::new();
    let mut sample = vec![0usize; E::SAMPLE];
    let mut needed = options.max_iterations;
    let mut iterations = 0;
    while iterations < needed.max(options.min_iterations).min(options.max_iterations) {
        iterations += 1;
        draw(n, &mut sample, &mut rng);
        models.clear();
        estimator.minimal(&sample, &mut models);
        for model in models.drain(..) {
            search.offer(model, &mut rng);
        }
        let ratio = search.best.as_ref().map_or(0.0, |b| b.inliers.len() as f64 / n as f64);
        needed = samples_needed(
            ratio.max(options.min_inlier_ratio),
            E::SAMPLE,
            options.confidence,
            options.max_iterations,
        );
    }
    let best = search.best?;
    Some(Consensus { iterations, ..best })
}

/// log(1 − p) / log(1 − w^s), at most `cap`.
fn samples_needed(ratio: f64, size: usize, confidence: f64, cap: usize) -> usize {
    let clean = ratio.clamp(0.0, 1.0).powi(size as i32);
    if clean >= 1.0 {
        return 1;
    }
    let needed = (1.0 - confidence).ln() / (-clean).ln_1p();
    if needed.is_finite() && needed < cap as f64 { needed.ceil() as usize } else { cap }
}

struct Search<'a, E: Estimator> {
    estimator: &'a E,
    threshold2: f64,
    /// A random scoring order, so that the first data are an unbiased sample.
    order: Vec<usize>,
    best: Option<Consensus<E::Model>>,
}

impl<E: Estimator> Search<'_, E> {
    /// Locally optimises a model and keeps it if it is the best so far.
    fn offer(&mut self, model: E::Model, rng: &mut ChaCha8Rng) {
        let Some(mut better) = self.score(model) else { return };
        let mut subset = vec![0usize; E::LOCAL_SAMPLE];
        for round in 0..=LOCAL_ROUNDS {
            // Random subsets first, all inliers last.
            let inliers = &better.inliers;
            if inliers.len() <= E::SAMPLE {
                break;
            }
            let sample: Vec<usize> = if round < LOCAL_ROUNDS && inliers.len() > E::LOCAL_SAMPLE {
                draw(inliers.len(), &mut subset, rng);
                subset.iter().map(|&k| inliers[k]).collect()
            } else {
                let stride = inliers.len().div_ceil(LOCAL_CAP);
                inliers.iter().copied().step_by(stride).collect()
            };
            let refined = self.estimator.refine(&better.model, &sample);
            if let Some(candidate) = refined.and_then(|m| self.score(m))
                && candidate.cost < better.cost
            {
                better = candidate;
            }
        }
        self.best = Some(better);
    }

    /// The score of a model; `None` if it is not better than the best.
    fn score(&self, model: E::Model) -> Option<Consensus<E::Model>> {
        let limit = self.best.as_ref().map_or(f64::INFINITY, |b| b.cost);
        let n = self.order.len();
        let expected = self.best.as_ref().map_or(0.0, |b| b.inliers.len() as f64 / n as f64);
        // Rejects a model whose inliers among the first data are four standard deviations below the best
        // model's share.
        let mean = expected * PROBE as f64;
        let fewest = (mean - 4.0 * mean.sqrt()).max(1.0) as usize;
        let mut inliers = Vec::new();
        let mut cost = 0.0;
        for (k, &i) in self.order.iter().enumerate() {
            let error2 = self.estimator.squared_error(&model, i);
            if error2 < self.threshold2 {
                inliers.push(i);
                cost += self.estimator.weight(i) * error2;
            } else {
                cost += self.estimator.weight(i) * self.threshold2;
            }
            let hopeless = k + 1 == PROBE && n > 2 * PROBE && inliers.len() < fewest;
            if cost >= limit || hopeless {
                return None;
            }
        }
        inliers.sort_unstable();
        Some(Consensus { model, inliers, cost, iterations: 0 })
    }
}

/// Distinct random indices below n; `sample` must not be longer than n.
fn draw(n: usize, sample: &mut [usize], rng: &mut ChaCha8Rng) {
    for k in 0..sample.len() {
        sample[k] = loop {
            let i = rng.random_range(0..n);
            if !sample[..k].contains(&i) {
                break i;
            }
        };
    }
}

fn shuffled(n: usize, rng: &mut ChaCha8Rng) -> Vec<usize> {
    let mut order: Vec<usize> = (0..n).collect();
    for k in (1..n).rev() {
        order.swap(k, rng.random_range(0..=k));
    }
    order
}

#[cfg(test)]
mod tests {
    use super::*;

    /// y = a x + b.
    struct Line(Vec<(f64, f64)>);

    impl Estimator for Line {
        type Model = (f64, f64);
        const SAMPLE: usize = 2;
        const LOCAL_SAMPLE: usize = 6;
        fn len(&self) -> usize {
            self.0.len()
        }
        fn minimal(&self, s: &[usize], out: &mut Vec<(f64, f64)>) {
            let (p, q) = (self.0[s[0]], self.0[s[1]]);
            let a = (q.1 - p.1) / (q.0 - p.0);
            out.push((a, p.1 - a * p.0));
        }
        fn squared_error(&self, m: &(f64, f64), i: usize) -> f64 {
            (self.0[i].1 - m.0 * self.0[i].0 - m.1).powi(2)
        }
        fn refine(&self, _: &(f64, f64), s: &[usize]) -> Option<(f64, f64)> {
            let n = s.len() as f64;
            let (mx, my) =
                s.iter().fold((0.0, 0.0), |m, &i| (m.0 + self.0[i].0, m.1 + self.0[i].1));
            let (mx, my) = (mx / n, my / n);
            let (sxy, sxx) = s.iter().fold((0.0, 0.0), |m, &i| {
                let dx = self.0[i].0 - mx;
                (m.0 + dx * (self.0[i].1 - my), m.1 + dx * dx)
            });
            Some((sxy / sxx, my - sxy / sxx * mx))
        }
    }

    fn data(n: usize, outliers: usize) -> Line {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        Line(
            (0..n)
                .map(|i| {
                    let x = rng.random_range(-10.0..10.0);
                    let noise = rng.random_range(-0.05..0.05);
                    let y =
                        if i < outliers { rng.random_range(-30.0..30.0) } else { 2.0 * x + 1.0 };
                    (x, y + noise)
                })
                .collect(),
        )
    }

    #[test]
    fn finds_the_line_under_outliers_the_same_way_twice() {
        let options = RansacOptions { threshold: 0.1, ..Default::default() };
        let line = data(1000, 800);
        let a = ransac(&line, &options, &[]).unwrap();
        let b = ransac(&line, &options, &[]).unwrap();
        assert!((a.model.0 - 2.0).abs() < 0.01 && (a.model.1 - 1.0).abs() < 0.05, "{:?}", a.model);
        assert!(a.inliers.len() >= 200);
        assert!(a.model == b.model && a.cost == b.cost && a.iterations == b.iterations);
    }

    #[test]
    fn stops_early_when_all_agree_and_late_when_few_do() {
        let options = RansacOptions { threshold: 0.1, min_iterations: 1, ..Default::default() };
        assert!(ransac(&data(100, 0), &options, &[]).unwrap().iterations < 10);
        assert!(ransac(&data(1000, 900), &options, &[]).unwrap().iterations > 200);
    }

    #[test]
    fn a_good_guess_wins_without_samples() {
        let options = RansacOptions {
            threshold: 0.1,
            min_iterations: 0,
            max_iterations: 0,
            ..Default::default()
        };
        assert!(ransac(&data(100, 50), &options, &[]).is_none());
        let found = ransac(&data(100, 50), &options, &[(2.0, 1.0)]).unwrap();
        assert!(found.inliers.len() >= 50);
    }

    #[test]
    fn too_few_data_give_none() {
        assert!(ransac(&data(1, 0), &RansacOptions::default(), &[]).is_none());
        assert!(ransac(&data(0, 0), &RansacOptions::default(), &[]).is_none());
    }
}
