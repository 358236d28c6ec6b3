//! Absolute and relative errors of a camera trajectory.
//!
//! The definitions are those of Sturm et al. (IROS 2012), Zhang and Scaramuzza (IROS 2018) and the
//! evaluation of MonST3R, Sintel and TUM; the values agree with the `evo` package. The absolute trajectory
//! error (ATE, or APE) compares each pose after one global alignment. The relative pose error (RPE)
//! compares the motion from one pose to a later one after the same alignment, hence in the reference's
//! scale.
//!
//! Rotation matrices of a file are compared as stored: rounding leaves them slightly off a rotation, which
//! affects a relative translation.

use glam::DAffine3;

use crate::error::{Error, Result};
use crate::geometry::se3::{log_so3, matrix3};
use crate::geometry::sim3::{Alignment, Shape, Sim3, align_poses, nearest_rotation};
use crate::types::Pose;

/// Degrees of freedom of the global alignment.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Align {
    /// No alignment: both trajectories are already in one frame.
    None,
    /// Rotation and translation that make the first poses agree.
    Origin,
    /// Scale only.
    Scale,
    /// Rotation and translation.
    Se3,
    /// Rotation, translation and scale: for monocular methods.
    Sim3,
}

/// Unit of the distance between the two poses of a relative error.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Step {
    /// Number of poses.
    Frames,
    /// Length of the path between them, in the reference's units.
    Metres,
    /// Rotation in degrees: summed along the path, or between the two poses where all pairs are used.
    Degrees,
}

/// Selection of the pose pairs for relative errors.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Relative {
    /// Distance between the two poses of a pair; an integer for frames.
    pub delta: f64,
    /// Unit of the distance.
    pub step: Step,
    /// Tolerance of the distance, as a share of `delta`, where all pairs are selected by metres or degrees.
    pub tolerance: f64,
    /// Use every pair at that distance, instead of consecutive pairs that begin where the previous one ends.
    pub all_pairs: bool,
    /// Measure metres and degrees along the reference instead of the estimate.
    pub along_reference: bool,
}

impl Default for Relative {
    /// From each frame to the next.
    fn default() -> Relative {
        Relative {
            delta: 1.0,
            step: Step::Frames,
            tolerance: 0.1,
            all_pairs: false,
            along_reference: false,
        }
    }
}

/// Settings of a trajectory comparison.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Comparison {
    /// Degrees of freedom of the alignment.
    pub align: Align,
    /// Number of poses, from the first, that determine the alignment; `None` for all.
    pub align_first: Option<usize>,
    /// The pairs for relative errors.
    pub relative: Relative,
}

impl From<Align> for Comparison {
    fn from(align: Align) -> Comparison {
        Comparison { align, align_first: None, relative: Relative::default() }
    }
}

/// Summary of a list of errors.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Statistics {
    /// Root of the mean square.
    pub rmse: f64,
    /// Mean.
    pub mean: f64,
    /// Median; the mean of the middle two where the count is even.
    pub median: f64,
    /// Population standard deviation (divided by the number of values).
    pub std: f64,
    /// Smallest.
    pub min: f64,
    /// Largest.
    pub max: f64,
    /// Sum of the squares.
    pub sse: f64,
}

impl Statistics {
    /// Statistics of a list; all zero for an empty one.
    fn of(mut values: Vec<f64>) -> Statistics {
        let n = values.len();
        if n == 0 {
            return Statistics::default();
        }
        values.sort_by(f64::total_cmp);
        let count = n as f64;
        let sse = values.iter().map(|v| v * v).sum::<f64>();
        let mean = values.iter().sum::<f64>() / count;
        let variance = values.iter().map(|v| (v - mean) * (v - mean)).sum::<f64>() / count;
        Statistics {
            rmse: (sse / count).sqrt(),
            mean,
            median: 0.5 * (values[(n - 1) / 2] + values[n / 2]),
            std: variance.sqrt(),
            min: values[0],
            max: values[n - 1],
            sse,
        }
    }
}

/// Errors of an estimated trajectory.
#[derive(Clone, Debug)]
pub struct TrajectoryErrors {
    /// Distance between the aligned camera centres, in the reference's units.
    pub ate: Statistics,
    /// Angle between the aligned cameras, degrees.
    pub ate_rot_deg: Statistics,
    /// `ate.rmse` over the length of the reference's path; for a path of length 0 it is infinite with
    /// errors and 0 without.
    pub ate_relative: f64,
    /// Translation error of the relative motion between the poses of each pair, in the reference's units.
    pub rpe_trans: Statistics,
    /// Rotation error of the same motion, degrees.
    pub rpe_rot_deg: Statistics,
    /// Number of pose pairs for the relative errors.
    pub rpe_pairs: usize,
    /// Alignment of the estimate; the identity for [`Align::None`].
    pub reference_from_estimate: Sim3,
    /// Degrees of freedom of the rotation that the reference's centres determine; see [`Shape`].
    pub shape: Shape,
    /// Length of the reference's path over the paired poses.
    pub path_length: f64,
    /// Number of paired poses.
    pub poses: usize,
}

/// Compares two trajectories (`world_from_view` each, paired by index), with the relative errors from each
/// frame to the next.
///
/// A single pose has no motion, so its RPE is 0. Collinear or coincident centres are aligned as described
/// for [`align_poses`].
///
/// # Errors
/// Lists of differing length, empty ones, poses that are not finite.
pub fn compare_trajectories(
    estimate: &[Pose],
    reference: &[Pose],
    align: Align,
) -> Result<TrajectoryErrors> {
    let [estimate, reference] = [estimate, reference].map(|poses| {
        let rigid =
            |p: &Pose| DAffine3 { matrix3: p.rotation_matrix(), translation: p.translation };
        poses.iter().map(rigid).collect::<Vec<DAffine3>>()
    });
    compare_matrices(&estimate, &reference, &align.into())
}

/// [`compare_trajectories`] for `world_from_view` matrices as files contain them: rotations up to rounding.
///
/// # Errors
/// Those of [`compare_trajectories`]; a `delta` that is not above 0, or not an integer where it counts
/// frames.
pub fn compare_matrices(
    estimate: &[DAffine3],
    reference: &[DAffine3],
    how: &Comparison,
) -> Result<TrajectoryErrors> {
    let Relative { delta, step, tolerance, .. } = how.relative;
    if !(delta > 0.0 && tolerance >= 0.0 && (step != Step::Frames || delta.fract() == 0.0)) {
        return Err(Error::Input(format!(
            "relative errors: a distance of {delta:?} {}, within {tolerance:?}, makes no sense; give \
             one above 0, of frames a whole number",
            match step {
                Step::Frames => "frames",
                Step::Metres => "metres",
                Step::Degrees => "degrees",
            }
        )));
    }
    for (name, poses) in [("estimate", estimate), ("reference", reference)] {
        if let Some(i) = poses.iter().position(|p| !p.is_finite()) {
            return Err(Error::Input(format!(
                "trajectory errors: pose {i} of the {name} is not finite; leave it out of both"
            )));
        }
    }
    let aligning = Aligning::of(estimate, reference, how)?;
    let aligned: Vec<DAffine3> = estimate.iter().map(|p| aligning.apply(p)).collect();
    let both = || aligned.iter().zip(reference);
    let distance = |(a, b): (&DAffine3, &DAffine3)| (a.translation - b.translation).length();
    let ate = Statistics::of(both().map(distance).collect());
    let turn = |(a, b): (&DAffine3, &DAffine3)| angle(&inverse_times(a, b)).to_degrees();
    let ate_rot_deg = Statistics::of(both().map(turn).collect());
    let counted = if how.relative.along_reference { reference } else { &aligned };
    let pairs = pairs(counted, &how.relative);
    let (mut translations, mut rotations) = (Vec::new(), Vec::new());
    for &(i, j) in &pairs {
        let motion = |p: &[DAffine3]| inverse_times(&p[i], &p[j]);
        let error = inverse_times(&motion(reference), &motion(&aligned));
        translations.push(error.translation.length());
        rotations.push(angle(&error).to_degrees());
    }
    let path_length = lengths(reference).last().copied().unwrap_or(0.0);
    let ate_relative = if ate.rmse == 0.0 { 0.0 } else { ate.rmse / path_length };
    Ok(TrajectoryErrors {
        ate,
        ate_rot_deg,
        ate_relative,
        rpe_trans: Statistics::of(translations),
        rpe_rot_deg: Statistics::of(rotations),
        rpe_pairs: pairs.len(),
        reference_from_estimate: aligning.transform,
        shape: aligning.shape,
        path_length,
        poses: estimate.len(),
    })
}

/// Alignment of the estimate with the reference.
struct Aligning {
    /// As reported.
    transform: Sim3,
    /// As applied: centres are scaled first.
    scale: f64,
    rigid: DAffine3,
    shape: Shape,
}

impl Aligning {
    fn of(estimate: &[DAffine3], reference: &[DAffine3], how: &Comparison) -> Result<Aligning> {
        let first = how.align_first.unwrap_or(usize::MAX).max(1);
        // Lists of differing length are rejected by the alignment.
        let same = estimate.len() == reference.len();
        let part = |poses: &[DAffine3]| -> Vec<Pose> {
            let count = if same { first.min(poses.len()) } else { poses.len() };
            poses[..count].iter().map(nearest_pose).collect()
        };
        let with_scale = matches!(how.align, Align::Scale | Align::Sim3);
        let Alignment { reference_from_estimate: fitted, shape, .. } =
            align_poses(&part(estimate), &part(reference), with_scale)?;
        let (scale, rigid) = match how.align {
            Align::None => (1.0, DAffine3::IDENTITY),
            Align::Origin => (1.0, reference[0] * rigid_inverse(&estimate[0])),
            Align::Scale => (fitted.scale, DAffine3::IDENTITY),
            Align::Se3 | Align::Sim3 => {
                let rigid =
                    DAffine3::from_rotation_translation(fitted.rotation, fitted.translation);
                (fitted.scale, rigid)
            }
        };
        let Pose { rotation, translation } = nearest_pose(&rigid);
        Ok(Aligning { transform: Sim3 { scale, rotation, translation }, scale, rigid, shape })
    }

    fn apply(&self, pose: &DAffine3) -> DAffine3 {
        self.rigid * DAffine3 { translation: self.scale * pose.translation, ..*pose }
    }
}

/// The pose with the nearest rotation to a matrix.
fn nearest_pose(rigid: &DAffine3) -> Pose {
    let (rotation, _) = nearest_rotation(&matrix3(&rigid.matrix3));
    Pose::new(rotation, rigid.translation)
}

/// The inverse of a rigid transform by its transpose, even where rounding left it slightly non-rigid.
fn rigid_inverse(a: &DAffine3) -> DAffine3 {
    let inverse = a.matrix3.transpose();
    DAffine3 { matrix3: inverse, translation: -(inverse * a.translation) }
}

/// a⁻¹ b.
fn inverse_times(a: &DAffine3, b: &DAffine3) -> DAffine3 {
    rigid_inverse(a) * *b
}

/// The angle of a transform's rotation, radians in [0, π].
fn angle(rigid: &DAffine3) -> f64 {
    log_so3(nearest_pose(rigid).rotation).length()
}

/// Path length from the first pose to each pose.
fn lengths(poses: &[DAffine3]) -> Vec<f64> {
    let mut lengths = Vec::with_capacity(poses.len());
    let mut length = 0.0;
    for (i, pose) in poses.iter().enumerate() {
        if i > 0 {
            length += (pose.translation - poses[i - 1].translation).length();
        }
        lengths.push(length);
    }
    lengths
}

/// The pose pairs for relative errors.
fn pairs(poses: &[DAffine3], relative: &Relative) -> Vec<(usize, usize)> {
    let Relative { delta, step, all_pairs, .. } = *relative;
    let off = delta * relative.tolerance;
    match (step, all_pairs) {
        (Step::Frames, true) => {
            let step = delta as usize;
            (step..poses.len()).map(|j| (j - step, j)).collect()
        }
        (Step::Frames, false) => {
            let step = delta as usize;
            let ends = (1..).map_while(|k: usize| k.checked_mul(step));
            ends.take_while(|j| *j < poses.len()).map(|j| (j - step, j)).collect()
        }
        (Step::Metres, true) => {
            let lengths = lengths(poses);
            (0..poses.len()).filter_map(|i| nearest_length(&lengths, i, delta, off)).collect()
        }
        (Step::Metres, false) => {
            one_after_another(poses, delta, |a, b| (b.translation - a.translation).length())
        }
        (Step::Degrees, true) => {
            let range = (delta - off).to_radians()..=(delta + off).to_radians();
            let turns: Vec<_> = poses.iter().map(|pose| nearest_pose(pose).rotation).collect();
            let pair = |i: usize, j: usize| {
                let turn = log_so3(turns[i].conjugate() * turns[j]).length();
                range.contains(&turn).then_some((i, j))
            };
            let from = |i: usize| (i + 1..poses.len()).filter_map(move |j| pair(i, j));
            (0..poses.len()).flat_map(from).collect()
        }
        (Step::Degrees, false) => {
            one_after_another(poses, delta.to_radians(), |a, b| angle(&inverse_times(a, b)))
        }
    }
}

/// Consecutive pairs, each of which begins where the previous one ends and ends as soon as the sum of
/// `away` between neighbours reaches `delta`.
fn one_after_another(
    poses: &[DAffine3],
    delta: f64,
    away: impl Fn(&DAffine3, &DAffine3) -> f64,
) -> Vec<(usize, usize)> {
    let (mut pairs, mut first, mut sum) = (Vec::new(), 0, 0.0);
    for j in 1..poses.len() {
        sum += away(&poses[j - 1], &poses[j]);
        if sum >= delta {
            pairs.push((first, j));
            (first, sum) = (j, 0.0);
        }
    }
    pairs
}

/// The pose after the `i`-th whose path length from it is nearest to `delta`, the first of equally near
/// ones, if it deviates by at most `off`.
fn nearest_length(lengths: &[f64], i: usize, delta: f64, off: f64) -> Option<(usize, usize)> {
    // Lengths are monotonic, so the nearest is one of the two around `delta`.
    let after = &lengths[i + 1..];
    let way = |k: usize| after[k] - lengths[i];
    let above = after.partition_point(|length| length - lengths[i] < delta);
    let below = above.checked_sub(1).map(|k| after.partition_point(|l| l - lengths[i] < way(k)));
    let candidates = [below, Some(above).filter(|k| *k < after.len())];
    let error = |k: &usize| (way(*k) - delta).abs();
    let nearest = candidates.into_iter().flatten().min_by(|a, b| error(a).total_cmp(&error(b)))?;
    (error(&nearest) <= off).then_some((i, i + 1 + nearest))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::se3::exp_so3;
    use glam::DVec3;

    fn path(n: usize) -> Vec<Pose> {
        (0..n)
            .map(|i| {
                let t = i as f64 * 0.3;
                let centre = DVec3::new(t.sin() * 2.0, 0.3 * t, t.cos());
                Pose::new(exp_so3(DVec3::new(0.1 * t, -0.2 * t, 0.05)), centre)
            })
            .collect()
    }

    #[test]
    fn a_similar_trajectory_has_no_error_under_sim3_alone() {
        let s = Sim3 {
            scale: 0.3,
            rotation: exp_so3(DVec3::new(0.4, 1.0, -0.7)),
            translation: DVec3::new(5.0, 6.0, 7.0),
        };
        let reference = path(30);
        let estimate: Vec<Pose> = reference.iter().map(|p| s.apply_pose(p)).collect();
        let errors = compare_trajectories(&estimate, &reference, Align::Sim3).unwrap();
        assert!(errors.ate.max < 1e-12 && errors.rpe_trans.max < 1e-12);
        assert!(errors.rpe_rot_deg.max < 1e-6);
        assert!((errors.reference_from_estimate.scale - 1.0 / 0.3).abs() < 1e-9);
        let errors = compare_trajectories(&estimate, &reference, Align::Se3).unwrap();
        assert!(errors.ate.rmse > 0.1, "scale is not corrected");
        let errors = compare_trajectories(&estimate, &reference, Align::None).unwrap();
        assert!(errors.ate.rmse > 5.0, "nothing is corrected");
    }

    #[test]
    fn relative_errors_see_a_turn_of_one_frame_twice() {
        let reference = path(10);
        let mut estimate = reference.clone();
        estimate[4].rotation *= exp_so3(DVec3::new(0.0, 0.0, 2f64.to_radians()));
        let errors = compare_trajectories(&estimate, &reference, Align::None).unwrap();
        assert!((errors.rpe_rot_deg.max - 2.0).abs() < 1e-9);
        assert!((errors.rpe_rot_deg.rmse - (2.0 * 4.0 / 9.0f64).sqrt()).abs() < 1e-9);
        assert_eq!(errors.ate.max, 0.0);
        assert!(errors.rpe_rot_deg.median < 1e-9);
    }

    #[test]
    fn short_and_bad_lists() {
        let one = compare_trajectories(&path(1), &path(1), Align::Sim3).unwrap();
        assert!(one.ate.rmse == 0.0 && one.rpe_trans.rmse == 0.0 && one.ate_relative == 0.0);
        assert!(compare_trajectories(&[], &[], Align::Sim3).is_err());
        assert!(compare_trajectories(&path(3), &path(2), Align::Sim3).is_err());
        let mut bad = path(3);
        bad[1].translation.x = f64::NAN;
        let message = compare_trajectories(&bad, &path(3), Align::Sim3).unwrap_err().to_string();
        assert!(message.contains("pose 1 of the estimate"), "{message}");
    }

    fn matrices(poses: &[Pose]) -> Vec<DAffine3> {
        let rigid = |p: &Pose| DAffine3::from_rotation_translation(p.rotation, p.translation);
        poses.iter().map(rigid).collect()
    }

    #[test]
    fn statistics_of_a_list() {
        let found = Statistics::of(vec![4.0, 1.0, 2.0, 3.0]);
        assert_eq!((found.min, found.max, found.mean, found.median), (1.0, 4.0, 2.5, 2.5));
        assert_eq!((found.sse, found.std, found.rmse), (30.0, 1.25f64.sqrt(), 7.5f64.sqrt()));
        assert_eq!(Statistics::of(Vec::new()), Statistics::default());
    }

    #[test]
    fn alignments_change_what_they_may() {
        let reference = path(30);
        let turn = Pose::new(exp_so3(DVec3::new(0.1, 0.7, -0.3)), DVec3::new(4.0, 5.0, 6.0));
        let turned: Vec<Pose> = reference.iter().map(|p| turn * *p).collect();
        let doubled: Vec<Pose> =
            reference.iter().map(|p| Pose { translation: 2.0 * p.translation, ..*p }).collect();
        let rmse = |estimate: &[Pose], align| {
            let found = compare_trajectories(estimate, &reference, align).unwrap();
            found.ate.rmse.max(found.ate_rot_deg.rmse)
        };
        assert!(rmse(&turned, Align::Origin) < 1e-6 && rmse(&turned, Align::Se3) < 1e-6);
        assert!(rmse(&turned, Align::Scale) > 1.0 && rmse(&doubled, Align::Origin) > 0.1);
        assert!(rmse(&doubled, Align::Sim3) < 1e-6);
        // The scale is the one that fits after full alignment.
        let scale = compare_trajectories(&doubled, &reference, Align::Scale).unwrap();
        assert!((scale.reference_from_estimate.scale - 0.5).abs() < 1e-12);
        assert!(scale.ate.rmse < 1e-12);
        // Alignment from the first poses only, on a path that deviates later.
        let mut bent = turned;
        bent[20..].iter_mut().for_each(|p| p.translation.x += 3.0);
        let how = Comparison { align_first: Some(10), ..Align::Se3.into() };
        let found = compare_matrices(&matrices(&bent), &matrices(&reference), &how).unwrap();
        assert!(found.ate.min < 1e-9 && (found.ate.max - 3.0).abs() < 1e-9);
    }

    #[test]
    fn pairs_of_relative_errors() {
        let line: Vec<Pose> = (0..7)
            .map(|i| {
                let turn = exp_so3(DVec3::Z * (10.0 * f64::from(i)).to_radians());
                Pose::new(turn, DVec3::X * f64::from(i) * 0.5)
            })
            .collect();
        let of = |delta, step, all_pairs| {
            let relative = Relative { delta, step, all_pairs, ..Relative::default() };
            pairs(&matrices(&line), &relative)
        };
        assert_eq!(of(2.0, Step::Frames, false), [(0, 2), (2, 4), (4, 6)]);
        assert_eq!(of(4.0, Step::Frames, true), [(0, 4), (1, 5), (2, 6)]);
        assert_eq!(of(4.0, Step::Frames, false), [(0, 4)]);
        assert_eq!(of(7.0, Step::Frames, true), []);
        assert_eq!(of(1e300, Step::Frames, false), []);
        assert_eq!(of(0.9, Step::Metres, false), [(0, 2), (2, 4), (4, 6)]);
        // A metre is 10 % more than 0.91 and more than that beyond 0.9.
        assert_eq!(of(0.91, Step::Metres, true).len(), 5);
        assert_eq!(of(0.9, Step::Metres, true), []);
        assert_eq!(of(25.0, Step::Degrees, false), [(0, 3), (3, 6)]);
        assert_eq!(of(19.0, Step::Degrees, true).len(), 5);
        let how = |delta| Comparison {
            relative: Relative { delta, ..Relative::default() },
            ..Align::None.into()
        };
        for delta in [0.0, -1.0, 1.5, f64::NAN] {
            assert!(compare_matrices(&matrices(&line), &matrices(&line), &how(delta)).is_err());
        }
    }
}
