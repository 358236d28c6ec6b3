//! Rounding of attributes to 16-bit floats.

use super::rotation;
use crate::types::Gaussians;

/// The nearest 16-bit float: 11 bits of mantissa, exponents from −14 to 15, below that steps of 2⁻²⁴;
/// ties to even; infinity beyond 65504.
pub fn half(x: f32) -> f32 {
    let wide = f64::from(x);
    if wide == 0.0 || !wide.is_finite() {
        return x;
    }
    let exponent = wide.abs().log2().floor().max(-14.0);
    let step = (exponent - 10.0).exp2();
    let rounded = (wide / step).round_ties_even() * step;
    if rounded.abs() > 65504.0 { f32::INFINITY.copysign(x) } else { rounded as f32 }
}

/// Gaussians with their spherical harmonics rounded, as
/// [`half_sh`](crate::types::Tuning::half_sh) keeps them.
pub fn harmonics(gaussians: &Gaussians) -> Gaussians {
    let sh = gaussians.sh.iter().map(|row| row.map(half)).collect();
    Gaussians { sh, ..gaussians.clone() }
}

/// Gaussians with log scales, opacity logits and unit quaternions rounded, as
/// [`half_shapes`](crate::types::Tuning::half_shapes) keeps them. A quaternion without a length
/// becomes zero.
pub fn shapes(gaussians: &Gaussians) -> Gaussians {
    let turned = |&q: &[f32; 4]| {
        let unit = rotation::unit(q.map(f64::from)).map_or([0.0; 4], |(unit, _)| unit);
        unit.map(|x| half(x as f32))
    };
    Gaussians {
        log_scales: gaussians.log_scales.iter().map(|row| row.map(half)).collect(),
        rotations: gaussians.rotations.iter().map(turned).collect(),
        opacity_logits: gaussians.opacity_logits.iter().map(|&x| half(x)).collect(),
        ..gaussians.clone()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Against the rounding that the host packs with.
    #[test]
    fn halves_are_the_nearest_16_bit_floats() {
        let mut value = 3e-9f32;
        while value < 1e5 {
            for x in [value, -value] {
                assert_eq!(half(x), ::half::f16::from_f32(x).to_f32(), "{x}");
            }
            value *= 1.0173;
        }
        // Ties go to even mantissas.
        assert_eq!(half(1.0 + 0.5 / 1024.0), 1.0);
        assert_eq!(half(1.0 + 1.5 / 1024.0), 1.0 + 2.0 / 1024.0);
    }
}
