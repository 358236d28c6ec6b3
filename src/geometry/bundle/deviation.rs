//! Uncertainty of adjusted poses and of the focal length.

use std::collections::BTreeMap;

use super::normal::{Layout, NormalEquations};
use super::{FocalMode, Options, Problem, check, residual, scale_is_anchored};
use crate::Result;

/// Standard deviations of a pose, each the square root of the covariance's trace: the root mean square
/// length of the error.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PoseDeviation {
    /// Standard deviation of the rotation, radians.
    pub rotation: f64,
    /// Standard deviation of the camera's centre, in world units.
    pub position: f64,
}

/// Maximum ratio of a determined pose's uncertainty to the one with all other unknowns given.
const DETERMINED: f64 = 1e4;

/// The standard deviations of an adjusted problem's poses, with depths and other poses unknown, and the
/// focal length too unless it is [`FocalMode::Fixed`]: from the diagonal of the inverse of the normal
/// equations, reduced to the cameras, times the robust variance of the residuals.
///
/// Gauge: fixed frames have 0, as has the first one where none is marked fixed. Where nothing anchors the
/// scale, the mean relative change of the middle half of the inverse depths is fixed at 0, as [`adjust`]
/// fixes their median. `None` is a pose that the observations do not determine. Errors of observations are
/// assumed to be independent; if they are not, the actual uncertainty is larger.
///
/// The gauge couples all frames: time grows with the cube of their number, memory with its square.
///
/// [`adjust`]: super::adjust
///
/// # Errors
/// Those of [`adjust`] for an invalid problem.
pub fn pose_deviations(problem: &Problem, options: &Options) -> Result<Vec<Option<PoseDeviation>>> {
    check(problem, options)?;
    let scale = residual::robust_scale(problem, options);
    let layout = Layout::new(problem, options, options.focal != FocalMode::Fixed);
    let equations = NormalEquations::build(problem, options, &layout, scale);
    let gauge = match options.depths && !scale_is_anchored(problem) {
        true => middle_half(problem),
        false => vec![0.0; problem.points.len()],
    };
    let variances = equations.variances(&layout, &gauge, 1.0 / DETERMINED.powi(2));
    let of_frame = |frame: usize| {
        let Some(columns) = layout.columns(frame) else {
            return Some(PoseDeviation { rotation: 0.0, position: 0.0 });
        };
        let variances = &variances.as_ref()?[columns];
        let deviation = |of: &[Option<f64>]| {
            let sum = of.iter().try_fold(0.0, |sum, variance| Some(sum + (*variance)?));
            sum.map(|trace| scale * trace.sqrt())
        };
        // The translation part of a left twist moves the centre by the same amount, in the camera's axes.
        Some(PoseDeviation {
            position: deviation(&variances[..3])?,
            rotation: deviation(&variances[3..])?,
        })
    };
    Ok((0..problem.poses.len()).map(of_frame).collect())
}

/// Number of regions across the image's longer side, within which the errors of observations are taken to be
/// one error in the worst case.
const REGIONS: f64 = 16.0;

/// Relative standard deviation of the focal length of an adjusted problem whose errors are independent
/// between image regions and arbitrary within them, with all other unknowns free: flow errs alike for all
/// points of a surface and over many frames, so that more points do not tell more. It is at least the deviation
/// for independent errors, and infinite where the focal length is not determined.
///
/// The variance is the sum over regions of the square of the summed influence of the region's points (Liang
/// and Zeger 1986, with the Gauss–Newton matrix). A point belongs to the region of its reference pixel.
///
/// # Errors
/// Those of [`adjust`](super::adjust) for an invalid problem.
pub fn focal_deviation_of_regions(problem: &Problem, options: &Options) -> Result<f64> {
    check(problem, options)?;
    let scale = residual::robust_scale(problem, options);
    let layout = Layout::new(problem, options, true);
    let equations = NormalEquations::build(problem, options, &layout, scale);
    let found = layout.focal().and_then(|column| {
        let by_all = equations.covariance_column(&layout, column)?;
        let variance = by_all[column];
        let influences = equations.influences(problem, options, &layout, scale, &by_all);
        (variance > 0.0).then(|| (scale * variance.sqrt(), influences))
    });
    let Some((of_independent, influences)) = found else { return Ok(f64::INFINITY) };
    let side = f64::from(problem.intrinsics.width.max(problem.intrinsics.height)) / REGIONS;
    let mut regions: BTreeMap<[i64; 2], f64> = BTreeMap::new();
    for (point, influence) in problem.points.iter().zip(influences) {
        let at = (point.pixel / side).floor();
        *regions.entry([at.x as i64, at.y as i64]).or_default() += influence;
    }
    let deviation = regions.values().map(|sum| sum * sum).sum::<f64>().sqrt();
    Ok(if deviation.is_finite() { deviation.max(of_independent) } else { f64::INFINITY })
}

/// Per point, the weight of its inverse depth in the mean relative change of the middle half.
fn middle_half(problem: &Problem) -> Vec<f64> {
    let mut all: Vec<f64> =
        problem.points.iter().map(|p| p.inverse_depth).filter(|d| *d > 0.0).collect();
    all.sort_by(f64::total_cmp);
    let at = |share: usize| all.get(share * all.len().saturating_sub(1) / 4).copied();
    let (Some(low), Some(high)) = (at(1), at(3)) else { return vec![0.0; problem.points.len()] };
    let inside = |d: f64| if (low..=high).contains(&d) { 1.0 / d } else { 0.0 };
    problem.points.iter().map(|p| inside(p.inverse_depth)).collect()
}

#[cfg(test)]
mod tests {
    use glam::{DQuat, DVec2, DVec3};
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::super::{DepthPrior, Kernel, Observation, Point, adjust, project};
    use super::*;
    use crate::geometry::se3::{angle_between, exp_so3};
    use crate::types::{Intrinsics, Pose};

    const FRAMES: usize = 6;

    /// A camera that moves around a point cloud, all seen in frame 0 and then in all others, with an
    /// unknown focal length.
    fn exact() -> Problem {
        let mut random = ChaCha8Rng::seed_from_u64(5);
        let intrinsics = Intrinsics::centred(300.0, 320, 240);
        let pose = |i: usize| {
            let t = i as f64;
            let centre = DVec3::new(0.15 * t, 0.05 * t * t / 5.0, 0.03 * t);
            Pose::new(exp_so3(DVec3::new(0.01 * t, -0.03 * t, 0.005)), centre).inverse()
        };
        let poses: Vec<Pose> = (0..FRAMES).map(pose).collect();
        let mut points = Vec::new();
        let mut observations = Vec::new();
        for point in 0..120 {
            let mut number = || random.random::<f64>();
            let pixel = DVec2::new(20.0 + 280.0 * number(), 20.0 + 200.0 * number());
            let inverse_depth = 1.0 / (2.0 + 3.0 * number());
            points.push(Point { frame: 0, pixel, inverse_depth, prior: None });
            for frame in 1..FRAMES {
                let relative = poses[frame] * poses[0].inverse();
                let pixel = project(&intrinsics, &relative, pixel, inverse_depth).unwrap().0;
                observations.push(Observation { point, frame, pixel, weight: 1.0, deviation: 1.0 });
            }
        }
        Problem { intrinsics, k1: 0.0, poses, fixed: vec![false; FRAMES], points, observations }
    }

    /// The problem with one pixel of noise, which varies with the seed.
    fn noisy(exact: &Problem, seed: u64) -> Problem {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let mut normal = || {
            let (u, v): (f64, f64) = (random.random(), random.random());
            (-2.0 * (1.0 - u).ln()).sqrt() * (std::f64::consts::TAU * v).cos()
        };
        let mut problem = exact.clone();
        for o in &mut problem.observations {
            o.pixel += DVec2::new(normal(), normal());
        }
        problem
    }

    #[test]
    fn deviations_are_the_spread_of_solutions() {
        let exact = exact();
        for (kernel, focal) in
            [(Kernel::None, FocalMode::Free), (Kernel::GemanMcClure, FocalMode::Fixed)]
        {
            let options = Options { kernel, focal, ..Default::default() };
            let draws = 60;
            let mut spread = [(0.0, 0.0); FRAMES];
            let mut told = [(0.0, 0.0); FRAMES];
            for seed in 0..draws {
                let mut problem = noisy(&exact, seed);
                adjust(&mut problem, &options).unwrap();
                let found = pose_deviations(&problem, &options).unwrap();
                for frame in 0..FRAMES {
                    let [at, truth] = [&problem, &exact].map(|p| p.poses[frame]);
                    let off = at.inverse().translation - truth.inverse().translation;
                    let turned = angle_between(at.rotation, truth.rotation);
                    spread[frame].0 += off.length_squared() / draws as f64;
                    spread[frame].1 += turned * turned / draws as f64;
                    let deviation = found[frame].unwrap();
                    told[frame].0 += deviation.position / draws as f64;
                    told[frame].1 += deviation.rotation / draws as f64;
                }
            }
            assert_eq!(told[0], (0.0, 0.0), "the first camera is held");
            for frame in 1..FRAMES {
                for (told, spread) in
                    [(told[frame].0, spread[frame].0), (told[frame].1, spread[frame].1)]
                {
                    let ratio = told / spread.sqrt();
                    eprintln!("{kernel:?}, frame {frame}: {told:.2e}, {ratio:.2} of the spread");
                    assert!((1.0 / 1.5..1.5).contains(&ratio), "{kernel:?} {frame}: {ratio}");
                }
            }
        }
    }

    /// Noise that is common to all points of a region in a frame.
    fn alike(exact: &Problem, seed: u64) -> Problem {
        let shared = noisy(exact, seed);
        let mut problem = exact.clone();
        let mut errors: BTreeMap<[i64; 3], DVec2> = BTreeMap::new();
        let numbers = exact.observations.iter().zip(&shared.observations);
        for (o, (before, after)) in problem.observations.iter_mut().zip(numbers) {
            let at = (exact.points[o.point].pixel / 20.0).floor();
            let region = [at.x as i64, at.y as i64, o.frame as i64];
            o.pixel += *errors.entry(region).or_insert(after.pixel - before.pixel);
        }
        problem
    }

    #[test]
    fn errors_that_regions_share_leave_the_focal_length_uncertain() {
        // Four points in a region.
        let mut exact = exact();
        let many = exact.points.len();
        for copy in 1..4 {
            for point in 0..many {
                let mut own = exact.points[point];
                let in_region = (own.pixel / 20.0).floor() * 20.0;
                own.pixel = in_region + DVec2::new(3.0, 5.0) * f64::from(copy);
                exact.points.push(own);
                for frame in 1..FRAMES {
                    let relative = exact.poses[frame] * exact.poses[0].inverse();
                    let (k, d) = (&exact.intrinsics, own.inverse_depth);
                    let pixel = project(k, &relative, own.pixel, d).unwrap().0;
                    let point = exact.points.len() - 1;
                    let (weight, deviation) = (1.0, 1.0);
                    exact.observations.push(Observation { point, frame, pixel, weight, deviation });
                }
            }
        }
        let options =
            Options { focal: FocalMode::Free, kernel: Kernel::None, ..Default::default() };
        // Mean stated deviations of both kinds, over the spread of the solutions.
        let ratios = |draw: &dyn Fn(u64) -> Problem| {
            let draws = 40;
            let (mut squared, mut independent, mut regions) = (0.0, 0.0, 0.0);
            for seed in 0..draws {
                let mut problem = draw(seed);
                let report = adjust(&mut problem, &options).unwrap();
                let off = (problem.intrinsics.fx / exact.intrinsics.fx).ln();
                squared += off * off / draws as f64;
                independent += report.focal_std / draws as f64;
                regions += focal_deviation_of_regions(&problem, &options).unwrap() / draws as f64;
            }
            [independent, regions].map(|stated| stated / squared.sqrt())
        };
        let [independent, regions] = ratios(&|seed| noisy(&exact, seed));
        eprintln!("independent errors: stated {independent:.2} and {regions:.2} of the spread");
        assert!((1.0 / 1.5..1.5).contains(&independent) && (1.0 / 1.5..1.5).contains(&regions));
        let [independent, regions] = ratios(&|seed| alike(&exact, seed));
        eprintln!("shared errors: stated {independent:.2} and {regions:.2} of the spread");
        assert!(independent < 1.0 / 1.5, "the test needs errors that matter: {independent}");
        assert!((1.0 / 1.5..1.5).contains(&regions), "{regions}");
        // Without parallax and rotation nothing determines it.
        let mut still = exact.clone();
        still.poses = vec![Pose::IDENTITY; FRAMES];
        assert!(focal_deviation_of_regions(&still, &options).unwrap() > 1.0);
    }

    #[test]
    fn what_is_anchored_is_known_better() {
        let options = Options::default();
        let free = noisy(&exact(), 1);
        let of = |problem: &Problem| pose_deviations(problem, &options).unwrap()[5].unwrap();
        let mut anchored = free.clone();
        for point in &mut anchored.points {
            let inverse_depth = point.inverse_depth;
            point.prior = Some(DepthPrior { inverse_depth, weight: 1e8 });
        }
        assert!(of(&anchored).position < of(&free).position);
        // Fixed frames have no deviation.
        let held = Problem { fixed: vec![true; FRAMES], ..free };
        assert_eq!(of(&held), PoseDeviation { rotation: 0.0, position: 0.0 });
    }

    #[test]
    fn what_nothing_determines_has_none() {
        let options = Options::default();
        // A frame without observations, and frames that only rotate, whose position is undetermined.
        let mut problem = exact();
        problem.observations.retain(|o| o.frame != 3);
        let found = pose_deviations(&problem, &options).unwrap();
        assert!(found[3].is_none() && found[2].is_some() && found[4].is_some(), "{found:?}");
        let mut problem = exact();
        for (frame, pose) in problem.poses.iter_mut().enumerate() {
            *pose = Pose::new(DQuat::from_rotation_y(0.02 * frame as f64), DVec3::ZERO);
        }
        problem.points.iter_mut().for_each(|point| point.inverse_depth = 0.0);
        let found = pose_deviations(&problem, &options).unwrap();
        assert!(found[1..].iter().all(Option::is_none), "{found:?}");
    }
}
