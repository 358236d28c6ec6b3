//! Pictures in the formats of textures.
//!
//! A premultiplied pixel over what lies behind it is `c + (1 − α) · b`, alpha too; what is not finite
//! in it counts as nothing. Eight bits hold the nearest of 255 equal steps from 0 to 1, 16-bit floats
//! the nearest of theirs, and what is out of range the nearest that is in it.

use super::Real;
use super::half::half as nearest_half;

/// A pixel over what lies behind it.
pub fn over<R: Real>(rgba: [R; 4], background: [R; 4]) -> [R; 4] {
    let pixel = rgba.map(|value| if value.is_finite() { value } else { R::zero() });
    std::array::from_fn(|k| pixel[k] + (R::one() - pixel[3]) * background[k])
}

/// A channel in steps of eight bits, before it is rounded: in [0, 255].
pub fn level<R: Real>(value: R) -> R {
    value.max(R::zero()).min(R::one()) * R::of(255.0)
}

/// A channel in eight bits.
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
