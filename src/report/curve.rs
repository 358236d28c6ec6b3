//! Scaling of time and memory with one size.

use serde::{Deserialize, Serialize};

use super::{Accuracy, Clock, Spread};

/// Scaling measurements of one pipeline.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Curve {
    /// Name of the pipeline.
    pub pipeline: String,
    /// The quantity that is varied.
    pub axis: String,
    /// The quantities that are constant, in words.
    pub held: String,
    /// Clock of the times.
    pub clock: Clock,
    /// Error of the pipeline relative to the oracle at the smallest size; a pipeline that misses its bound
    /// has no times.
    pub accuracy: Accuracy,
    /// Points in ascending order of size.
    pub points: Vec<CurvePoint>,
}

/// Measurements at one size.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CurvePoint {
    /// Value of the varied quantity.
    pub size: u64,
    /// Time of an execution; `None` where it was not attempted.
    pub time: Option<Spread>,
    /// Predicted device memory, bytes; `None` where a binding would be too large.
    pub foreseen: Option<u64>,
    /// Measured peak of the device memory, bytes.
    pub taken: Option<u64>,
    /// Reason why it was not attempted.
    pub left_out: Option<String>,
    /// Time of each kernel in one execution, nanoseconds, in descending order.
    pub kernels: Vec<(String, f64)>,
}

/// A power law `factor · size ^ exponent`, fitted to points by least squares in logarithms.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct PowerLaw {
    /// The exponent: 1 for linear.
    pub exponent: f64,
    /// The value at size 1.
    pub factor: f64,
    /// Smallest and largest size.
    pub range: [u64; 2],
    /// Largest ratio between a point and the law, at least 1.
    pub off: f64,
}

impl PowerLaw {
    /// Fits points with positive sizes and values; `None` for fewer than two sizes.
    pub fn fit(points: &[(u64, f64)]) -> Option<PowerLaw> {
        let logs: Vec<(f64, f64)> =
            points.iter().map(|&(size, value)| ((size as f64).ln(), value.ln())).collect();
        let n = logs.len() as f64;
        let mean = |of: fn(&(f64, f64)) -> f64| logs.iter().map(of).sum::<f64>() / n;
        let (mx, my) = (mean(|p| p.0), mean(|p| p.1));
        let (mut xx, mut xy) = (0.0, 0.0);
        for (x, y) in &logs {
            (xx, xy) = (xx + (x - mx).powi(2), xy + (x - mx) * (y - my));
        }
        let (exponent, least) = (xy / xx, points.iter().map(|p| p.0).min()?);
        let factor = (my - exponent * mx).exp();
        let finite = exponent.is_finite() && factor.is_finite();
        let off = |(size, value): &(u64, f64)| {
            let ratio = value / (factor * (*size as f64).powf(exponent));
            ratio.max(1.0 / ratio)
        };
        finite.then(|| PowerLaw {
            exponent,
            factor,
            range: [least, points.iter().map(|p| p.0).max().unwrap_or(least)],
            off: points.iter().map(off).fold(1.0, f64::max),
        })
    }

    /// Value of the law at a size.
    pub fn at(&self, size: f64) -> f64 {
        self.factor * size.powf(self.exponent)
    }
}

impl Curve {
    /// Sizes and median times in nanoseconds.
    pub fn times(&self) -> Vec<(u64, f64)> {
        let timed = |p: &CurvePoint| Some((p.size, p.time.as_ref()?.median()));
        self.points.iter().filter_map(timed).collect()
    }

    /// Sizes and device memory in bytes: measured where available, else predicted.
    pub fn bytes(&self) -> Vec<(u64, f64)> {
        let known = |p: &CurvePoint| Some((p.size, p.taken.or(p.foreseen)? as f64));
        self.points.iter().filter_map(known).collect()
    }

    /// Power law of the times.
    pub fn time_law(&self) -> Option<PowerLaw> {
        PowerLaw::fit(&self.times())
    }

    /// Power law of the device memory.
    pub fn memory_law(&self) -> Option<PowerLaw> {
        PowerLaw::fit(&self.bytes())
    }

    /// Power law between the two largest measured sizes, where constant costs weigh least.
    pub fn last_law(&self) -> Option<PowerLaw> {
        let times = self.times();
        PowerLaw::fit(&times[times.len().checked_sub(2)?..])
    }

    /// Kernels that take more than a twentieth of the time at the largest size and whose exponent between
    /// the two largest sizes exceeds `exponent`: each with that exponent and its share of the time.
    pub fn steeper_than(&self, exponent: f64) -> Vec<(&str, f64, f64)> {
        let timed: Vec<&CurvePoint> =
            self.points.iter().filter(|p| p.time.is_some() && !p.kernels.is_empty()).collect();
        let [.., before, last] = timed.as_slice() else { return Vec::new() };
        let sum: f64 = last.kernels.iter().map(|(_, time)| time).sum();
        let steep = |(kernel, time): &'_ (String, f64)| {
            let (_, earlier) = before.kernels.iter().find(|(name, _)| name == kernel)?;
            let law = PowerLaw::fit(&[(before.size, *earlier), (last.size, *time)])?;
            let share = time / sum;
            (law.exponent > exponent && share > 0.05).then_some((law.exponent, share))
        };
        let found = last.kernels.iter();
        found.filter_map(|k| steep(k).map(|(e, share)| (k.0.as_str(), e, share))).collect()
    }
}
