//! Conversion of rendered images to texture formats.
//!
//! A premultiplied pixel over a background is `c + (1 − α) · b`, also for alpha; a value that is
//! not finite counts as zero. Eight bits hold the nearest of the 256 levels from 0 to 1, 16-bit
//! floats the nearest representable value; values out of range are clamped.

use super::Real;
use super::half::half as nearest_half;

/// A pixel composited over a background.
pub fn over<R: Real>(rgba: [R; 4], background: [R; 4]) -> [R; 4] {
    let pixel = rgba.map(|value| if value.is_finite() { value } else { R::zero() });
    std::array::from_fn(|k| pixel[k] + (R::one() - pixel[3]) * background[k])
}

/// A channel scaled to [0, 255], before rounding.
pub fn level<R: Real>(value: R) -> R {
    value.max(R::zero()).min(R::one()) * R::of(255.0)
}

/// A channel as an 8-bit value.
pub fn unorm8<R: Real>(value: R) -> u8 {
    level(value).f64().round() as u8
}

/// A channel as the nearest 16-bit float.
pub fn half<R: Real>(value: R) -> f32 {
    nearest_half(value.f64().clamp(-65504.0, 65504.0) as f32)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_level_is_its_own() {
        for level in 0..=255u8 {
            assert_eq!(unorm8(f64::from(level) / 255.0), level);
        }
        assert_eq!([unorm8(-0.2), unorm8(0.499 / 255.0), unorm8(0.501 / 255.0)], [0, 0, 1]);
        assert_eq!(unorm8(7.0), 255);
    }

    #[test]
    fn what_lies_behind_shows_through() {
        let behind = [0.5, 0.25, 1.0, 1.0];
        assert_eq!(over([0.0; 4], behind), behind);
        assert_eq!(over([0.25, 0.0, 0.5, 0.5], behind), [0.5, 0.125, 1.0, 1.0]);
        assert_eq!(over([f64::NAN, f64::INFINITY, 0.5, 1.0], behind), [0.0, 0.0, 0.5, 1.0]);
        assert_eq!([half(1e9), half(-1e9), half(0.1)], [65504.0, -65504.0, 0.099_975_586]);
    }
}
