//! Absolute and relative errors of a camera trajectory.
//!
//! The field's definitions (Sturm et al., IROS 2012; the evaluation of MonST3R, Sintel and TUM):
//! ATE is the distance between camera centres after one global alignment; RPE compares the motion
//! from each frame to the next, after the same alignment (so in the reference's scale).

use crate::error::{Error, Result};
use crate::geometry::se3::log_so3;
use crate::geometry::sim3::{Alignment, Shape, Sim3, align_poses};
use crate::types::Pose;
use std::cmp::{Ordering, Reverse};
use std::collections::{BinaryHeap, VecDeque};

/// What the global alignment may change.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Align {
    /// Nothing: both trajectories are in one frame already.
    None,
    /// Rotation and translation.
    Se3,
    /// Rotation, translation and scale: for monocular methods.
    Sim3,
}

/// Summary of a list of errors.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Statistics {
    /// Root of the mean square.
    pub rmse: f64,
    /// Mean.
    pub mean: f64,
    /// Median; the mean of the middle two where the count is even.
    pub median: f64,
    /// Largest.
    pub max: f64,
}

impl Statistics {
    /// Of a list; all zero for an empty one.
    fn of(mut values: Vec<f64>) -> Statistics {
        let n = values.len();
        if n == 0 {
            return Statistics { rmse: 0.0, mean: 0.0, median: 0.0, max: 0.0 };
        }
        values.sort_by(f64::total_cmp);
        let count = n as f64;
        Statistics {
            rmse: (values.iter().map(|v| v * v).sum::<f64>() / count).sqrt(),
            mean: values.iter().sum::<f64>() / count,
            median: 0.5 * (values[(n - 1) / 2] + values[n / 2]),
            max: values[n - 1],
        }
    }
}

/// Errors of an estimated trajectory.
#[derive(Clone, Debug)]
pub struct TrajectoryErrors {
    /// Distance of the aligned camera centres, in the reference's units.
    pub ate: Statistics,
    /// `ate.rmse` over the length of the reference's path; infinite for a path of length 0 with
    /// errors, 0 without.
    pub ate_relative: f64,
    /// Translation error of the motion from each frame to the next, in the reference's units.
    pub rpe_trans: Statistics,
    /// Rotation error of the same, degrees.
    pub rpe_rot_deg: Statistics,
    /// What aligned the estimate; the identity for [`Align::None`].
    pub reference_from_estimate: Sim3,
    /// What the reference's centres determined of the rotation; see [`Shape`].
    pub shape: Shape,
    /// Length of the reference's path over the paired poses.
    pub path_length: f64,
    /// Paired poses.
    pub poses: usize,
}

/// Compares two trajectories (`world_from_view` each, paired by index).
///
/// A single pose has no motion: its RPE is 0. Centres on one line, or at one place, are aligned as
/// [`align_poses`] says.
///
/// # Errors
/// Lists of differing length, empty ones, poses that are not finite.
pub fn compare_trajectories(
    estimate: &[Pose],
    reference: &[Pose],
    align: Align,
) -> Result<TrajectoryErrors> {
    for (name, poses) in [("estimate", estimate), ("reference", reference)] {
        if let Some(i) =
            poses.iter().position(|p| !(p.translation.is_finite() && p.rotation.is_finite()))
        {
            return Err(Error::Input(format!(
                "trajectory errors: pose {i} of the {name} is not finite; leave it out of both"
            )));
        }
    }
    let Alignment { reference_from_estimate, shape, .. } =
        align_poses(estimate, reference, align == Align::Sim3)?;
    let transform = if align == Align::None { Sim3::IDENTITY } else { reference_from_estimate };
    let aligned: Vec<Pose> = estimate.iter().map(|p| transform.apply_pose(p)).collect();
    let distance = |(a, b): (&Pose, &Pose)| (a.translation - b.translation).length();
    let ate = Statistics::of(aligned.iter().zip(reference).map(distance).collect());
    let (mut translations, mut rotations, mut path_length) = (Vec::new(), Vec::new(), 0.0);
    for (a, b) in aligned.windows(2).zip(reference.windows(2)) {
        let motion = |p: &[Pose]| p[0].inverse() * p[1];
        let error = motion(b).inverse() * motion(a);
        translations.push(error.translation.length());
        rotations.push(log_so3(error.rotation).length().to_degrees());
        path_length += (b[1].translation - b[0].translation).length();
    }
    let ate_relative = if ate.rmse == 0.0 { 0.0 } else { ate.rmse / path_length };
    Ok(TrajectoryErrors {
        ate,
        ate_relative,
        rpe_trans: Statistics::of(translations),
        rpe_rot_deg: Statistics::of(rotations),
        reference_from_estimate: transform,
        shape,
        path_length,
        poses: estimate.len(),
    })
}

/// Pairs (estimate, reference) of time stamps that lie closest to each other, at most
/// `max_difference` (seconds) apart, each used once, in the order of the estimate.
///
/// Close pairs are served first, as TUM's evaluation does; of pairs that are equally close, the one
/// with the lower indices. Time stamps need not be sorted; those that are not finite are never
/// matched. Takes O(n log n) time and linear memory, however many time stamps are equal.
pub fn match_by_time(
    estimate: &[f64],
    reference: &[f64],
    max_difference: f64,
) -> Vec<(usize, usize)> {
    let mut pairs: Vec<(usize, usize)> = Vec::new();
    let mut line = TimeLine::new(estimate, reference, max_difference, &mut pairs);
    while let Some(Reverse(next)) = line.candidates.pop() {
        line.serve(&next, &mut pairs);
    }
    pairs.sort_unstable();
    pairs
}

/// Indices of one list that share a time.
struct Moment {
    time: f64,
    of_estimate: bool,
    /// Those not paired yet, ascending.
    left: VecDeque<usize>,
    before: Option<usize>,
    after: Option<usize>,
}

/// Two neighbouring moments, one of each list, that could be paired next.
struct Candidate {
    difference: f64,
    /// The first of the indices left.
    estimate: usize,
    reference: usize,
    /// The earlier moment and the later one.
    moments: (usize, usize),
}

impl Ord for Candidate {
    fn cmp(&self, other: &Candidate) -> Ordering {
        let indices = |c: &Candidate| (c.estimate, c.reference);
        self.difference.total_cmp(&other.difference).then(indices(self).cmp(&indices(other)))
    }
}

impl PartialOrd for Candidate {
    fn partial_cmp(&self, other: &Candidate) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl PartialEq for Candidate {
    fn eq(&self, other: &Candidate) -> bool {
        self.cmp(other) == Ordering::Equal
    }
}

impl Eq for Candidate {}

/// The moments in the order of time. The closest pair of all lies in neighbouring moments: one
/// between them would be closer still.
struct TimeLine {
    moments: Vec<Moment>,
    candidates: BinaryHeap<Reverse<Candidate>>,
    max_difference: f64,
}

impl TimeLine {
    /// Equal times are paired at once; no pair is closer.
    fn new(
        estimate: &[f64],
        reference: &[f64],
        max_difference: f64,
        pairs: &mut Vec<(usize, usize)>,
    ) -> TimeLine {
        let stamps = |times: &[f64], of_estimate: bool| {
            let finite = times.iter().copied().enumerate().filter(|(_, time)| time.is_finite());
            // Zero without its sign: both zeros are one moment.
            finite.map(|(i, time)| (time + 0.0, of_estimate, i)).collect::<Vec<_>>()
        };
        let mut stamps = [stamps(estimate, true), stamps(reference, false)].concat();
        stamps.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.2.cmp(&b.2)));
        let mut line =
            TimeLine { moments: Vec::new(), candidates: BinaryHeap::new(), max_difference };
        for same in stamps.chunk_by(|a, b| a.0 == b.0) {
            let of = |wanted: bool| {
                let stamps = same.iter().filter(move |(_, of_estimate, _)| *of_estimate == wanted);
                stamps.map(|&(_, _, i)| i).collect::<VecDeque<usize>>()
            };
            let mut left = [of(true), of(false)];
            let equal = if max_difference >= 0.0 { left[0].len().min(left[1].len()) } else { 0 };
            let [ours, theirs] = &mut left;
            pairs.extend(ours.drain(..equal).zip(theirs.drain(..equal)));
            for (left, of_estimate) in left.into_iter().zip([true, false]) {
                if !left.is_empty() {
                    let (before, after) = (line.moments.len().checked_sub(1), None);
                    line.moments.push(Moment { time: same[0].0, of_estimate, left, before, after });
                }
            }
        }
        for later in 1..line.moments.len() {
            line.moments[later - 1].after = Some(later);
            line.offer(Some(later - 1), Some(later));
        }
        line
    }

    /// Makes neighbouring moments a candidate, where they are one of each list and close enough.
    fn offer(&mut self, earlier: Option<usize>, later: Option<usize>) {
        let (Some(earlier), Some(later)) = (earlier, later) else { return };
        let (a, b) = (&self.moments[earlier], &self.moments[later]);
        let (ours, theirs) = match (a.of_estimate, b.of_estimate) {
            (true, false) => (a, b),
            (false, true) => (b, a),
            _ => return,
        };
        let reach = self.max_difference;
        let near = theirs.time >= ours.time - reach && theirs.time <= ours.time + reach;
        if let (true, Some(&estimate), Some(&reference)) =
            (near, ours.left.front(), theirs.left.front())
        {
            self.candidates.push(Reverse(Candidate {
                difference: (theirs.time - ours.time).abs(),
                estimate,
                reference,
                moments: (earlier, later),
            }));
        }
    }

    /// Pairs a candidate, unless one of its two was paired before.
    fn serve(&mut self, next: &Candidate, pairs: &mut Vec<(usize, usize)>) {
        let (earlier, later) = next.moments;
        let (ours, theirs) = match self.moments[earlier].of_estimate {
            true => (earlier, later),
            false => (later, earlier),
        };
        let first = |moment: usize| self.moments[moment].left.front().copied();
        if (first(ours), first(theirs)) != (Some(next.estimate), Some(next.reference)) {
            return;
        }
        pairs.push((next.estimate, next.reference));
        for moment in [earlier, later] {
            self.moments[moment].left.pop_front();
            if self.moments[moment].left.is_empty() {
                let Moment { before, after, .. } = self.moments[moment];
                if let Some(before) = before {
                    self.moments[before].after = after;
                }
                if let Some(after) = after {
                    self.moments[after].before = before;
                }
            }
        }
        // Who is next at these places now.
        let is_left = |moment: usize| !self.moments[moment].left.is_empty();
        match (is_left(earlier), is_left(later)) {
            (true, true) => {
                self.offer(self.moments[earlier].before, Some(earlier));
                self.offer(Some(earlier), Some(later));
                self.offer(Some(later), self.moments[later].after);
            }
            (true, false) => {
                self.offer(self.moments[earlier].before, Some(earlier));
                self.offer(Some(earlier), self.moments[earlier].after);
            }
            (false, true) => {
                self.offer(self.moments[later].before, Some(later));
                self.offer(Some(later), self.moments[later].after);
            }
            (false, false) => self.offer(self.moments[earlier].before, self.moments[later].after),
        }
    }
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

    #[test]
    fn time_stamps_pair_with_the_nearest_once() {
        let pairs = match_by_time(&[0.0, 1.0, 1.02, 2.0, f64::NAN], &[2.01, 1.015, 0.2, 9.0], 0.05);
        assert_eq!(pairs, vec![(2, 1), (3, 0)]);
        assert!(match_by_time(&[], &[1.0], 1.0).is_empty());
    }

    /// The definition: every pair near enough, closest first. Takes quadratic memory.
    fn match_by_definition(ours: &[f64], theirs: &[f64], reach: f64) -> Vec<(usize, usize)> {
        let near = |a: f64, b: f64| b >= a - reach && b <= a + reach;
        let mut all = Vec::new();
        for (i, &a) in ours.iter().enumerate() {
            let close = theirs.iter().enumerate().filter(|&(_, &b)| near(a, b));
            all.extend(close.map(|(j, &b)| ((b - a).abs(), i, j)));
        }
        all.sort_by(|a, b| a.0.total_cmp(&b.0).then((a.1, a.2).cmp(&(b.1, b.2))));
        let (mut taken, mut pairs) = ((Vec::new(), Vec::new()), Vec::new());
        for (_, i, j) in all {
            if !taken.0.contains(&i) && !taken.1.contains(&j) {
                taken.0.push(i);
                taken.1.push(j);
                pairs.push((i, j));
            }
        }
        pairs.sort_unstable();
        pairs
    }

    #[test]
    fn time_stamps_pair_as_the_definition_says() {
        use rand::{RngExt, SeedableRng};
        let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(5);
        for round in 0..3000 {
            // Quarters: equal times and equal differences, both exact. Else hardly any.
            let coarse = round % 2 == 0;
            let mut list = || -> Vec<f64> {
                let len = random.random_range(0..24);
                let mut time = || match random.random_range(0.0..6.0) {
                    time if coarse => f64::floor(4.0 * time) / 4.0,
                    time => time,
                };
                (0..len).map(|_| time()).collect()
            };
            let (ours, theirs) = (list(), list());
            for reach in [-1.0, 0.0, 0.25, 0.6, f64::INFINITY, f64::NAN] {
                let found = match_by_time(&ours, &theirs, reach);
                let wanted = match_by_definition(&ours, &theirs, reach);
                assert_eq!(found, wanted, "{ours:?}, {theirs:?}, {reach}");
            }
        }
        assert_eq!(match_by_time(&[0.0, -0.0], &[-0.0, 0.0], 0.0), [(0, 0), (1, 1)]);
    }

    #[test]
    fn many_equal_time_stamps_take_linear_memory() {
        let count = 300_000;
        let whole: Vec<(usize, usize)> = (0..count).map(|i| (i, i)).collect();
        assert_eq!(match_by_time(&vec![7.0; count], &vec![7.0; count], 0.02), whole);
        assert_eq!(match_by_time(&vec![7.0; count], &vec![7.01; count], 0.02), whole);
    }
}
