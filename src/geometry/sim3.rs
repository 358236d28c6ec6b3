//! Similarity transforms, and the alignment of point sets and trajectories.

use super::se3::{exp_so3, log_so3, matrix3};
use crate::error::{Error, Result};
use crate::types::Pose;
use glam::{DMat3, DQuat, DVec3};
use nalgebra::Matrix3;
use serde::{Deserialize, Serialize};

/// A similarity, named `a_from_b`: `x_a = scale · rotation · x_b + translation`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Sim3 {
    /// Scale: units of a per unit of b, positive.
    pub scale: f64,
    /// Rotation, a unit quaternion.
    pub rotation: DQuat,
    /// Translation, in units of a.
    pub translation: DVec3,
}

impl Sim3 {
    /// The identity transform.
    pub const IDENTITY: Sim3 =
        Sim3 { scale: 1.0, rotation: DQuat::IDENTITY, translation: DVec3::ZERO };

    /// Maps a point from b to a.
    pub fn apply(&self, point: DVec3) -> DVec3 {
        self.scale * (self.rotation * point) + self.translation
    }

    /// `a_from_view` of a `b_from_view`: the camera's centre is transformed and its axes are rotated.
    pub fn apply_pose(&self, b_from_view: &Pose) -> Pose {
        Pose::new(self.rotation * b_from_view.rotation, self.apply(b_from_view.translation))
    }

    /// `b_from_a` of an `a_from_b`.
    pub fn inverse(&self) -> Sim3 {
        let rotation = self.rotation.conjugate();
        let scale = 1.0 / self.scale;
        Sim3 { scale, rotation, translation: -scale * (rotation * self.translation) }
    }
}

/// `a_from_c = a_from_b * b_from_c`.
impl std::ops::Mul for Sim3 {
    type Output = Sim3;
    fn mul(self, other: Sim3) -> Sim3 {
        Sim3 {
            scale: self.scale * other.scale,
            rotation: (self.rotation * other.rotation).normalize(),
            translation: self.apply(other.translation),
        }
    }
}

/// Degrees of freedom of the rotation that the points determine.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Shape {
    /// Planar or spatial: the rotation is unique.
    General,
    /// Collinear points: the rotation about the line is free. The smallest rotation is used, or, where
    /// poses are aligned, the one that the cameras' axes determine.
    Line,
    /// Coincident points: rotation and scale are free. Identity and 1 are used, or, where poses are
    /// aligned, the rotation that the cameras' axes determine.
    Point,
}

/// Result of an alignment.
#[derive(Clone, Copy, Debug)]
pub struct Alignment {
    /// Maps the estimate to the reference.
    pub reference_from_estimate: Sim3,
    /// What the points determine of the rotation.
    pub shape: Shape,
    /// Weighted root mean square distance after alignment, in the reference's units.
    pub rmse: f64,
}

/// Ratio of singular values below which a direction counts as absent: the f64 rounding error of coordinates
/// that are a thousand extents away from the origin.
const RANK_TOLERANCE: f64 = 1e-9;

/// Least-squares similarity (or rigid transform, without `with_scale`) between paired points.
///
/// Umeyama, PAMI 1991: rotation from the SVD of the covariance with reflections excluded. `weights` are per
/// pair and not negative; `None` means 1 each. Collinear or coincident points give the result documented at
/// [`Shape`].
///
/// # Errors
/// Differing lengths, no pairs, a non-finite coordinate, no positive weight.
pub fn align_points(
    estimate: &[DVec3],
    reference: &[DVec3],
    weights: Option<&[f64]>,
    with_scale: bool,
) -> Result<Alignment> {
    let moments = Moments::gather(estimate, reference, weights)?;
    let (rotation, shape) = moments.rotation();
    Ok(moments.finish(rotation, shape, with_scale, estimate, reference, weights))
}

/// Least-squares alignment of two trajectories (`world_from_view` each, paired by index) by their camera
/// centres, as in [`align_points`].
///
/// Where the centres are collinear (or coincident), the undetermined part of the rotation is taken from the
/// cameras' axes (chordal mean), so that novel views can be mapped too; it does not affect the fit of the
/// centres.
///
/// # Errors
/// Those of [`align_points`].
pub fn align_poses(estimate: &[Pose], reference: &[Pose], with_scale: bool) -> Result<Alignment> {
    let a: Vec<DVec3> = estimate.iter().map(|p| p.translation).collect();
    let b: Vec<DVec3> = reference.iter().map(|p| p.translation).collect();
    let moments = Moments::gather(&a, &b, None)?;
    let (mut rotation, shape) = moments.rotation();
    let axes = sum_of_turns(estimate, reference);
    match shape {
        Shape::General => {}
        Shape::Line => {
            let about = rotation * moments.direction();
            rotation = best_turn(about, rotation, axes) * rotation;
        }
        Shape::Point => {
            let (fitted, unique) = nearest_rotation(&matrix3(&axes));
            if unique == Shape::General {
                rotation = fitted;
            }
        }
    }
    Ok(moments.finish(rotation, shape, with_scale, &a, &b, None))
}

/// The similarity that maps whole cameras (`world_from_view` each, paired by index), for transforming novel
/// views from one world to the other.
///
/// The rotation is the median of those that map one camera's axes to the other's; scale and translation fit
/// the centres under it. [`align_poses`] uses only the centres, as the ATE is defined. On a short path its
/// rotation then depends on millimetres of noise, and even a partial weight of the centres degrades it,
/// because rotations are known more accurately than the direction from one centre to the next.
///
/// # Errors
/// Those of [`align_points`].
pub fn align_cameras(estimate: &[Pose], reference: &[Pose], with_scale: bool) -> Result<Alignment> {
    let a: Vec<DVec3> = estimate.iter().map(|p| p.translation).collect();
    let b: Vec<DVec3> = reference.iter().map(|p| p.translation).collect();
    let moments = Moments::gather(&a, &b, None)?;
    let (_, shape) = moments.rotation();
    let rotation = median_turn(estimate, reference);
    Ok(moments.finish(rotation, shape, with_scale, &a, &b, None))
}

/// The rotation of the least summed angle to all R_ref R_estᵀ: Weiszfeld's iterations in the tangent
/// space (Hartley, Aftab, Trumpf, CVPR 2011), from the chordal mean.
fn median_turn(estimate: &[Pose], reference: &[Pose]) -> DQuat {
    /// Lower bound of the angles, so that an exactly matched rotation does not dominate.
    const LEAST: f64 = 1e-9;
    const ITERATIONS: usize = 100;
    let (mut median, _) = nearest_rotation(&matrix3(&sum_of_turns(estimate, reference)));
    for _ in 0..ITERATIONS {
        let (mut sum, mut total) = (DVec3::ZERO, 0.0);
        for (e, r) in estimate.iter().zip(reference) {
            let away = log_so3(r.rotation * e.rotation.conjugate() * median.conjugate());
            let weight = 1.0 / away.length().max(LEAST);
            sum += weight * away;
            total += weight;
        }
        let step = sum / total;
        median = (exp_so3(step) * median).normalize();
        if step.length() < 1e-12 {
            break;
        }
    }
    median
}

/// Σ R_ref R_estᵀ: the axes' agreement with a candidate rotation is the trace of (candidate)ᵀ times this
/// matrix.
fn sum_of_turns(estimate: &[Pose], reference: &[Pose]) -> DMat3 {
    let turn = |(e, r): (&Pose, &Pose)| DMat3::from_quat(r.rotation * e.rotation.conjugate());
    estimate.iter().zip(reference).map(turn).fold(DMat3::ZERO, |sum, m| sum + m)
}

/// The rotation about `axis` that brings `rotation` closest to the summed rotations `target`.
fn best_turn(axis: DVec3, rotation: DQuat, target: DMat3) -> DQuat {
    let m = target * DMat3::from_quat(rotation.conjugate());
    // tr(Rot(θ)ᵀ M) = const + cos θ (tr M − aᵀMa) + sin θ · a·vee(M − Mᵀ).
    let cosine = m.x_axis.x + m.y_axis.y + m.z_axis.z - axis.dot(m * axis);
    let vee = DVec3::new(m.y_axis.z - m.z_axis.y, m.z_axis.x - m.x_axis.z, m.x_axis.y - m.y_axis.x);
    let sine = axis.dot(vee);
    if cosine == 0.0 && sine == 0.0 {
        return DQuat::IDENTITY;
    }
    DQuat::from_axis_angle(axis, sine.atan2(cosine))
}

/// The rotation R that maximises tr(RᵀM), reflections excluded, and the degrees of freedom that M determines.
pub(crate) fn nearest_rotation(m: &Matrix3<f64>) -> (DQuat, Shape) {
    let (right, images) = singular_columns(m);
    let size = images.map(DVec3::length);
    let largest = size[0];
    if largest.is_nan() || largest <= f64::MIN_POSITIVE {
        return (DQuat::IDENTITY, Shape::Point);
    }
    let u0 = images[0] / size[0];
    if size[1] <= RANK_TOLERANCE * largest {
        return (DQuat::from_rotation_arc(right[0], u0).normalize(), Shape::Line);
    }
    let u1 = u0.cross(images[1].cross(u0)).normalize();
    // The third column completes a right-handed basis on both sides. This is the optimum without reflection
    // and does not depend on the arbitrary signs of the null space.
    let left = DMat3::from_cols(u0, u1, u0.cross(u1));
    let right = DMat3::from_cols(right[0], right[1], right[0].cross(right[1]));
    (DQuat::from_mat3(&(left * right.transpose())).normalize(), Shape::General)
}

/// The right singular vectors of a matrix and their images: its left singular vectors times its singular
/// values, the largest first.
///
/// One-sided Jacobi: the directions of the small singular values are as accurate as those of the large
/// ones. Via MᵀM, a nearly straight path would lose half of its digits.
fn singular_columns(m: &Matrix3<f64>) -> ([DVec3; 3], [DVec3; 3]) {
    const MOST_SWEEPS: usize = 30;
    let mut images = [0, 1, 2].map(|c| DVec3::new(m[(0, c)], m[(1, c)], m[(2, c)]));
    let mut right = [DVec3::X, DVec3::Y, DVec3::Z];
    for _ in 0..MOST_SWEEPS {
        let mut turned = false;
        for (p, q) in [(0, 1), (0, 2), (1, 2)] {
            let (a, b) = (images[p].length_squared(), images[q].length_squared());
            let along = images[p].dot(images[q]);
            if along.abs() <= f64::EPSILON * (a * b).sqrt() {
                continue;
            }
            turned = true;
            let zeta = (b - a) / (2.0 * along);
            let tangent = zeta.signum() / (zeta.abs() + zeta.hypot(1.0));
            let cosine = 1.0 / tangent.hypot(1.0);
            let sine = cosine * tangent;
            for columns in [&mut images, &mut right] {
                let (x, y) = (columns[p], columns[q]);
                columns[p] = cosine * x - sine * y;
                columns[q] = sine * x + cosine * y;
            }
        }
        if !turned {
            break;
        }
    }
    let mut order = [0, 1, 2];
    order.sort_by(|a, b| images[*b].length().total_cmp(&images[*a].length()));
    (order.map(|i| right[i].normalize()), order.map(|i| images[i]))
}

/// Weighted means, covariance and spread of paired points.
struct Moments {
    mean_estimate: DVec3,
    mean_reference: DVec3,
    /// Σ w (reference − mean)(estimate − mean)ᵀ / Σ w.
    covariance: DMat3,
    /// Σ w |estimate − mean|² / Σ w.
    spread: f64,
    /// Σ w |reference − mean|² / Σ w.
    spread_reference: f64,
}

impl Moments {
    fn gather(a: &[DVec3], b: &[DVec3], weights: Option<&[f64]>) -> Result<Moments> {
        let op = "alignment";
        if a.len() != b.len() {
            let expected = format!("{}, one for each estimate", a.len());
            return Err(Error::Shape { op, arg: "reference", expected, actual: b.len() });
        }
        if let Some(w) = weights
            && w.len() != a.len()
        {
            let expected = format!("{}, one for each pair", a.len());
            return Err(Error::Shape { op, arg: "weights", expected, actual: w.len() });
        }
        if a.is_empty() {
            return Err(Error::Input(
                "alignment: no pairs of positions; do the two trajectories share time stamps?"
                    .into(),
            ));
        }
        let weight = |i: usize| weights.map_or(1.0, |w| w[i]);
        let (mut total, mut ma, mut mb) = (0.0, DVec3::ZERO, DVec3::ZERO);
        for i in 0..a.len() {
            let w = weight(i);
            if !(a[i].is_finite() && b[i].is_finite() && w.is_finite() && w >= 0.0) {
                return Err(Error::Input(format!(
                    "alignment: pair {i} has a position that is not finite or a negative weight \
                     ({}, {}, weight {w}); leave it out",
                    a[i], b[i]
                )));
            }
            total += w;
            ma += w * a[i];
            mb += w * b[i];
        }
        if total <= 0.0 {
            return Err(Error::Input("alignment: every pair has weight 0".into()));
        }
        let (ma, mb) = (ma / total, mb / total);
        let (mut covariance, mut spread, mut spread_reference) = (DMat3::ZERO, 0.0, 0.0);
        for i in 0..a.len() {
            let w = weight(i) / total;
            let (da, db) = (a[i] - ma, b[i] - mb);
            covariance += DMat3::from_cols(db * da.x, db * da.y, db * da.z) * w;
            spread += w * da.length_squared();
            spread_reference += w * db.length_squared();
        }
        // Positions that differ only by rounding count as coincident.
        for (spread, mean) in [(&mut spread, ma), (&mut spread_reference, mb)] {
            if *spread <= (mean.length_squared() + *spread) * 1e-28 {
                *spread = 0.0;
                covariance = DMat3::ZERO;
            }
        }
        Ok(Moments { mean_estimate: ma, mean_reference: mb, covariance, spread, spread_reference })
    }

    fn rotation(&self) -> (DQuat, Shape) {
        let size = (self.spread * self.spread_reference).sqrt();
        // The covariance is normalised so that thresholds are independent of the scene's scale.
        if size.is_nan() || size <= 0.0 {
            return (DQuat::IDENTITY, Shape::Point);
        }
        nearest_rotation(&matrix3(&(self.covariance * (1.0 / size))))
    }

    /// The estimate's main direction: the right singular vector of the covariance.
    fn direction(&self) -> DVec3 {
        let size = (self.spread * self.spread_reference).sqrt();
        singular_columns(&matrix3(&(self.covariance * (1.0 / size)))).0[0]
    }

    fn finish(
        &self,
        rotation: DQuat,
        shape: Shape,
        with_scale: bool,
        a: &[DVec3],
        b: &[DVec3],
        weights: Option<&[f64]>,
    ) -> Alignment {
        let turned = DMat3::from_quat(rotation);
        // tr(Rᵀ C) / spread is Umeyama's tr(DS)/σ² for any R, so it also applies to a partly undetermined
        // rotation.
        let trace = (0..3).map(|k| turned.col(k).dot(self.covariance.col(k))).sum::<f64>();
        let scale = if with_scale && self.spread > 0.0 { trace / self.spread } else { 1.0 };
        // A static reference with a moving estimate would give scale 0.
        let scale = if scale.is_finite() && scale > 0.0 { scale } else { 1.0 };
        let translation = self.mean_reference - scale * (rotation * self.mean_estimate);
        let transform = Sim3 { scale, rotation, translation };
        let (mut sum, mut total) = (0.0, 0.0);
        for i in 0..a.len() {
            let w = weights.map_or(1.0, |w| w[i]);
            sum += w * (transform.apply(a[i]) - b[i]).length_squared();
            total += w;
        }
        Alignment { reference_from_estimate: transform, shape, rmse: (sum / total).sqrt() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A coincident reference whose mean is affected by rounding: ten times 0.1 makes 0.9999999999999999.
    #[test]
    fn a_reference_that_stands_still_is_a_point() {
        let pose = |x: f64| Pose::new(DQuat::IDENTITY, DVec3::new(x, 0.7 * x, 0.1));
        let estimate: Vec<Pose> = (0..10).map(|i| pose(f64::from(i * i))).collect();
        let reference = vec![pose(0.1); 10];
        let sum = reference.iter().map(|pose| pose.translation.x).sum::<f64>();
        assert_ne!(sum / 10.0, 0.1, "the mean is not exact");
        let found = align_cameras(&estimate, &reference, true).unwrap();
        assert_eq!((found.shape, found.reference_from_estimate.scale), (Shape::Point, 1.0));
    }
    use crate::geometry::se3::angle_between;

    fn rotation_error(a: &Sim3, b: &Sim3) -> f64 {
        angle_between(a.rotation, b.rotation)
    }

    fn truth() -> Sim3 {
        Sim3 {
            scale: 2.5,
            rotation: exp_so3(DVec3::new(0.7, -1.1, 0.4)),
            translation: DVec3::new(3.0, -4.0, 5.0),
        }
    }

    fn cloud() -> Vec<DVec3> {
        (0..20)
            .map(|i| {
                let t = i as f64;
                DVec3::new((1.3 * t).sin(), (0.7 * t).cos() * 2.0, (0.9 * t + 1.0).sin())
            })
            .collect()
    }

    #[test]
    fn group_laws() {
        let s = truth();
        let p = DVec3::new(0.1, 0.2, 0.3);
        assert!((s.inverse().apply(s.apply(p)) - p).length() < 1e-14);
        assert!(((s * s).apply(p) - s.apply(s.apply(p))).length() < 1e-13);
    }

    #[test]
    fn recovers_a_similarity_also_from_a_plane_and_far_from_the_origin() {
        for (flat, offset) in [(1.0, 0.0), (0.0, 0.0), (1.0, 1e6)] {
            let a: Vec<DVec3> =
                cloud().iter().map(|p| DVec3::new(p.x, p.y, p.z * flat) + offset).collect();
            let b: Vec<DVec3> = a.iter().map(|&p| truth().apply(p)).collect();
            let found = align_points(&a, &b, None, true).unwrap();
            let s = found.reference_from_estimate;
            assert_eq!(found.shape, Shape::General);
            assert!((s.scale - 2.5).abs() < 1e-8, "{s:?}");
            assert!(rotation_error(&s, &truth()) < 1e-8);
            assert!(found.rmse < 1e-7);
        }
    }

    #[test]
    fn a_path_that_is_nearly_a_line_is_turned_exactly() {
        let a: Vec<DVec3> = cloud().iter().map(|p| *p * DVec3::new(1e-5, 2e-5, 1.0)).collect();
        let b: Vec<DVec3> = a.iter().map(|&p| truth().apply(p)).collect();
        let found = align_points(&a, &b, None, true).unwrap();
        assert_eq!(found.shape, Shape::General);
        let error = rotation_error(&found.reference_from_estimate, &truth());
        assert!(error < 1e-9, "{error}");
    }

    #[test]
    fn mirrored_points_get_a_rotation_not_a_reflection() {
        let a = cloud();
        let b: Vec<DVec3> = a.iter().map(|p| DVec3::new(-p.x, p.y, p.z)).collect();
        let found = align_points(&a, &b, None, true).unwrap();
        let r = DMat3::from_quat(found.reference_from_estimate.rotation);
        assert!((r.determinant() - 1.0).abs() < 1e-12);
        assert!(found.rmse > 0.1, "a reflection cannot be fitted");
        // No small rotation or change of scale is better, so this is a minimum.
        let cost = |s: &Sim3| -> f64 {
            a.iter().zip(&b).map(|(&p, &q)| (s.apply(p) - q).length_squared()).sum()
        };
        let best = cost(&found.reference_from_estimate);
        for axis in [DVec3::X, DVec3::Y, DVec3::Z] {
            for turn in [-0.02, 0.02] {
                let mut s = found.reference_from_estimate;
                let mean = a.iter().sum::<DVec3>() / a.len() as f64;
                let fixed = s.apply(mean);
                s.rotation = exp_so3(axis * turn) * s.rotation;
                s.translation = fixed - s.scale * (s.rotation * mean);
                assert!(cost(&s) > best);
            }
        }
    }

    #[test]
    fn weights_silence_a_bad_pair() {
        let a = cloud();
        let mut b: Vec<DVec3> = a.iter().map(|&p| truth().apply(p)).collect();
        b[3] += DVec3::splat(100.0);
        let mut w = vec![1.0; a.len()];
        w[3] = 0.0;
        let found = align_points(&a, &b, Some(&w), true).unwrap();
        assert!(found.rmse < 1e-12 && (found.reference_from_estimate.scale - 2.5).abs() < 1e-12);
    }

    #[test]
    fn a_line_of_centres_takes_the_free_turn_from_the_axes() {
        let estimate: Vec<Pose> = (0..8)
            .map(|i| {
                let axes = exp_so3(DVec3::new(0.1 * i as f64, 0.3, -0.2));
                Pose::new(axes, DVec3::new(1.0, 2.0, -0.5) * i as f64)
            })
            .collect();
        let reference: Vec<Pose> = estimate.iter().map(|p| truth().apply_pose(p)).collect();
        let found = align_poses(&estimate, &reference, true).unwrap();
        assert_eq!(found.shape, Shape::Line);
        assert!(rotation_error(&found.reference_from_estimate, &truth()) < 1e-9);
        assert!(found.rmse < 1e-9);
        let a: Vec<DVec3> = estimate.iter().map(|p| p.translation).collect();
        let b: Vec<DVec3> = reference.iter().map(|p| p.translation).collect();
        let points = align_points(&a, &b, None, true).unwrap();
        assert!(points.shape == Shape::Line && points.rmse < 1e-9);
        assert!((points.reference_from_estimate.scale - 2.5).abs() < 1e-9);
    }

    #[test]
    fn cameras_on_a_wobbling_line_are_mapped_by_their_axes() {
        let line = |wobble: &dyn Fn(f64) -> DVec3| -> Vec<Pose> {
            let at = |t: f64| {
                let turn = exp_so3(DVec3::new(0.0, 0.01 * t, 0.0));
                Pose::new(turn, DVec3::X * t + wobble(t) * 0.02)
            };
            (0..20).map(|i| at(f64::from(i))).collect()
        };
        // Noise that differs between the two worlds.
        let estimate = line(&|t| DVec3::new(0.0, (7.0 * t).sin(), (3.0 * t).cos()));
        let reference: Vec<Pose> = line(&|t| DVec3::new(0.0, (5.0 * t).cos(), (2.2 * t).sin()))
            .iter()
            .map(|p| truth().apply_pose(p))
            .collect();
        let cameras = align_cameras(&estimate, &reference, true).unwrap();
        let centres = align_poses(&estimate, &reference, true).unwrap();
        assert!(rotation_error(&cameras.reference_from_estimate, &truth()) < 0.01);
        assert!(rotation_error(&centres.reference_from_estimate, &truth()) > 0.1);
        assert!(cameras.rmse < 0.1, "no more than the wobble itself: {}", cameras.rmse);
        // Where all cameras agree exactly, both methods agree.
        let exact: Vec<Pose> = estimate.iter().map(|p| truth().apply_pose(p)).collect();
        let found = align_cameras(&estimate, &exact, true).unwrap();
        assert!(found.rmse < 1e-12 && (found.reference_from_estimate.scale - 2.5).abs() < 1e-12);
        assert!(align_cameras(&estimate[..1], &exact[..1], true).unwrap().rmse < 1e-12);
        assert!(align_cameras(&[], &[], true).is_err());
    }

    /// A short path of a camera that rotates, with errors of the centres by a few per cent of its length
    /// across it, and of the rotations by 0.05°.
    #[test]
    fn a_short_noisy_path_is_turned_by_its_axes_alone() {
        let wave = |i: usize, k: f64| (k * i as f64 + k * k).sin();
        let noise = |i: usize, k: f64| DVec3::new(wave(i, k), wave(i, k + 1.7), wave(i, k + 3.1));
        let estimate: Vec<Pose> = (0..30)
            .map(|i| {
                let t = i as f64 / 29.0;
                let axes = exp_so3(DVec3::new(0.02 * (6.0 * t).sin(), 0.1 * t, 0.01));
                Pose::new(axes, DVec3::new(0.6 * t, 0.05 * (5.0 * t).sin(), 0.1 * t * t))
            })
            .collect();
        let reference: Vec<Pose> = (0..30)
            .map(|i| {
                let mut pose = estimate[i];
                // A bend as caused by a wrong focal length, which does not average out.
                pose.translation.y += 0.04 * (i as f64 / 29.0 - 0.5) + 0.002 * wave(i, 2.3);
                pose.rotation = exp_so3(noise(i, 0.9) * 0.05f64.to_radians()) * pose.rotation;
                truth().apply_pose(&pose)
            })
            .collect();
        let error = |found: Alignment| {
            rotation_error(&found.reference_from_estimate, &truth()).to_degrees()
        };
        let cameras = align_cameras(&estimate, &reference, true).unwrap();
        let centres = align_poses(&estimate, &reference, true).unwrap();
        assert!((cameras.reference_from_estimate.scale / 2.5 - 1.0).abs() < 0.01);
        let (cameras, centres) = (error(cameras), error(centres));
        assert!(cameras < 0.03, "{cameras}° by the axes");
        assert!(centres > 1.0, "{centres}° by the centres");
        let mut outlier = reference;
        outlier[7].rotation = exp_so3(DVec3::X * 10f64.to_radians()) * outlier[7].rotation;
        let robust = error(align_cameras(&estimate, &outlier, true).unwrap());
        assert!(robust < 0.04, "{robust}° with one camera off by 10°");
    }

    #[test]
    fn one_place_takes_the_rotation_from_the_axes_and_scale_one() {
        let turn = exp_so3(DVec3::new(0.2, 0.5, -0.9));
        let estimate: Vec<Pose> =
            (0..4).map(|i| Pose::new(exp_so3(DVec3::X * i as f64 * 0.2), DVec3::ONE)).collect();
        let reference: Vec<Pose> =
            estimate.iter().map(|p| Pose::new(turn * p.rotation, DVec3::ZERO)).collect();
        let found = align_poses(&estimate, &reference, true).unwrap();
        assert_eq!(found.shape, Shape::Point);
        assert_eq!(found.reference_from_estimate.scale, 1.0);
        assert!(angle_between(found.reference_from_estimate.rotation, turn) < 1e-9);
        assert!(found.rmse < 1e-12);
    }

    #[test]
    fn an_estimate_that_stands_still_gives_a_finite_answer() {
        let a = vec![DVec3::new(0.1, 0.2, 0.3); 5];
        let found = align_points(&a, &cloud()[..5], None, true).unwrap();
        assert!(found.rmse.is_finite() && found.reference_from_estimate.scale == 1.0);
        let found = align_points(&cloud()[..5], &a, None, true).unwrap();
        assert!(found.rmse.is_finite() && found.reference_from_estimate.scale > 0.0);
    }

    #[test]
    fn bad_input_is_named() {
        assert!(align_points(&[], &[], None, true).is_err());
        assert!(align_points(&[DVec3::ONE], &[], None, true).is_err());
        let nan = [DVec3::new(f64::NAN, 0.0, 0.0)];
        let message = align_points(&nan, &[DVec3::ONE], None, true).unwrap_err().to_string();
        assert!(message.contains("pair 0"), "{message}");
        assert!(align_points(&[DVec3::ONE], &[DVec3::ONE], Some(&[0.0]), true).is_err());
    }
}
