//! Comparison of results with the oracle, summarised as one [`Accuracy`].

use crate::check::{Bound, Finding};
use crate::report::Accuracy;

/// Collects comparisons; the one with the largest error relative to its bound is reported.
pub(super) struct Check {
    worst: Accuracy,
}

impl Check {
    pub(super) fn new() -> Check {
        Check { worst: Accuracy { of_bound: 0.0, error: 0.0, output: "nothing compared".into() } }
    }

    /// The comparisons of a workload.
    pub(super) fn of(findings: &[Finding]) -> Check {
        let mut check = Check::new();
        for finding in findings {
            check.note(&finding.output, finding.worst_of_bound, finding.worst_absolute);
        }
        check
    }

    pub(super) fn accuracy(self) -> Accuracy {
        self.worst
    }

    /// Requires every value to be within the bound.
    pub(super) fn close(&mut self, output: &str, device: &[f32], truth: &[f64], bound: Bound) {
        self.mostly(output, device, truth, bound, 0.0, bound);
    }

    /// Requires all values except a fraction to be within `bound`, and the rest within `loose`.
    /// Values can jump where rounding decides whether a splat contributes to a pixel.
    pub(super) fn mostly(
        &mut self,
        output: &str,
        device: &[f32],
        truth: &[f64],
        bound: Bound,
        strays: f64,
        loose: Bound,
    ) {
        if device.len() != truth.len() {
            return self.note(output, f64::INFINITY, f64::INFINITY);
        }
        let (mut of_tight, mut of_loose, mut error) = (Vec::new(), 0.0f64, 0.0f64);
        for (&value, &truth) in device.iter().zip(truth) {
            let difference = (f64::from(value) - truth).abs();
            // NaN must fail.
            let difference = if difference.is_nan() { f64::INFINITY } else { difference };
            of_tight.push(share(difference, truth, bound));
            of_loose = of_loose.max(share(difference, truth, loose));
            error = error.max(difference);
        }
        of_tight.sort_by(f64::total_cmp);
        let kept = ((1.0 - strays) * of_tight.len() as f64).ceil() as usize;
        let tight = kept.checked_sub(1).map_or(0.0, |last| of_tight[last]);
        self.note(output, tight.max(of_loose), error);
    }

    /// Compares integers, or other types with equality.
    pub(super) fn exact<T: PartialEq>(&mut self, output: &str, device: &[T], truth: &[T]) {
        let error = if device == truth { 0.0 } else { f64::INFINITY };
        self.note(output, error, error);
    }

    fn note(&mut self, output: &str, of_bound: f64, error: f64) {
        let first = self.worst.output == "nothing compared";
        if first || of_bound > self.worst.of_bound {
            self.worst = Accuracy { of_bound, error, output: output.into() };
        }
    }
}

fn share(difference: f64, truth: f64, bound: Bound) -> f64 {
    if difference == 0.0 {
        return 0.0;
    }
    difference / (bound.absolute + bound.relative * truth.abs())
}

#[cfg(test)]
mod tests {
    use super::*;

    const BOUND: Bound = Bound { absolute: 0.1, relative: 0.0 };
    const LOOSE: Bound = Bound { absolute: 1.0, relative: 0.0 };

    #[test]
    fn the_worst_comparison_speaks() {
        let mut check = Check::new();
        check.exact("a", &[1u32], &[1]);
        check.close("b", &[1.05, 2.0], &[1.0, 2.0], BOUND);
        check.close("c", &[1.01], &[1.0], BOUND);
        let found = check.accuracy();
        assert_eq!(found.output, "b");
        assert!((found.of_bound - 0.5).abs() < 1e-6 && found.passed());
    }

    #[test]
    fn what_is_wrong_never_passes() {
        for (device, truth) in
            [(vec![f32::NAN], vec![0.0]), (vec![0.0], vec![0.2]), (vec![0.0], vec![0.0, 0.0])]
        {
            let mut check = Check::new();
            check.close("x", &device, &truth, BOUND);
            assert!(!check.accuracy().passed());
        }
        let mut check = Check::new();
        check.exact("x", &[1], &[2]);
        assert!(!check.accuracy().passed());
    }

    #[test]
    fn strays_are_few_and_not_far() {
        let truth = vec![0.0; 100];
        let with = |strays: usize, value: f32| {
            let mut device = vec![0.0f32; 100];
            device[..strays].fill(value);
            let mut check = Check::new();
            check.mostly("x", &device, &truth, BOUND, 0.02, LOOSE);
            check.accuracy().passed()
        };
        assert!(with(2, 0.9));
        assert!(!with(3, 0.9), "too many");
        assert!(!with(1, 1.1), "too far");
    }
}
