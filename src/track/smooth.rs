//! The distance of a mover, from the smoothness of its path.
//!
//! One camera observes a mover's path up to one scale: with y(t) the path relative to the camera in an
//! arbitrary unit, and c(t) the camera's centre in the world, the mover is at c(t) + y(t) / κ. A mover moves
//! smoothly by itself and a hand-held camera does not, so κ is the value that makes y + κ c smoothest
//! (trajectory triangulation, Park et al., ECCV 2010). The equations are linear in κ and also give its
//! standard deviation; that is large if the camera's own path is as smooth as the mover's: then what they have
//! in common by chance lasts for many frames, so that few of the frames are independent.
//!
//! The measure of smoothness depends on the mover. A travelling object has small jerk; gravity then has no
//! cost. An object that stays in one place, such as a person who stands and gestures, has small velocity. A
//! penalty on velocity ties it to that place; under a penalty on jerk it could drift along with the camera.
//! If the vertical direction is known, an object that flies, rolls or drives has small acceleration except
//! for a constant downward one. This is a stronger constraint than small jerk, because no sideways curve is
//! attributed to the mover's own path. The evidence of the
//! path (its marginal likelihood under a Gaussian model of the velocities, accelerations or jerks) selects the
//! model.

use glam::{DMat3, DVec3};
use nalgebra::{Cholesky, DMatrix, DVector};
use std::ops::Range;

use super::path::Estimate;

/// A mover in one frame of its path.
#[derive(Clone, Copy, Debug)]
pub(super) struct Place {
    /// Position of the mover relative to the camera, along the world's axes, in an arbitrary unit.
    pub relative: DVec3,
    /// The camera's centre in the world.
    pub centre: DVec3,
    /// Standard deviation across the line of sight, in the unit of `relative`.
    pub across: f64,
    /// Standard deviation along the line of sight, in the unit of `relative`.
    pub along: f64,
    /// The mover's centre of mass moves smoothly, and it is offset from the observed middle. These columns
    /// are one standard deviation of that offset along each of the mover's own axes, in the unit of
    /// `relative`, rotated to the world. Zero if the mover's rotation is unknown.
    pub off_centre: DMat3,
}

/// The unit of a path's `relative`, in world units.
#[derive(Clone, Copy, Debug)]
pub(super) struct Unit {
    /// One over the unit: κ.
    pub inverse: f64,
    /// Standard deviation of `inverse`.
    pub deviation: f64,
}

/// The smoothest path.
#[derive(Clone, Debug)]
pub(super) struct Smoothest {
    /// The unit of `relative` that makes the path smoothest.
    pub unit: Unit,
    /// Per place, the logarithm of the ratio of the smooth path's distance to the observed distance, in the
    /// unit that follows from the path and from what was known of it before. `None` unless the model with a
    /// fall was chosen.
    pub farther: Option<Vec<f64>>,
}

/// Maximum number of frames that a path is subsampled to; the cost grows with the cube of this number.
const MOST: usize = 60;
/// Degrees of freedom of Student's distribution of the differences; heavy tails admit bounces.
const TAIL: f64 = 3.0;
/// Number of reweighting rounds for that distribution.
const ROUNDS: usize = 4;

/// Orders of the differences of a path that are penalised: velocities, accelerations, jerks.
const VELOCITY: usize = 1;
const ACCELERATION: usize = 2;
const JERK: usize = 3;

/// Upper bound of the correlation of neighbouring frames' terms of a unit; it is estimated from few frames.
const ALIKE: f64 = 0.95;

/// Prior standard deviation of the length of a fall during half of the path's duration, as a multiple of the
/// mover's distance.
const FALL: f64 = 2.0;

/// Ranges of the information of the differences, as exponents of √10 relative to the information that
/// observation noise alone would give: for any path (`ANY`), and for a path whose jerks determine the unit
/// (`STIFF`). In the second case the jerks must not exceed the noise by much; otherwise a flexible path would
/// follow the camera's shake.
const ANY: Range<i32> = -16..10;
const STIFF: Range<i32> = -2..10;

/// Finds the unit in which a path is smoothest. The places are in order, at equal time steps. `up` is the
/// upward direction in the world, if known. `known` is an independent estimate of the unit's inverse. Returns `None` for fewer than eight places, or if the data do not determine the unit.
pub(super) fn smoothest(
    all: &[Place],
    up: Option<DVec3>,
    known: Option<Estimate>,
) -> Option<Smoothest> {
    let step = all.len().div_ceil(MOST).max(1);
    let places: Vec<Place> = all.iter().copied().step_by(step).collect();
    if places.len() < 8 {
        return None;
    }
    let path = Path::new(&places);
    let [stays, steady, travels] =
        [VELOCITY, ACCELERATION, JERK].map(|order| path.robust(order, ANY, None));
    let flies = up.and_then(|up| path.robust(ACCELERATION, ANY, Some(&path.fall(up))));
    let cost = |fit: &Option<Fit>| fit.as_ref().map_or(f64::INFINITY, |fit| fit.evidence);
    // The model of accelerations without a fall is compared but never gives the unit: the acceleration of a
    // thrown object is due to gravity.
    let moves = cost(&steady).min(cost(&travels));
    let chosen = if cost(&stays) < moves.min(cost(&flies)) {
        stays
    } else if cost(&steady).min(cost(&flies)) < cost(&travels) && flies.is_some() {
        flies
    } else {
        path.robust(JERK, STIFF, None)
    };
    let Fit { unit, seen, .. } = chosen?;
    let farther = seen.map(|(seen, per_inverse)| {
        let more = known.map_or(0.0, |known| {
            let own = Estimate { value: unit.inverse, deviation: unit.deviation };
            own.and(known).value - unit.inverse
        });
        let at = |k: usize| {
            let relative = places[k].relative;
            let seen = seen[k] + per_inverse[k] * more;
            let along = seen.dot(relative) / relative.length_squared();
            if along > 0.0 { along.ln() } else { 0.0 }
        };
        let between = |k: usize| {
            let (k, part) = (k / step, (k % step) as f64 / step as f64);
            at(k) + part * (at((k + 1).min(places.len() - 1)) - at(k))
        };
        (0..all.len()).map(between).collect()
    });
    let finite = unit.inverse.is_finite() && unit.deviation.is_finite();
    finite.then_some(Smoothest { unit, farther })
}

/// The equations of a path.
struct Path {
    frames: usize,
    /// Information matrix of the observations, three rows per frame.
    weights: DMatrix<f64>,
    /// Positions of the mover relative to the camera.
    relative: DVector<f64>,
    /// Positions of the camera relative to the mean of its path.
    camera: DVector<f64>,
    /// The columns of [`Place::off_centre`], three rows per frame.
    turning: DMatrix<f64>,
    /// The offset of the observed middle from the centre of mass, in these columns, per difference of the
    /// two paths.
    offset_of: DMatrix<f64>,
    /// The information that the differences would have from observation noise alone.
    noise: f64,
    /// The median distance from the camera.
    distance: f64,
}

/// A path's unit under one model of its differences.
struct Fit {
    unit: Unit,
    /// Minus twice the logarithm of the marginal likelihood, up to a constant that all models share.
    evidence: f64,
    /// The path of the centre of mass without the fall.
    path: DVector<f64>,
    /// The path of the observed middle relative to the camera, and its derivative with respect to the unit's
    /// inverse; set if the model has a fall.
    seen: Option<(Vec<DVec3>, Vec<DVec3>)>,
}

impl Path {
    fn new(places: &[Place]) -> Path {
        let frames = places.len();
        let n = 3 * frames;
        let mean = places.iter().map(|p| p.centre).sum::<DVec3>() / frames as f64;
        let mut weights = DMatrix::<f64>::zeros(n, n);
        let (mut relative, mut camera) = (DVector::zeros(n), DVector::zeros(n));
        let mut turning = DMatrix::<f64>::zeros(n, 3);
        for (t, place) in places.iter().enumerate() {
            let ray = place.relative.normalize();
            let (across, along) = (place.across.powi(-2), place.along.powi(-2));
            let outer = DMat3::from_cols(ray * ray.x, ray * ray.y, ray * ray.z);
            let w = DMat3::IDENTITY * across + outer * (along - across);
            for i in 0..3 {
                for j in 0..3 {
                    weights[(3 * t + i, 3 * t + j)] = w.col(j)[i];
                    turning[(3 * t + i, j)] = place.off_centre.col(j)[i];
                }
                relative[3 * t + i] = place.relative[i];
                camera[3 * t + i] = (place.centre - mean)[i];
            }
        }
        // The offset of the centre of mass is marginalised, by Woodbury's identity.
        let weighted = &weights * &turning;
        let offset = DMatrix::<f64>::identity(3, 3) + turning.transpose() * &weighted;
        let mut offset_of = DMatrix::zeros(3, n);
        if let Some(factor) = Cholesky::new(offset) {
            offset_of = factor.solve(&weighted.transpose());
            weights -= &weighted * &offset_of;
        }
        let middle = |of: fn(&Place) -> f64| super::quantile(places.iter().map(of).collect(), 0.5);
        Path {
            frames,
            weights,
            relative,
            camera,
            turning,
            offset_of,
            noise: middle(|p| p.across.powi(-2)),
            distance: middle(|p| p.relative.length()),
        }
    }

    /// The path of an object under unit downward acceleration that is at rest at the middle of the path's
    /// duration.
    fn fall(&self, up: DVec3) -> DVector<f64> {
        let middle = 0.5 * (self.frames - 1) as f64;
        let fallen = |t: usize| -0.5 * (t as f64 - middle).powi(2);
        DVector::from_fn(3 * self.frames, |i, _| up[i % 3] * fallen(i / 3))
    }

    /// Equal scales for all differences of an order.
    fn even(&self, order: usize) -> Vec<f64> {
        vec![1.0; self.frames - order]
    }

    /// Fits a path whose differences of an order, after subtraction of a `fall`, have heavy tails, so that a
    /// bouncing object still counts as travelling.
    fn robust(
        &self,
        order: usize,
        stiffnesses: Range<i32>,
        fall: Option<&DVector<f64>>,
    ) -> Option<Fit> {
        let row = binomials(order);
        let mut scales = self.even(order);
        let mut best = None;
        for _ in 0..ROUNDS {
            let mut fit = self.fit(order, &scales, stiffnesses.clone(), fall)?;
            // Student's distribution as a scale mixture: each difference has its own scale, with its cost.
            let mixture = scales.iter().map(|s| (TAIL - 2.0) * -s.ln() + TAIL * (s - 1.0));
            fit.evidence += mixture.sum::<f64>();
            let squared: Vec<f64> = (0..self.frames - order)
                .map(|t| (0..3).map(|axis| difference(&row, &fit.path, t, axis).powi(2)).sum())
                .collect();
            // Reweighted as under Student's distribution.
            let weight = |s: f64, spread: f64| (TAIL + 3.0) / (TAIL + 3.0 * s / spread.max(1e-300));
            let mut spread = squared.iter().sum::<f64>() / squared.len() as f64;
            for _ in 0..10 {
                let sum: f64 = squared.iter().map(|s| s * weight(*s, spread)).sum();
                spread = sum / squared.len() as f64;
            }
            scales = squared.iter().map(|s| weight(*s, spread)).collect();
            best = Some(fit);
        }
        best
    }

    /// Finds the most likely unit if the differences of an order are Gaussian. Their variance is estimated
    /// from the path and divided by each difference's entry of `scales`. The best-fitting multiple of `fall`
    /// has no smoothness cost.
    fn fit(
        &self,
        order: usize,
        scales: &[f64],
        stiffnesses: Range<i32>,
        fall: Option<&DVector<f64>>,
    ) -> Option<Fit> {
        let n = 3 * self.frames;
        let row = binomials(order);
        let mut penalty = DMatrix::<f64>::zeros(n, n);
        for (t, scale) in scales.iter().enumerate() {
            for (a, p) in row.iter().enumerate() {
                for (b, q) in row.iter().enumerate() {
                    for i in 0..3 {
                        penalty[(3 * (t + a) + i, 3 * (t + b) + i)] += scale * p * q;
                    }
                }
            }
        }
        // The degrees of freedom that the differences do not constrain (a position, a velocity and an
        // acceleration on each axis, depending on the order) have a prior about as wide as the mover's
        // distance.
        let width = self.distance * (self.frames as f64).sqrt();
        let free_of_differences = 6.0 * order as f64 * width.ln();
        let differences = 3.0 * log_determinant_of_differences(self.frames, order)
            + 3.0 * scales.iter().map(|scale| scale.ln()).sum::<f64>();
        // κ, the fall and the variance are free parameters, in addition to what the differences leave free.
        let rank = (n - 3 * order) as f64;
        let free = rank - 1.0 - f64::from(u8::from(fall.is_some()));
        let widest_fall = FALL * self.distance / (0.5 * self.frames as f64).powi(2);
        let mut best: Option<Fit> = None;
        for exponent in stiffnesses {
            let stiffness = self.noise * 10f64.powf(0.5 * f64::from(exponent));
            let Some(factor) = Cholesky::new(&self.weights + &penalty * stiffness) else {
                continue;
            };
            let explained = |v: &DVector<f64>| {
                let weighted = &self.weights * v;
                let x = factor.solve(&weighted);
                (weighted.clone() - &self.weights * &x, x)
            };
            let ((mut sy, mut xy), (mut sc, mut xc)) =
                (explained(&self.relative), explained(&self.camera));
            // The information about the fall. What the fall explains is projected out of both vectors.
            let fallen = fall.map(|fall| {
                let (sf, xf) = explained(fall);
                let information = fall.dot(&sf);
                let shares = [(&mut sy, &mut xy), (&mut sc, &mut xc)].map(|(s, x)| {
                    let share = fall.dot(s) / information;
                    s.axpy(-share, &sf, 1.0);
                    x.axpy(-share, &xf, 1.0);
                    share
                });
                (fall, information, shares)
            });
            let information = self.camera.dot(&sc);
            if information <= 0.0 || fallen.is_some_and(|(_, known, _)| known <= 0.0) {
                continue;
            }
            let inverse = -self.camera.dot(&sy) / information;
            let rest = (self.relative.dot(&sy) - inverse * inverse * information).max(1e-12);
            let log_determinant = factor.ln_determinant();
            let cost_of_fall = fallen.map_or(0.0, |(_, information, _)| {
                (widest_fall.powi(2) * information * free / rest).ln_1p()
            });
            let evidence = free * (rest / free).ln() + log_determinant + cost_of_fall
                - rank * stiffness.ln()
                - differences
                + free_of_differences;
            if best.as_ref().is_none_or(|b| evidence < b.evidence) {
                let path = &xy + inverse * &xc;
                let lasting = lasting(order, scales, &path, &xc);
                let deviation = (rest / free / information * lasting).sqrt();
                let seen = fallen.map(|(fall, _, [own, camera])| {
                    let places = |v: DVector<f64>| {
                        v.as_slice().chunks_exact(3).map(DVec3::from_slice).collect()
                    };
                    let per_inverse = &xc + fall * camera - &self.camera;
                    let seen = &xy + fall * own + inverse * &per_inverse;
                    let offset = &self.turning * (&self.offset_of * (&self.relative - &seen));
                    let offset_per_inverse = &self.turning * (&self.offset_of * &per_inverse);
                    (places(seen + offset), places(per_inverse - offset_per_inverse))
                });
                let unit = Unit { inverse, deviation };
                best = Some(Fit { unit, evidence, path, seen });
            }
        }
        best
    }
}

/// The factor on the variance of a path's unit by which the differences of its `path` are not independent:
/// that of sums of an AR(1) process. A term of the sum that determines the unit is the product of a difference
/// of the mover's path and one of the camera's. If both curve slowly, the terms of neighbouring frames are
/// alike, and the frames tell hardly more than a few of them would.
fn lasting(order: usize, scales: &[f64], path: &DVector<f64>, camera: &DVector<f64>) -> f64 {
    let row = binomials(order);
    let term = |(t, scale): (usize, &f64)| {
        let of = |axis| difference(&row, path, t, axis) * difference(&row, camera, t, axis);
        scale * (0..3).map(of).sum::<f64>()
    };
    let terms: Vec<f64> = scales.iter().enumerate().map(term).collect();
    let next: f64 = terms.windows(2).map(|pair| pair[0] * pair[1]).sum();
    let squares: f64 = terms.iter().map(|term| term * term).sum();
    let correlation = (next / squares.max(f64::MIN_POSITIVE)).clamp(0.0, ALIKE);
    (1.0 + correlation) / (1.0 - correlation)
}

/// A difference of a path along an axis, with the given coefficients.
fn difference(row: &[f64], path: &DVector<f64>, t: usize, axis: usize) -> f64 {
    row.iter().enumerate().map(|(a, p)| p * path[3 * (t + a) + axis]).sum()
}

/// The coefficients of the difference of an order: −1, 1; 1, −2, 1; −1, 3, −3, 1.
fn binomials(order: usize) -> Vec<f64> {
    let mut row = vec![1.0];
    for _ in 0..order {
        let at = |k: usize| row.get(k).copied().unwrap_or(0.0);
        row = (0..=row.len()).map(|k| if k > 0 { at(k - 1) } else { 0.0 } - at(k)).collect();
    }
    row
}

/// Logarithm of the determinant of D Dᵀ, where D x are the differences of an order of a vector x with
/// `numbers` entries.
fn log_determinant_of_differences(numbers: usize, order: usize) -> f64 {
    let row = binomials(order);
    let differences = DMatrix::from_fn(numbers - order, numbers, |t, k| {
        k.checked_sub(t).and_then(|a| row.get(a)).copied().unwrap_or(0.0)
    });
    let squared = &differences * differences.transpose();
    // D has full rank: each difference involves an entry that no earlier one does.
    Cholesky::new(squared).map_or(0.0, |factor| factor.ln_determinant())
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    fn unit(places: &[Place], up: Option<DVec3>) -> Option<Unit> {
        smoothest(places, up, None).map(|found| found.unit)
    }

    /// A ball in flight, seen by a hand-held camera.
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
                    off_centre: DMat3::ZERO,
                }
            })
            .collect()
    }

    #[test]
    fn a_shaking_hand_shows_how_far_a_ball_is() {
        let found = unit(&places(0.02, 0.0005), None).unwrap();
        assert!((found.inverse / 0.5 - 1.0).abs() < 0.03, "{found:?}");
        assert!(found.deviation < 0.03, "{found:?}");
    }

    #[test]
    fn a_ball_that_spins_about_another_point_than_its_middle_travels_smoothly() {
        // The observed middle is 6 % of the ball's distance away from its centre of mass.
        let truth = 0.5;
        let spun = |known: f64| -> Vec<Place> {
            let turned = |(t, place): (usize, Place)| {
                let world_from_ball = DMat3::from_rotation_y(0.3 * t as f64);
                let off = world_from_ball * DVec3::new(0.15, 0.02, 0.05) * truth;
                let off_centre = world_from_ball * known;
                Place { relative: place.relative + off, off_centre, ..place }
            };
            places(0.006, 0.0005).into_iter().enumerate().map(turned).collect()
        };
        let off = |known: f64| {
            unit(&spun(known), None).map_or(f64::INFINITY, |u| (u.inverse / truth - 1.0).abs())
        };
        assert!(off(0.1) < 0.01, "{}", off(0.1));
        assert!(off(0.0) > 0.03, "{} {}", off(0.0), off(0.1));
    }

    #[test]
    fn an_offset_of_the_centre_of_mass_does_not_bend_the_path_of_the_middle() {
        // A car that drives past on the left and does not rotate: where its centre of mass is, nothing shows.
        // Its observed path is exact.
        let up = Some(DVec3::NEG_Y);
        let car = |(t, place): (usize, Place)| {
            let t = t as f64;
            let at = DVec3::new(0.08 * t - 1.0, 0.3, 3.0 - 0.05 * t);
            let off_centre = DMat3::from_diagonal(DVec3::splat(0.1));
            Place { relative: 0.5 * (at - place.centre), along: 0.005, off_centre, ..place }
        };
        let drive: Vec<Place> = places(0.006, 0.0005).into_iter().enumerate().map(car).collect();
        let bend = |known: Option<Estimate>| {
            let farther = smoothest(&drive, up, known).unwrap().farther.unwrap();
            farther.iter().fold(0.0, |most: f64, by| most.max(by.abs()))
        };
        assert!(bend(None) < 0.002, "{}", bend(None));
        // In a unit that is known, and wrong by 20 %, the smoothest path is another one.
        let in_unit = |inverse: f64| bend(Some(Estimate { value: inverse, deviation: 1e-15 }));
        assert!(in_unit(0.6) > 1e-5 && in_unit(0.5) < 1e-6, "{} {}", in_unit(0.6), in_unit(0.5));
    }

    #[test]
    fn a_camera_as_smooth_as_the_ball_does_not() {
        let found = unit(&places(0.0, 0.0005), None);
        assert!(found.is_none_or(|f| f.deviation > 0.2 * f.inverse.abs()), "{found:?}");
        assert!(unit(&places(0.02, 0.001)[..7], None).is_none());
    }

    #[test]
    fn a_mover_that_curves_as_slowly_as_the_camera_tells_little() {
        // Both follow slow waves of their own, seen almost without noise. By chance a part of the mover's wave
        // is like the camera's, and looks like parallax.
        let wave =
            |t: f64, period: f64, phase: f64| (std::f64::consts::TAU * t / period + phase).sin();
        let off = |phase: f64| {
            let place = |t: usize| {
                let t = t as f64;
                let centre = DVec3::new(0.02 * t, 0.03 * wave(t, 30.0, 0.4), 0.0);
                let own = 0.05 * wave(t, 24.0, phase);
                let at = DVec3::new(0.05 * t - 0.7, own, 2.5 + 0.5 * own);
                Place {
                    relative: 0.5 * (at - centre),
                    centre,
                    across: 1e-4,
                    along: 0.005,
                    off_centre: DMat3::ZERO,
                }
            };
            let places: Vec<Place> = (0..24).map(place).collect();
            let Some(found) = unit(&places, Some(DVec3::NEG_Y)) else { return 0.0 };
            (found.inverse - 0.5).abs() / found.deviation
        };
        let mut off: Vec<f64> = (0..12).map(|k| off(0.5 * f64::from(k))).collect();
        off.sort_by(f64::total_cmp);
        assert!(off[6] < 3.0 && off[10] < 12.0, "errors in standard deviations: {off:?}");
    }

    #[test]
    fn what_falls_tells_its_distance_where_up_is_known() {
        // The camera sways slowly; y points down. The ball is seen with white noise.
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let deviation = 0.001;
        let mut noise = || {
            let normal = (0..12).map(|_| rng.random::<f64>()).sum::<f64>() - 6.0;
            deviation * normal
        };
        let place = |(t, place): (usize, Place)| {
            let sway = |k: f64, phase: f64| 0.05 * (k * t as f64 + phase).sin();
            let centre = place.centre + DVec3::new(sway(0.12, 0.3), 0.0, sway(0.1, 2.0));
            let seen = DVec3::new(noise(), noise(), noise());
            let relative = place.relative - 0.5 * (centre - place.centre) + seen;
            Place { centre, relative, across: deviation, along: deviation, ..place }
        };
        let places: Vec<Place> = places(0.0, 0.0).into_iter().enumerate().map(place).collect();
        let off = |found: Option<Unit>| {
            found.map_or(f64::INFINITY, |found| (found.inverse / 0.5 - 1.0).abs())
        };
        let (by_jerk, found) = (unit(&places, None), unit(&places, Some(DVec3::NEG_Y)));
        assert!(off(found) < 0.05, "{found:?} {by_jerk:?}");
        let deviation = by_jerk.map_or(f64::INFINITY, |unit| unit.deviation);
        assert!(2.0 * found.unwrap().deviation < deviation, "{found:?} {by_jerk:?}");
        // It accelerates downwards by 0.008 per frame², in a unit of two.
        let path = Path::new(&places);
        let down = path.robust(ACCELERATION, ANY, Some(&path.fall(DVec3::NEG_Y))).unwrap();
        let aside = path.robust(ACCELERATION, ANY, Some(&path.fall(DVec3::X))).unwrap();
        assert!(down.evidence < aside.evidence, "{} {}", down.evidence, aside.evidence);
    }

    #[test]
    fn differences_are_of_their_order() {
        assert_eq!(binomials(1), [-1.0, 1.0]);
        assert_eq!(binomials(3), [-1.0, 3.0, -3.0, 1.0]);
        // Five numbers have four first differences; D Dᵀ is tridiagonal with 2 and −1, its determinant is 5.
        assert!((log_determinant_of_differences(5, 1) - 5f64.ln()).abs() < 1e-12);
    }

    /// A person who stands and gestures, seen from a camera that moves sideways, steps up and returns.
    fn standing() -> Vec<Place> {
        (0..12)
            .map(|t| {
                let (k, t) = (t as f64, t as usize);
                let aside = if t < 6 { 0.05 * k } else { 0.05 * (10.5 - k) };
                let centre = DVec3::new(aside, if t < 6 { 0.0 } else { 0.05 }, 0.01 * k);
                // The gesture oscillates about one place, by a tenth of the camera's step.
                let gesture = [0.0, 0.8, -0.4, 0.3, 1.0, -0.7, -0.2, 0.6, -1.0, 0.1, -0.5, 0.4][t];
                let at = DVec3::new(0.1 + 0.005 * gesture, 0.01 * gesture * gesture, 0.85);
                let relative = (at - centre) * 2.0;
                Place { relative, centre, across: 0.001, along: 0.01, off_centre: DMat3::ZERO }
            })
            .collect()
    }

    #[test]
    fn who_stands_and_gestures_is_held_by_the_place() {
        let places = standing();
        let path = Path::new(&places);
        let (found, by_jerk) =
            (unit(&places, None).unwrap(), path.robust(JERK, STIFF, None).unwrap().unit);
        assert_eq!(found.inverse, path.robust(VELOCITY, ANY, None).unwrap().unit.inverse);
        assert!((found.inverse - 2.0).abs() < 2.0 * found.deviation, "{found:?}");
        assert!(found.deviation < 0.6 * by_jerk.deviation, "{found:?} {by_jerk:?}");
        assert!(found.deviation < 0.03 * found.inverse, "{found:?}");
    }

    #[test]
    fn what_bounces_travels() {
        // The ball falls, bounces in the middle and rises.
        let mut places = places(0.02, 0.0005);
        for (t, place) in places.iter_mut().enumerate() {
            place.relative.y -= 0.5 * 0.12 * (t as f64 - 15.0).abs();
        }
        let path = Path::new(&places);
        let [stays, travels] = [VELOCITY, JERK].map(|order| path.robust(order, ANY, None).unwrap());
        assert!(travels.evidence < stays.evidence, "{} {}", travels.evidence, stays.evidence);
    }

    #[test]
    fn what_travels_is_held_by_its_jerks() {
        // Jerks are used because a penalty on velocities would tie the ball to the camera.
        let places = places(0.02, 0.0005);
        let path = Path::new(&places);
        let (chosen, by_velocity) =
            (unit(&places, None).unwrap(), path.robust(VELOCITY, ANY, None).map(|fit| fit.unit));
        assert_eq!(chosen.inverse, path.robust(JERK, STIFF, None).unwrap().unit.inverse);
        let off = by_velocity.map_or(f64::INFINITY, |u| (u.inverse / 0.5 - 1.0).abs());
        assert!(off > 0.1, "{by_velocity:?}");
    }
}
