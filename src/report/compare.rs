//! Comparison of two benchmark runs.

use super::spread::quantile;
use super::{Measurements, Spread};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::Serialize;

/// Minimum number of samples on each side for a verdict.
const LEAST_SAMPLES: usize = 5;
/// Number of bootstrap resamplings.
const RESAMPLINGS: usize = 2000;
/// Confidence level of the ratio's interval.
const SHARE: f64 = 0.95;

/// Verdict on B relative to A.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// B takes less time.
    Faster,
    /// B takes more time.
    Slower,
    /// The ratio's interval contains 1, or there are too few samples.
    Noise,
    /// Only one side has a time: the row is new, was removed, or missed its error bound.
    Incomparable,
}

/// Comparison of one row of A with the same row of B.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Comparison {
    /// Name of the row, or of the point of a sweep.
    pub name: String,
    /// B's median over A's.
    pub ratio: Option<f64>,
    /// 95 % bootstrap interval of that ratio.
    pub interval: Option<[f64; 2]>,
    /// The resulting verdict.
    pub verdict: Verdict,
}

/// Compares two runs row by row and point by point, in the order of A, followed by entries that only B has.
pub fn compare(a: &Measurements, b: &Measurements) -> Vec<Comparison> {
    let (first, second) = (named(a), named(b));
    let mut out: Vec<Comparison> = first
        .iter()
        .map(|(name, time)| {
            let other = second.iter().find(|(other, _)| other == name).and_then(|(_, t)| *t);
            judge(name, *time, other)
        })
        .collect();
    let new = second.iter().filter(|(name, _)| !first.iter().any(|(other, _)| other == name));
    out.extend(new.map(|(name, time)| judge(name, None, *time)));
    out
}

fn named(measured: &Measurements) -> Vec<(String, Option<&Spread>)> {
    let rows = measured.rows.iter().map(|row| (row.name(), row.time()));
    let points = measured.sweeps.iter().flat_map(|sweep| {
        let [width, height] = sweep.size;
        sweep.points.iter().map(move |point| {
            let knob = if point.knob.is_empty() { "best" } else { &point.knob };
            let name = format!("{}, {width}×{height}, {knob} {}", sweep.scene, point.value);
            (name, Some(&point.time))
        })
    });
    rows.chain(points).collect()
}

fn judge(name: &str, a: Option<&Spread>, b: Option<&Spread>) -> Comparison {
    let name = name.to_owned();
    let (Some(a), Some(b)) = (a, b) else {
        return Comparison { name, ratio: None, interval: None, verdict: Verdict::Incomparable };
    };
    if a.median() <= 0.0 {
        return Comparison { name, ratio: None, interval: None, verdict: Verdict::Noise };
    }
    let ratio = b.median() / a.median();
    let interval = bootstrap(a.samples(), b.samples());
    let enough = a.samples().len().min(b.samples().len()) >= LEAST_SAMPLES;
    let verdict = match interval {
        [_, high] if enough && high < 1.0 => Verdict::Faster,
        [low, _] if enough && low > 1.0 => Verdict::Slower,
        _ => Verdict::Noise,
    };
    Comparison { name, ratio: Some(ratio), interval: Some(interval), verdict }
}

/// Bootstrap interval of the ratio of medians, with resampling of both sides; deterministic for the same
/// samples.
fn bootstrap(a: &[f64], b: &[f64]) -> [f64; 2] {
    let mut rng = ChaCha8Rng::seed_from_u64(0);
    let mut median = |samples: &[f64]| {
        let mut drawn: Vec<f64> =
            (0..samples.len()).map(|_| samples[rng.random_range(0..samples.len())]).collect();
        drawn.sort_by(f64::total_cmp);
        quantile(&drawn, 0.5)
    };
    let mut ratios: Vec<f64> =
        (0..RESAMPLINGS).map(|_| median(b) / median(a).max(f64::MIN_POSITIVE)).collect();
    ratios.sort_by(f64::total_cmp);
    let tail = (1.0 - SHARE) / 2.0;
    [quantile(&ratios, tail), quantile(&ratios, 1.0 - tail)]
}
