//! Repeated timings and their statistics.

use serde::{Deserialize, Serialize};

/// Repeated timings of the same work, in nanoseconds, ascending; at least one.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "Vec<f64>", into = "Vec<f64>")]
pub struct Spread {
    samples: Vec<f64>,
}

impl Spread {
    /// Makes the statistics from samples in any order; `None` without samples, or if one is not finite.
    pub fn new(mut samples: Vec<f64>) -> Option<Spread> {
        if samples.is_empty() || samples.iter().any(|s| !s.is_finite() || *s < 0.0) {
            return None;
        }
        samples.sort_by(f64::total_cmp);
        Some(Spread { samples })
    }

    /// The samples in ascending order, nanoseconds.
    pub fn samples(&self) -> &[f64] {
        &self.samples
    }

    /// The quantile at `share`, with linear interpolation between neighbouring samples.
    pub fn quantile(&self, share: f64) -> f64 {
        quantile(&self.samples, share)
    }

    /// The median.
    pub fn median(&self) -> f64 {
        self.quantile(0.5)
    }

    /// The lower and the upper quartile.
    pub fn quartiles(&self) -> [f64; 2] {
        [self.quantile(0.25), self.quantile(0.75)]
    }
}

/// [`Spread::quantile`] of ascending samples; at least one.
pub(super) fn quantile(ascending: &[f64], share: f64) -> f64 {
    let at = share.clamp(0.0, 1.0) * (ascending.len() - 1) as f64;
    let (low, high) = (ascending[at.floor() as usize], ascending[at.ceil() as usize]);
    low + (high - low) * at.fract()
}

impl TryFrom<Vec<f64>> for Spread {
    type Error = &'static str;

    fn try_from(samples: Vec<f64>) -> Result<Spread, &'static str> {
        Spread::new(samples).ok_or("times must be finite numbers of nanoseconds, at least one")
    }
}

impl From<Spread> for Vec<f64> {
    fn from(spread: Spread) -> Vec<f64> {
        spread.samples
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_lie_between_neighbours() {
        let spread = Spread::new(vec![4.0, 1.0, 3.0, 2.0]).unwrap();
        assert_eq!(spread.samples(), [1.0, 2.0, 3.0, 4.0]);
        assert_eq!(spread.median(), 2.5);
        assert_eq!(spread.quartiles(), [1.75, 3.25]);
        assert_eq!(spread.quantile(1.0), 4.0);
        assert_eq!(Spread::new(vec![7.0]).unwrap().quartiles(), [7.0, 7.0]);
    }

    #[test]
    fn what_is_no_time_is_refused() {
        for bad in [vec![], vec![f64::NAN], vec![1.0, f64::INFINITY], vec![-1.0]] {
            assert_eq!(Spread::new(bad), None);
        }
        assert!(serde_json::from_str::<Spread>("[]").is_err());
    }
}
