//! How far a mover is, from where it goes.
//!
//! One camera sees a mover's path up to one scale: with y(t) the path relative to the camera in a
//! unit of its own, and c(t) the camera's centre in the world, the mover is at c(t) + y(t) / κ. What
//! moves by itself moves smoothly, and a camera in a hand does not: κ is what makes y + κ c smoothest
//! (trajectory triangulation, Park et al., ECCV 2010). Smooth is a path of little jerk: then gravity
//! costs nothing. The equations are linear in κ, so its standard deviation comes along; where the
//! camera's own path is as smooth as the mover's, it is large.

use glam::{DMat3, DVec3};
use nalgebra::{Cholesky, DMatrix, DVector};

/// One frame of a path.
#[derive(Clone, Copy, Debug)]
pub(super) struct Place {
    /// The mover relative to the camera, in the world's axes and a unit of its own.
    pub relative: DVec3,
    /// The camera's centre in the world.
    pub centre: DVec3,
    /// Standard deviation across the line of sight, in the unit of `relative`.
    pub across: f64,
    /// Standard deviation along the line of sight, in the unit of `relative`.
    pub along: f64,
}

/// The unit of a path's `relative`, in the world's.
#[derive(Clone, Copy, Debug)]
pub(super) struct Unit {
    /// One over the unit: κ.
    pub inverse: f64,
    /// Its standard deviation.
    pub deviation: f64,
}

/// Frames that a path is thinned to: the work grows with their cube.
const MOST: usize = 60;
/// Degrees of freedom of the jerks' distribution: things do bounce.
const TAIL: f64 = 3.0;

/// The unit in which a path is smoothest. The places are in order, at equal distances in time.
/// `None` for fewer than eight places, or where nothing decides.
pub(super) fn unit(places: &[Place]) -> Option<Unit> {
    let places: Vec<Place> =
        places.iter().copied().step_by(places.len().div_ceil(MOST).max(1)).collect();
    let frames = places.len();
    if frames < 8 {
        return None;
    }
    let n = 3 * frames;
    let mean = places.iter().map(|p| p.centre).sum::<DVec3>() / frames as f64;
    let mut weights = DMatrix::<f64>::zeros(n, n);
    let (mut y, mut c) = (DVector::<f64>::zeros(n), DVector::<f64>::zeros(n));
    for (t, place) in places.iter().enumerate() {
        let ray = place.relative.normalize();
        let (across, along) = (place.across.powi(-2), place.along.powi(-2));
        let outer = DMat3::from_cols(ray * ray.x, ray * ray.y, ray * ray.z);
        let w = DMat3::IDENTITY * across + outer * (along - across);
        for i in 0..3 {
            for j in 0..3 {
                weights[(3 * t + i, 3 * t + j)] = w.col(j)[i];
            }
            y[3 * t + i] = place.relative[i];
            c[3 * t + i] = (place.centre - mean)[i];
        }
    }
    // The scale of jerks that observation noise alone would make.
    let noise = {
        let mut all: Vec<f64> = places.iter().map(|p| p.across.powi(-2)).collect();
        all.sort_by(f64::total_cmp);
        all[frames / 2]
    };
    let mut jerks = vec![1.0; frames - 3];
    let mut best: Option<(f64, f64, f64, DVector<f64>)> = None;
    for _ in 0..4 {
        best = None;
        let mut penalty = DMatrix::<f64>::zeros(n, n);
        for (t, jerk) in jerks.iter().enumerate() {
            let row = [-1.0, 3.0, -3.0, 1.0];
            for (a, p) in row.iter().enumerate() {
                for (b, q) in row.iter().enumerate() {
                    for i in 0..3 {
                        penalty[(3 * (t + a) + i, 3 * (t + b) + i)] += jerk * p * q;
                    }
                }
            }
        }
        for exponent in 0..12 {
            let stiffness = noise * 10f64.powf(0.5 * f64::from(exponent) - 1.0);
            let Some(factor) = Cholesky::new(&weights + &penalty * stiffness) else { continue };
            let explained = |v: &DVector<f64>| {
                let weighted = &weights * v;
                let x = factor.solve(&weighted);
                (weighted.clone() - &weights * &x, x)
            };
            let ((sy, xy), (sc, xc)) = (explained(&y), explained(&c));
            let information = c.dot(&sc);
            if information <= 0.0 {
                continue;
            }
            let inverse = -c.dot(&sy) / information;
            let rest = (y.dot(&sy) - inverse * inverse * information).max(1e-12);
            let free = (n - 10) as f64;
            let log_determinant = 2.0 * factor.l().diagonal().iter().map(|d| d.ln()).sum::<f64>();
            let evidence =
                free * (rest / free).ln() + log_determinant - (n - 9) as f64 * stiffness.ln();
            let deviation = (rest / free / information).sqrt();
            if best.as_ref().is_none_or(|b| evidence < b.0) {
                let path = xy + inverse * xc;
                best = Some((evidence, inverse, deviation, path));
            }
        }
        let (_, _, _, path) = best.as_ref()?;
        let at = |t: usize| DVec3::new(path[3 * t], path[3 * t + 1], path[3 * t + 2]);
        let squared: Vec<f64> = (0..frames - 3)
            .map(|t| (at(t + 3) - 3.0 * at(t + 2) + 3.0 * at(t + 1) - at(t)).length_squared())
            .collect();
        // Reweighted as under Student's distribution.
        let mut spread = squared.iter().sum::<f64>() / squared.len() as f64;
        for _ in 0..10 {
            let sum: f64 = squared
                .iter()
                .map(|s| s * (TAIL + 3.0) / (TAIL + 3.0 * s / spread.max(1e-300)))
                .sum();
            spread = sum / squared.len() as f64;
        }
        for (jerk, s) in jerks.iter_mut().zip(&squared) {
            *jerk = (TAIL + 3.0) / (TAIL + 3.0 * s / spread.max(1e-300));
        }
    }
    let (_, inverse, deviation, _) = best?;
    (inverse.is_finite() && deviation.is_finite()).then_some(Unit { inverse, deviation })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A ball in flight, seen from a hand.
    fn places(shake: f64, noise: f64) -> Vec<Place> {
        (0..30)
            .map(|t| {
                let t = t as f64;
                let wave = |k: f64, phase: f64| (0.7 * k * t + phase).sin();
                let centre = DVec3::new(0.03 * t, 0.0, 0.0)
                    + shake * DVec3::new(wave(1.0, 0.3), wave(1.4, 1.0), 0.3 * wave(0.8, 2.0));
                let at = DVec3::new(0.08 * t - 1.0, 0.004 * (t - 15.0).powi(2) - 0.5, 2.5);
                let tremble = noise * DVec3::new(wave(5.1, 0.0), wave(6.3, 1.0), 0.0);
                Place {
                    relative: (at - centre + tremble) * 0.5,
                    centre,
                    across: 0.5 * noise.max(1e-4),
                    along: 0.05,
                }
            })
            .collect()
    }

    #[test]
    fn a_shaking_hand_shows_how_far_a_ball_is() {
        let found = unit(&places(0.02, 0.0005)).unwrap();
        assert!((found.inverse / 0.5 - 1.0).abs() < 0.03, "{found:?}");
        assert!(found.deviation < 0.03, "{found:?}");
    }

    #[test]
    fn a_camera_as_smooth_as_the_ball_does_not() {
        let found = unit(&places(0.0, 0.0005));
        assert!(found.is_none_or(|f| f.deviation > 0.2 * f.inverse.abs()), "{found:?}");
        assert!(unit(&places(0.02, 0.001)[..7]).is_none());
    }
}
