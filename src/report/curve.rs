//! Time and memory as one size grows.

use serde::{Deserialize, Serialize};

use super::{Accuracy, Clock, Spread};

/// One pipeline, measured at several sizes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Curve {
    /// What runs.
    pub pipeline: String,
    /// What grows.
    pub axis: String,
    /// What does not, in words.
    pub held: String,
    /// What the times were read from.
    pub clock: Clock,
    /// How far the pipeline lies from the oracle at the smallest size; one that misses its bound has no
    /// times.
    pub accuracy: Accuracy,
    /// By size, ascending.
    pub points: Vec<CurvePoint>,
}

/// One size.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CurvePoint {
    /// The size.
    pub size: u64,
    /// Time of an execution; `None` where it was not attempted.
    pub time: Option<Spread>,
    /// Device memory as foreseen, bytes; `None` where a binding would be too large.
    pub foreseen: Option<u64>,
    /// Device memory as taken at most, bytes.
    pub taken: Option<u64>,
    /// Why it was not attempted.
    pub left_out: Option<String>,
    /// Nanoseconds of each kernel in one execution, the dearest first.
    pub kernels: Vec<(String, f64)>,
}

/// `factor · size ^ exponent`, through points by least squares of the logarithms.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct PowerLaw {
    /// The exponent: 1 for linear.
    pub exponent: f64,
    /// The value at size 1.
    pub factor: f64,
    /// Smallest and largest size.
    pub range: [u64; 2],
    /// Largest ratio of a point and the law, above 1.
    pub off: f64,
}

impl PowerLaw {
    /// Through some points with positive sizes and values; `None` for fewer than two sizes.
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

    /// Its value at a size.
    pub fn at(&self, size: f64) -> f64 {
        self.factor * size.powf(self.exponent)
    }
}

impl Curve {
    /// Sizes and median times, nanoseconds.
    pub fn times(&self) -> Vec<(u64, f64)> {
        let timed = |p: &CurvePoint| Some((p.size, p.time.as_ref()?.median()));
        self.points.iter().filter_map(timed).collect()
    }

    /// Sizes and bytes: taken where it was measured, else foreseen.
    pub fn bytes(&self) -> Vec<(u64, f64)> {
        let known = |p: &CurvePoint| Some((p.size, p.taken.or(p.foreseen)? as f64));
        self.points.iter().filter_map(known).collect()
    }

    /// The law of the times.
    pub fn time_law(&self) -> Option<PowerLaw> {
        PowerLaw::fit(&self.times())
    }

    /// The law of the bytes.
    pub fn memory_law(&self) -> Option<PowerLaw> {
        PowerLaw::fit(&self.bytes())
    }

    /// The law between the two largest sizes that were timed, where constant costs weigh least.
    pub fn last_law(&self) -> Option<PowerLaw> {
        let times = self.times();
        PowerLaw::fit(&times[times.len().checked_sub(2)?..])
    }

    /// Kernels that take more than a twentieth of the largest size's time and grow faster than
    /// `exponent` between the two largest sizes: each with that exponent and its share.
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
