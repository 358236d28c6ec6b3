//! Adam (Kingma and Ba 2015) with bias correction.

use super::Real;
use crate::types::AdamSettings;

/// Gradients are clamped to ± this: its square, summed, is still a finite f32, so one huge gradient
/// cannot freeze a parameter permanently through an infinite second moment.
pub const LARGEST_GRADIENT: f64 = 1e18;

/// One step, in place. `row` values belong to each row; with `visible`, rows whose entry is 0 keep
/// parameters and moments. A gradient that is NaN or infinite leaves its parameter and moments
/// unchanged. Returns the number of such gradients.
pub fn step<R: Real>(
    settings: &AdamSettings,
    row: usize,
    visible: Option<&[u32]>,
    gradients: &[R],
    parameters: &mut [R],
    first: &mut [R],
    second: &mut [R],
) -> u64 {
    let (beta1, beta2) = (R::of(settings.beta1), R::of(settings.beta2));
    let unbias1 = R::of(1.0 / (1.0 - settings.beta1.powf(f64::from(settings.step))));
    let unbias2 = R::of(1.0 / (1.0 - settings.beta2.powf(f64::from(settings.step))));
    let limit = R::of(LARGEST_GRADIENT);
    let mut broken = 0;
    for i in 0..parameters.len() {
        if visible.is_some_and(|visible| visible[i / row] == 0) {
            continue;
        }
        if !gradients[i].is_finite() {
            broken += 1;
            continue;
        }
        let g = gradients[i].min(limit).max(-limit);
        first[i] = beta1 * first[i] + (R::one() - beta1) * g;
        second[i] = beta2 * second[i] + (R::one() - beta2) * g * g;
        let root = (second[i] * unbias2).sqrt();
        parameters[i] -=
            R::of(settings.rate) * (first[i] * unbias1) / (root + R::of(settings.epsilon));
    }
    broken
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The first step is the rate, whatever the gradient's size: bias correction at work.
    #[test]
    fn the_first_step_is_the_rate() {
        for g in [1e-6, 1.0, 1e6, -1e12] {
            let (mut p, mut m, mut v) = ([5.0f64], [0.0], [0.0]);
            step(&AdamSettings::default(), 1, None, &[g], &mut p, &mut m, &mut v);
            assert!((p[0] - (5.0 - 1e-3 * g.signum())).abs() < 1e-9, "{g} {}", p[0]);
        }
    }

    #[test]
    fn zero_gradients_move_nothing() {
        let (mut p, mut m, mut v) = ([5.0f32], [0.0], [0.0]);
        step(&AdamSettings::default(), 1, None, &[0.0], &mut p, &mut m, &mut v);
        assert_eq!((p, m, v), ([5.0], [0.0], [0.0]));
    }

    #[test]
    fn huge_and_broken_gradients_do_not_freeze_a_parameter() {
        let (mut p, mut m, mut v) = ([0.0f32; 3], [0.0; 3], [0.0; 3]);
        let settings = AdamSettings::default();
        let gradients = [3e38, f32::NAN, f32::INFINITY];
        let broken = step(&settings, 1, None, &gradients, &mut p, &mut m, &mut v);
        assert_eq!(broken, 2);
        assert!(p[0] < 0.0 && v[0].is_finite());
        assert_eq!((p[1], m[1], v[1], p[2]), (0.0, 0.0, 0.0, 0.0));
    }

    #[test]
    fn hidden_rows_keep_everything() {
        let (mut p, mut m, mut v) = ([1.0f32; 4], [0.5; 4], [0.5; 4]);
        step(&AdamSettings::default(), 2, Some(&[0, 1]), &[1.0; 4], &mut p, &mut m, &mut v);
        assert_eq!((p[0], m[1], v[0]), (1.0, 0.5, 0.5));
        assert!(p[2] < 1.0 && p[3] < 1.0);
    }

    /// The minimum of (x − 3)² is found.
    #[test]
    fn a_parabola_is_descended() {
        let (mut p, mut m, mut v) = ([0.0f64], [0.0], [0.0]);
        for step_number in 1..=4000 {
            let settings =
                AdamSettings { rate: 1e-2, step: step_number, ..AdamSettings::default() };
            let g = 2.0 * (p[0] - 3.0);
            step(&settings, 1, None, &[g], &mut p, &mut m, &mut v);
        }
        assert!((p[0] - 3.0).abs() < 1e-3, "{}", p[0]);
    }
}
