//! Parsers of option values, and the range of every number. A new option uses one of these parsers.

use std::net::{IpAddr, Ipv4Addr};
use std::ops::RangeInclusive;

use super::common::thousands;

/// Maximum side of an image, pixels: PNG and EXR support more, but 16 bits address all of these.
pub const MOST_PIXELS: u64 = 65_535;
/// Maximum number of images of a clip, a dataset or a folder: nine hours of video.
pub const MOST_PICTURES: u64 = 1_000_000;
/// Maximum number of training steps: three hundred times that of papers. Schedules iterate over all of them
/// in advance.
pub const MOST_STEPS: u64 = 10_000_000;
/// Maximum number of Gaussians: with four (splat, tile) pairs each, indices still fit into 32 bits.
pub const MOST_GAUSSIANS: u64 = 1_000_000_000;
/// Maximum number of initial points: each needs about a kilobyte of host memory.
pub const MOST_POINTS: u64 = 100_000_000;
/// Maximum number of control points: as many as a small scene has Gaussians, and a thousand times the
/// default.
pub const MOST_CONTROL_POINTS: u64 = 1_000_000;
/// Maximum focal length, pixels: beyond, f32 cannot distinguish adjacent pixels.
pub const MOST_FOCAL: f64 = 16_777_216.0;
/// Maximum of any duration, seconds: about thirty years.
pub const MOST_SECONDS: f64 = 1e9;

/// A parser of integers within a range; its message names the range.
pub fn whole<T: TryFrom<u64>>(
    range: RangeInclusive<u64>,
) -> impl Fn(&str) -> Result<T, String> + Clone + Send + Sync + 'static {
    move |text| {
        let value = text.parse().ok().filter(|value| range.contains(value));
        value.and_then(|value| T::try_from(value).ok()).ok_or_else(|| {
            let [least, most] = [range.start(), range.end()].map(|end| thousands(*end as usize));
            format!("a whole number from {least} to {most} is expected")
        })
    }
}

/// A parser of numbers within a range; its message names the range.
pub fn number(
    range: RangeInclusive<f64>,
) -> impl Fn(&str) -> Result<f64, String> + Clone + Send + Sync + 'static {
    move |text| {
        // NaN is in no range.
        let value = text.parse().ok().filter(|value| range.contains(value));
        value.ok_or_else(|| {
            let [least, most] = [range.start(), range.end()].map(|end| short(*end));
            format!("a number from {least} to {most} is expected")
        })
    }
}

/// A number without long runs of zeros.
fn short(number: f64) -> String {
    let plain = number == 0.0 || (1e-4..1e9).contains(&number);
    if plain { format!("{number}") } else { format!("{number:e}") }
}

/// Parses a size such as `320x180`.
pub fn size(text: &str) -> Result<(u32, u32), String> {
    let most = MOST_PIXELS as u32;
    let side = |text: &str| text.trim().parse().ok().filter(|side| (1..=most).contains(side));
    text.split_once(['x', 'X', '×'])
        .and_then(|(width, height)| Some((side(width)?, side(height)?)))
        .ok_or_else(|| {
            format!(
                "WIDTHxHEIGHT in pixels is expected, for example 640x360; up to {} a side",
                thousands(most as usize)
            )
        })
}

/// Parses a port to listen on. Any word after `--view` is parsed as one.
pub fn port(text: &str) -> Result<u16, String> {
    whole::<u16>(1..=65_535)(text).map_err(|expected| {
        format!("as a port {expected}; without one put `--view` after the other words")
    })
}

/// Parses an address to listen on: numeric, or `localhost`.
pub fn host(text: &str) -> Result<IpAddr, String> {
    let number = text.trim_start_matches('[').trim_end_matches(']');
    match text.eq_ignore_ascii_case("localhost") {
        true => Ok(Ipv4Addr::LOCALHOST.into()),
        false => number.parse().map_err(|_| {
            "an address of this machine is expected, for example 127.0.0.1, or 0.0.0.0 for all of them"
                .into()
        }),
    }
}

/// Parses `r,g,b` in [0, 1], `black` or `white`.
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

/// Times to render.
#[derive(Clone, Debug, PartialEq)]
pub enum Times {
    /// A number of times, evenly from 0 to 1.
    Evenly(usize),
    /// A list of times.
    List(Vec<f64>),
}

impl Times {
    /// Number of times.
    pub fn len(&self) -> usize {
        match self {
            Times::Evenly(count) => *count,
            Times::List(list) => list.len(),
        }
    }

    /// The time at an index.
    ///
    /// # Panics
    /// If a list has no such index.
    pub fn at(&self, index: usize) -> f64 {
        match self {
            Times::Evenly(count) => index as f64 / (*count - 1).max(1) as f64,
            Times::List(list) => list[index],
        }
    }
}

/// Parses `0,0.25,1`, or an integer above 1 for that many evenly spaced times.
pub fn times(text: &str) -> Result<Times, String> {
    if let Ok(count) = text.parse::<u64>()
        && (2..=MOST_PICTURES).contains(&count)
    {
        return Ok(Times::Evenly(count as usize));
    }
    let list: Option<Vec<f64>> = text
        .split(',')
        .map(|t| t.trim().parse().ok().filter(|t| (0.0..=1.0).contains(t)))
        .collect();
    list.map(Times::List).ok_or_else(|| {
        format!(
            "times in [0, 1] are expected, for example 0,0.5,1; or a whole number from 2 to {} \
             for so many times spread evenly",
            thousands(MOST_PICTURES as usize)
        )
    })
}

/// Parses a container image's name, `registry/name:tag`.
pub fn image(text: &str) -> Result<String, String> {
    let fits = |c: char| c.is_ascii_alphanumeric() || "._-/:@".contains(c);
    match !text.is_empty() && text.len() <= 500 && text.chars().all(fits) {
        true => Ok(text.into()),
        false => Err("an image is expected, for example registry/splat4d:1.0".into()),
    }
}

/// Parses the name of a claim: a DNS-1123 subdomain.
pub fn claim(text: &str) -> Result<String, String> {
    let fits = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit();
    let part = |part: &str| {
        part.starts_with(fits) && part.ends_with(fits) && part.chars().all(|c| fits(c) || c == '-')
    };
    match text.len() <= 253 && text.split('.').all(part) {
        true => Ok(text.into()),
        false => {
            Err("lower-case letters, digits, `-` and `.` are expected, as Kubernetes has it".into())
        }
    }
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
    fn hosts() {
        for (text, expected) in
            [("127.0.0.1", "127.0.0.1"), ("localhost", "127.0.0.1"), ("[::1]", "::1"), ("::", "::")]
        {
            assert_eq!(host(text), Ok(expected.parse().unwrap()), "{text}");
        }
        for bad in ["", "127.0.0", "example.com", "127.0.0.1:80", "127.0.0.256"] {
            assert!(host(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn ports() {
        assert_eq!((port("1"), port("65535")), (Ok(1), Ok(65_535)));
        for bad in ["0", "65536", "-1", "captures/fox", ""] {
            let message = port(bad).unwrap_err();
            assert!(message.contains("from 1 to 65,535") && message.contains("after"), "{message}");
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
    fn ranges_are_named() {
        let count = whole::<u32>(1..=1_000_000);
        assert_eq!(count("1000000"), Ok(1_000_000));
        for bad in ["0", "1000001", "-1", "1.5", "1e3", "", "x", "18446744073709551616"] {
            let message = count(bad).unwrap_err();
            assert_eq!(message, "a whole number from 1 to 1,000,000 is expected", "{bad}");
        }
        assert!(whole::<u8>(0..=1000)("256").is_err(), "what the type does not hold");
        let share = number(0.0..=1.0);
        assert_eq!(
            [0.0, 0.01, 1000.0, 1e-30, 1e9].map(short),
            ["0", "0.01", "1000", "1e-30", "1e9"]
        );
        assert_eq!((share("0"), share("1e-3")), (Ok(0.0), Ok(0.001)));
        for bad in ["-0.1", "1.1", "nan", "inf", "-inf", "1e300", "", "x"] {
            assert_eq!(share(bad).unwrap_err(), "a number from 0 to 1 is expected", "{bad}");
        }
    }

    #[test]
    fn lists_and_numbers_of_times() {
        let values = |text: &str| {
            let times = times(text).unwrap();
            (0..times.len()).map(|i| times.at(i)).collect::<Vec<f64>>()
        };
        assert_eq!(values("3"), [0.0, 0.5, 1.0]);
        assert_eq!(values("0"), [0.0]);
        assert_eq!(values("1"), [1.0]);
        assert_eq!(values("0.25, 1"), [0.25, 1.0]);
        for bad in ["", "-1", "0,2", "x", "1.5", "0,,1", "nan", "1000001", "10000000000"] {
            assert!(times(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn images_and_claims() {
        for good in ["splat4d", "registry:5000/a/splat4d@sha256:0f"] {
            assert_eq!(image(good), Ok(good.into()));
        }
        for bad in ["", "a b", "a\nb"] {
            assert!(image(bad).is_err(), "{bad}");
        }
        for bad in ["", "A", "a_b", "-a", "a-", "a..b"] {
            assert!(claim(bad).is_err(), "{bad}");
        }
    }
}
