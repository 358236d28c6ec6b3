//! Number formatting for people, and non-finite numbers in JSON.

/// A duration in the largest unit that gives a number above 1, with three significant digits.
pub fn duration(nanoseconds: f64) -> String {
    let units = [(1e9, "s"), (1e6, "ms"), (1e3, "µs"), (1.0, "ns")];
    let (size, unit) = units.into_iter().find(|(size, _)| nanoseconds >= *size).unwrap_or(units[3]);
    format!("{} {unit}", digits(nanoseconds / size))
}

/// A rate with a decimal prefix: `12.3 GB/s` for a unit of `B`.
pub fn rate(per_second: f64, unit: &str) -> String {
    let prefixes = [(1e12, "T"), (1e9, "G"), (1e6, "M"), (1e3, "k"), (1.0, "")];
    let (size, prefix) =
        prefixes.into_iter().find(|(size, _)| per_second >= *size).unwrap_or(prefixes[4]);
    format!("{} {prefix}{unit}/s", digits(per_second / size))
}

/// Three significant digits.
fn digits(value: f64) -> String {
    match value {
        v if v >= 99.95 => format!("{v:.0}"),
        v if v >= 9.995 => format!("{v:.1}"),
        v => format!("{v:.2}"),
    }
}

/// An error: 0, or two digits and a power of ten; `∞` for a non-finite value.
pub fn scientific(value: f64) -> String {
    match value {
        0.0 => "0".into(),
        v if v.is_finite() => format!("{v:.1e}"),
        _ => "∞".into(),
    }
}

/// JSON has no infinity, so it is written as `null`.
pub(super) mod maybe_infinite {
    use serde::{Deserialize, Deserializer, Serialize, Serializer};

    pub fn serialize<S: Serializer>(value: &f64, serializer: S) -> Result<S::Ok, S::Error> {
        value.is_finite().then_some(*value).serialize(serializer)
    }

    pub fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
        Ok(Option::<f64>::deserialize(deserializer)?.unwrap_or(f64::INFINITY))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_have_three_digits_and_a_unit() {
        assert_eq!(duration(0.4), "0.40 ns");
        assert_eq!(duration(1234.0), "1.23 µs");
        assert_eq!(duration(56_780_000.0), "56.8 ms");
        assert_eq!(duration(2.5e12), "2500 s");
        assert_eq!(rate(1.234e10, "B"), "12.3 GB/s");
        assert_eq!(rate(12.0, "op"), "12.0 op/s");
        assert_eq!(scientific(0.000_123), "1.2e-4");
        assert_eq!(scientific(f64::NAN), "∞");
    }
}
