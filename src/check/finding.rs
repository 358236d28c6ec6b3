//! The comparison of one output with its reference: the error, and whether it is within its bound.

use std::fmt::Debug;

/// The error bound of an output: `absolute + relative · |truth|`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bound {
    /// Absolute part, in the unit of the output.
    pub absolute: f64,
    /// Relative part, as a fraction of the true value.
    pub relative: f64,
}

impl Bound {
    /// A bound of zero: exact equality.
    pub const ZERO: Bound = Bound { absolute: 0.0, relative: 0.0 };
}

/// The comparison of one output with its true value.
#[derive(Clone, Debug)]
pub struct Finding {
    /// Name of the output.
    pub output: String,
    /// Number of values.
    pub count: usize,
    /// The error bound; `None` if equality is required.
    pub bound: Option<Bound>,
    /// Largest difference from the oracle in f64.
    pub worst_absolute: f64,
    /// Largest difference as a fraction of the true value.
    pub worst_relative: f64,
    /// Largest difference in units of the last place of the true value as f32, among the values
    /// whose bound is mostly relative, since the unit is not meaningful near 0. `None` without such
    /// values.
    pub worst_ulp: Option<f64>,
    /// Largest difference as a fraction of the bound; above 1 the comparison fails.
    pub worst_of_bound: f64,
    /// Index of the value with the largest fraction of its bound.
    pub worst_at: usize,
    /// What the device gave at this index, as text; "none" if it gave fewer values.
    pub got: String,
    /// The true value at this index, as text; "none" if there are fewer.
    pub expected: String,
    /// Largest difference between the oracle in f32 and in f64, if the f32 result was given.
    pub oracle_f32_absolute: Option<f64>,
    /// The same as a fraction of the bound; above 1, f32 itself cannot meet the bound.
    pub oracle_f32_of_bound: Option<f64>,
    /// Whether all values stay within the bound.
    pub passed: bool,
}

/// Compares for equality, element by element.
pub(super) fn exact<T: PartialEq + Debug>(output: &str, device: &[T], truth: &[T]) -> Finding {
    let wrong = (0..device.len().max(truth.len())).find(|&i| device.get(i) != truth.get(i));
    let worst = if wrong.is_some() { f64::INFINITY } else { 0.0 };
    Finding {
        output: output.to_owned(),
        count: truth.len(),
        bound: None,
        worst_absolute: worst,
        worst_relative: worst,
        worst_ulp: None,
        worst_of_bound: worst,
        worst_at: wrong.unwrap_or(0),
        got: text_at(device, wrong.unwrap_or(0)),
        expected: text_at(truth, wrong.unwrap_or(0)),
        oracle_f32_absolute: None,
        oracle_f32_of_bound: None,
        passed: wrong.is_none(),
    }
}

/// Compares floats with the oracle in f64. NaN fails, and so does an infinity that differs from the
/// true value.
pub(super) fn close(output: &str, values: &[f32], truth: &[f64], bound: Bound) -> Finding {
    compare(output, values, truth, |_| bound)
}

/// Compares floats with an individual error limit per value. The finding's bound is the limit of
/// the value that comes closest to its limit.
pub(super) fn within(output: &str, values: &[f32], truth: &[f64], limits: &[f64]) -> Finding {
    compare(output, values, truth, |at| Bound { absolute: limits[at], relative: 0.0 })
}

fn compare(
    output: &str,
    values: &[f32],
    truth: &[f64],
    bound_at: impl Fn(usize) -> Bound,
) -> Finding {
    let mut finding = Finding {
        output: output.to_owned(),
        count: truth.len(),
        bound: Some(if truth.is_empty() { Bound::ZERO } else { bound_at(0) }),
        worst_absolute: 0.0,
        worst_relative: 0.0,
        worst_ulp: None,
        worst_of_bound: if values.len() == truth.len() { 0.0 } else { f64::INFINITY },
        worst_at: if values.len() == truth.len() { 0 } else { values.len().min(truth.len()) },
        got: String::new(),
        expected: String::new(),
        oracle_f32_absolute: None,
        oracle_f32_of_bound: None,
        passed: false,
    };
    for (at, (&value, &truth)) in values.iter().zip(truth).enumerate() {
        let difference = (f64::from(value) - truth).abs();
        let difference = if f64::from(value) == truth { 0.0 } else { difference };
        let difference = if difference.is_nan() { f64::INFINITY } else { difference };
        let bound = bound_at(at);
        let share = difference / (bound.absolute + bound.relative * truth.abs());
        // A quotient of infinities, or of NaN, counts as a failure.
        let share = if share.is_nan() { f64::INFINITY } else { share };
        let share = if difference == 0.0 { 0.0 } else { share };
        finding.worst_absolute = finding.worst_absolute.max(difference);
        finding.worst_relative = finding.worst_relative.max(difference / truth.abs().max(1e-300));
        if bound.relative * truth.abs() > bound.absolute {
            let ulp = difference / last_place(truth);
            finding.worst_ulp = Some(finding.worst_ulp.map_or(ulp, |worst| worst.max(ulp)));
        }
        if share > finding.worst_of_bound {
            finding.worst_of_bound = share;
            finding.worst_at = at;
            finding.bound = Some(bound);
        }
    }
    finding.passed = finding.worst_of_bound <= 1.0;
    finding.got = text_at(values, finding.worst_at);
    finding.expected = text_at(truth, finding.worst_at);
    finding
}

/// The value at an index as text from which it can be read back.
fn text_at<T: Debug>(values: &[T], at: usize) -> String {
    values.get(at).map_or("none".to_owned(), |value| format!("{value:?}"))
}

/// The distance from a number, as f32, to the next larger f32.
fn last_place(truth: f64) -> f64 {
    let value = (truth.abs() as f32).min(f32::MAX);
    f64::from(f32::from_bits(value.to_bits() + 1).min(f32::MAX))
        - f64::from(value.min(f32::MAX.next_down()))
}

#[cfg(test)]
mod tests {
    use super::*;

    const BOUND: Bound = Bound { absolute: 1e-6, relative: 1e-3 };

    #[test]
    fn only_what_is_near_the_truth_passes() {
        let passes = |value: f32, truth: f64| close("x", &[value], &[truth], BOUND).passed;
        assert!(passes(1.0005, 1.0) && !passes(1.002, 1.0));
        assert!(passes(5e-7, 0.0) && !passes(2e-6, 0.0));
        assert!(passes(f32::INFINITY, f64::INFINITY));
        assert!(!passes(f32::NAN, 1.0) && !passes(1.0, f64::NAN) && !passes(f32::NAN, f64::NAN));
        assert!(!passes(f32::INFINITY, 1.0) && !passes(f32::NEG_INFINITY, f64::INFINITY));
        assert!(!close("x", &[1.0], &[1.0, 2.0], BOUND).passed, "a length that differs");
        assert!(!exact("x", &[1u32], &[1, 2]).passed && exact("x", &[1u32], &[1]).passed);
    }

    #[test]
    fn a_finding_has_the_two_values_at_its_place() {
        let seen = |f: Finding| (f.worst_at, f.got, f.expected);
        let of = |at: usize, got: &str, expected: &str| (at, got.to_owned(), expected.to_owned());
        let found = close("x", &[1.0, 0.1, 3.0], &[1.0, f64::from(0.3f32), 3.0], BOUND);
        assert_eq!(seen(found), of(1, "0.1", "0.30000001192092896"));
        assert_eq!(seen(close("x", &[f32::NAN], &[1.0], BOUND)), of(0, "NaN", "1.0"));
        assert_eq!(seen(close("x", &[1.0], &[1.0, 2.0], BOUND)), of(1, "none", "2.0"));
        assert_eq!(
            seen(exact("x", &[[1, 2], [3, 4]], &[[1, 2], [3, 5]])),
            of(1, "[3, 4]", "[3, 5]")
        );
        assert_eq!(seen(exact("x", &[7u32, 8], &[7])), of(1, "8", "none"));
    }

    #[test]
    fn units_in_the_last_place() {
        let ulp = |value: f32, truth: f64| close("x", &[value], &[truth], BOUND).worst_ulp;
        assert_eq!(ulp(1.0f32.next_up(), 1.0), Some(1.0));
        assert_eq!(ulp(1e30f32.next_up().next_up(), f64::from(1e30f32)), Some(2.0));
        assert_eq!(ulp(1e-9, 0.0), None, "around 0 the bound is absolute");
        assert!(ulp(f32::MAX, f64::from(f32::MAX)).is_some_and(|ulp| ulp == 0.0));
        assert!(ulp(f32::INFINITY, f64::from(f32::MAX)).is_some_and(f64::is_infinite));
    }
}
