//! Values of flags.

/// `320x180`.
pub fn size(text: &str) -> Result<(u32, u32), String> {
    let side = |text: &str| text.trim().parse().ok().filter(|side| (1..=65_535).contains(side));
    text.split_once(['x', 'X', '×'])
        .and_then(|(width, height)| Some((side(width)?, side(height)?)))
        .ok_or_else(|| "WIDTHxHEIGHT in pixels is expected, for example 640x360".to_string())
}

/// `r,g,b` in [0, 1], `black` or `white`.
pub fn colour(text: &str) -> Result<[f32; 3], String> {
    match text {
        "black" => return Ok([0.0; 3]),
        "white" => return Ok([1.0; 3]),
        _ => {}
    }
    let values: Vec<f32> = text
        .split(',')
        .filter_map(|v| v.trim().parse().ok())
        .filter(|v| (0.0..=1.0).contains(v))
        .collect();
    <[f32; 3]>::try_from(values).ok().filter(|_| text.split(',').count() == 3).ok_or_else(|| {
        "R,G,B in [0, 1] is expected, for example 1,1,1; or black, white".to_string()
    })
}

/// A number above zero.
pub fn positive(text: &str) -> Result<f64, String> {
    let value: Option<f64> = text.parse().ok();
    value
        .filter(|v| v.is_finite() && *v > 0.0)
        .ok_or_else(|| "a number above 0 is expected".to_string())
}

/// A number of 0 or above.
pub fn not_negative(text: &str) -> Result<f64, String> {
    let value: Option<f64> = text.parse().ok();
    value
        .filter(|v| v.is_finite() && *v >= 0.0)
        .ok_or_else(|| "a number of 0 or above is expected".to_string())
}

/// Times to render.
#[derive(Clone, Debug, PartialEq)]
pub enum Times {
    /// So many, evenly from 0 to 1.
    Evenly(usize),
    /// These.
    List(Vec<f64>),
}

impl Times {
    /// The times.
    pub fn values(&self) -> Vec<f64> {
        match self {
            Times::Evenly(count) => {
                (0..*count).map(|i| i as f64 / (*count - 1).max(1) as f64).collect()
            }
            Times::List(list) => list.clone(),
        }
    }
}

/// `0,0.25,1`, or a whole number above 1: so many times, evenly.
pub fn times(text: &str) -> Result<Times, String> {
    if let Ok(count) = text.parse::<usize>()
        && count > 1
    {
        return Ok(Times::Evenly(count));
    }
    let list: Option<Vec<f64>> = text
        .split(',')
        .map(|t| t.trim().parse().ok().filter(|t| (0.0..=1.0).contains(t)))
        .collect();
    list.map(Times::List).ok_or_else(|| {
        "times in [0, 1] are expected, for example 0,0.5,1; or a whole number above 1 for so many \
         times spread evenly"
            .to_string()
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes() {
        assert_eq!(size("320x180"), Ok((320, 180)));
        for bad in ["320", "0x5", "x", "-3x4", "3x4x5", "1e3x5", "99999x2"] {
            assert!(size(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn colours() {
        assert_eq!(colour("0,0.5,1"), Ok([0.0, 0.5, 1.0]));
        assert_eq!(colour("white"), Ok([1.0; 3]));
        for bad in ["", "1,1", "1,1,2", "1,1,1,x", "1,1,1,1", "NaN,0,0", "red"] {
            assert!(colour(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn lists_and_numbers_of_times() {
        assert_eq!(times("3").unwrap().values(), [0.0, 0.5, 1.0]);
        assert_eq!(times("0").unwrap().values(), [0.0]);
        assert_eq!(times("1").unwrap().values(), [1.0]);
        assert_eq!(times("0.25, 1").unwrap().values(), [0.25, 1.0]);
        for bad in ["", "-1", "0,2", "x", "1.5", "0,,1", "nan"] {
            assert!(times(bad).is_err(), "{bad}");
        }
    }
}
