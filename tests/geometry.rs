//! Geometry: the check cases, real data, and whole synthetic sequences.

mod common;

use common::shared_data as data;
use glam::{DMat3, DQuat, DVec2, DVec3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use splat4d::eval::{Align, compare_trajectories, match_by_time};
use splat4d::geometry::bundle::{
    self, DepthPrior, FocalMode, Kernel, Observation, Options, Point, Problem, adjust,
};
use splat4d::geometry::pnp::{PnpOptions, pnp_ransac};
use splat4d::geometry::se3::{Twist, angle_between, exp_so3, retract};
use splat4d::geometry::two_view::{TwoViewOptions, two_view};
use splat4d::types::{Intrinsics, Pose};

common::cases! { "geometry":
    pnp_coplanar, pnp_few_points, pnp_outliers, bundle_pure_rotation, bundle_no_parallax,
    bundle_points_at_infinity, alignment_of_a_line,
}

fn numbers(text: &str) -> Vec<f64> {
    text.split_whitespace().map(|w| w.parse().unwrap()).collect()
}

fn kitti(text: &str) -> Vec<Pose> {
    text.lines()
        .map(|line| {
            let v = numbers(line);
            let row = |r: usize| DVec3::new(v[4 * r], v[4 * r + 1], v[4 * r + 2]);
            let rotation = DMat3::from_cols(row(0), row(1), row(2)).transpose();
            Pose::new(DQuat::from_mat3(&rotation), DVec3::new(v[3], v[7], v[11]))
        })
        .collect()
}

fn tum(text: &str) -> (Vec<f64>, Vec<Pose>) {
    text.lines()
        .filter(|line| !line.trim_start().starts_with('#') && !line.trim().is_empty())
        .map(|line| {
            let v = numbers(line);
            let rotation = DQuat::from_xyzw(v[4], v[5], v[6], v[7]);
            (v[0], Pose::new(rotation, DVec3::new(v[1], v[2], v[3])))
        })
        .unzip()
}

/// The errors that evo publishes for ORB-SLAM on KITTI 00.
#[test]
fn kitti_00_gives_the_published_errors() {
    let (Some(gt), Some(orb)) =
        (data("evo_traj/KITTI_00_gt.txt"), data("evo_traj/KITTI_00_ORB.txt"))
    else {
        return;
    };
    let gt = kitti(&std::fs::read_to_string(gt).unwrap());
    let orb = kitti(&std::fs::read_to_string(orb).unwrap());
    let rigid = compare_trajectories(&orb, &gt, Align::Se3).unwrap();
    assert!((rigid.ate.rmse - 1.3034497145650266).abs() < 1e-9, "{}", rigid.ate.rmse);
    let similar = compare_trajectories(&orb, &gt, Align::Sim3).unwrap();
    assert!((similar.ate.rmse - 0.9377090736).abs() < 1e-9, "{}", similar.ate.rmse);
    assert!(similar.rpe_rot_deg.rmse < 0.2 && similar.path_length > 3000.0);
}

#[test]
fn a_monocular_tum_trajectory_is_matched_by_time_and_scaled() {
    let (Some(gt), Some(mono)) = (
        data("evo_traj/freiburg1_xyz-groundtruth.txt"),
        data("evo_traj/freiburg1_xyz-ORB_kf_mono.txt"),
    ) else {
        return;
    };
    let (gt_times, gt) = tum(&std::fs::read_to_string(gt).unwrap());
    let (times, mono) = tum(&std::fs::read_to_string(mono).unwrap());
    let pairs = match_by_time(&times, &gt_times, 0.01);
    assert!(pairs.len() + 2 >= mono.len(), "{} of {}", pairs.len(), mono.len());
    let estimate: Vec<Pose> = pairs.iter().map(|p| mono[p.0]).collect();
    let reference: Vec<Pose> = pairs.iter().map(|p| gt[p.1]).collect();
    let similar = compare_trajectories(&estimate, &reference, Align::Sim3).unwrap();
    let rigid = compare_trajectories(&estimate, &reference, Align::Se3).unwrap();
    eprintln!("fr1_xyz ORB mono: Sim(3) {} SE(3) {}", similar.ate.rmse, rigid.ate.rmse);
    assert!(similar.ate.rmse < 0.02 && rigid.ate.rmse > similar.ate.rmse);
}

fn normal(rng: &mut ChaCha8Rng) -> f64 {
    let (u, v): (f64, f64) = (rng.random_range(1e-12..1.0), rng.random());
    (-2.0 * u.ln()).sqrt() * (std::f64::consts::TAU * v).cos()
}

/// Parameters of a synthetic sequence.
#[derive(Clone, Copy)]
struct Make {
    frames: usize,
    points: usize,
    /// Distance that the camera travels per frame.
    step: f64,
    /// Rotation of the camera, radians per frame.
    turn: f64,
    /// Number of further frames that observe a point.
    reach: usize,
    noise: f64,
    outliers: f64,
    seed: u64,
}

const MAKE: Make = Make {
    frames: 10,
    points: 300,
    step: 0.15,
    turn: 0.01,
    reach: 4,
    noise: 0.3,
    outliers: 0.0,
    seed: 1,
};

/// The true problem (noise on the observed pixels only).
fn sequence(make: Make) -> Problem {
    let mut rng = ChaCha8Rng::seed_from_u64(make.seed);
    let intrinsics = Intrinsics::centred(420.0, 480, 270);
    let poses: Vec<Pose> = (0..make.frames)
        .map(|i| {
            let t = i as f64;
            let centre =
                DVec3::new(make.step * t, 0.4 * make.step * (0.7 * t).sin(), 0.3 * make.step * t);
            let turn = exp_so3(DVec3::new(make.turn * (0.5 * t).sin(), make.turn * t, 0.0));
            Pose::new(turn, centre).inverse()
        })
        .collect();
    let (mut points, mut observations) = (Vec::new(), Vec::new());
    while points.len() < make.points {
        let frame = (points.len() * make.frames) / make.points.max(1);
        let pixel = DVec2::new(rng.random_range(0.0..480.0), rng.random_range(0.0..270.0));
        let depth: f64 = rng.random_range(2.0..10.0);
        let world = poses[frame].inverse().apply(intrinsics.ray(pixel) * depth);
        let index = points.len();
        points.push(Point { frame, pixel, inverse_depth: 1.0 / depth, prior: None });
        // Observations in frames before and after, so that every frame is connected to its neighbours.
        let first = frame.saturating_sub(make.reach / 2);
        for other in first..(first + make.reach + 1).min(make.frames) {
            let x = poses[other].apply(world);
            if other == frame || x.z < 0.1 {
                continue;
            }
            let mut seen = intrinsics.project(x);
            if rng.random::<f64>() < make.outliers {
                seen += DVec2::new(rng.random_range(-40.0..40.0), rng.random_range(-40.0..40.0));
            }
            seen += DVec2::new(normal(&mut rng), normal(&mut rng)) * make.noise;
            observations.push(Observation {
                point: index,
                frame: other,
                pixel: seen,
                weight: 1.0,
                deviation: 1.0,
            });
        }
    }
    let fixed = (0..make.frames).map(|i| i == 0).collect();
    Problem { intrinsics, k1: 0.0, poses, fixed, points, observations }
}

fn disturbed(truth: &Problem, pose: f64, depth: f64, seed: u64) -> Problem {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut problem = truth.clone();
    for p in problem.poses.iter_mut().skip(1) {
        let xi = Twist::from_fn(|_, _| pose * normal(&mut rng));
        *p = retract(p, &xi);
    }
    for p in &mut problem.points {
        p.inverse_depth *= (depth * normal(&mut rng)).exp();
    }
    problem
}

fn world_from_view(problem: &Problem) -> Vec<Pose> {
    problem.poses.iter().map(|p| p.inverse()).collect()
}

fn relative_ate(problem: &Problem, truth: &Problem) -> f64 {
    compare_trajectories(&world_from_view(problem), &world_from_view(truth), Align::Sim3)
        .unwrap()
        .ate_relative
}

fn all_finite(problem: &Problem) -> bool {
    problem.poses.iter().all(|p| p.translation.is_finite() && p.rotation.is_finite())
        && problem.points.iter().all(|p| p.inverse_depth.is_finite() && p.inverse_depth >= 0.0)
        && problem.intrinsics.fx.is_finite()
}

#[test]
fn bundle_recovers_exact_poses_and_depths_without_noise() {
    let truth = sequence(Make { noise: 0.0, ..MAKE });
    let mut problem = disturbed(&truth, 0.02, 0.3, 2);
    let options = Options { steps: 50, ..Default::default() };
    let report = adjust(&mut problem, &options).unwrap();
    assert!(report.final_squared < 1e-9 * report.initial_squared, "{report:?}");
    assert!(relative_ate(&problem, &truth) < 1e-6);
    for (found, exact) in problem.points.iter().zip(&truth.points) {
        let ratio = found.inverse_depth
            / exact.inverse_depth
            / (problem.points[0].inverse_depth / truth.points[0].inverse_depth);
        assert!((ratio - 1.0).abs() < 1e-4, "one scale for all depths: {ratio}");
    }
    assert!(report.depth_std < 0.5);
}

#[test]
fn bundle_withstands_outliers_that_least_squares_does_not() {
    let truth = sequence(Make { outliers: 0.25, points: 600, ..MAKE });
    let start = disturbed(&truth, 0.01, 0.2, 3);
    let run = |kernel| {
        let mut problem = start.clone();
        let report = adjust(&mut problem, &Options { kernel, ..Default::default() }).unwrap();
        (relative_ate(&problem, &truth), report)
    };
    let (geman, report) = run(Kernel::GemanMcClure);
    let (cauchy, _) = run(Kernel::Cauchy);
    let (plain, _) = run(Kernel::None);
    eprintln!("relative ATE: Geman-McClure {geman:.5} Cauchy {cauchy:.5} none {plain:.5}");
    assert!(geman < 0.004 && cauchy < 0.008, "{geman} {cauchy}");
    assert!(plain > 3.0 * geman);
    assert!((0.65..0.85).contains(&report.inlier_ratio), "{}", report.inlier_ratio);
    assert!(report.inlier_rmse < 0.8, "{}", report.inlier_rmse);
}

#[test]
fn weights_of_zero_silence_what_moves() {
    // The second half of each frame's points move; their weights are low.
    let mut truth = sequence(MAKE);
    for o in &mut truth.observations {
        if o.point % 2 == 1 {
            o.pixel += DVec2::new(6.0, 3.0) * (o.frame as f64 - truth.points[o.point].frame as f64);
        }
    }
    let mut masked = truth.clone();
    for o in &mut masked.observations {
        o.weight = if o.point % 2 == 1 { 0.0 } else { 1.0 };
    }
    let mut problem = disturbed(&masked, 0.01, 0.2, 4);
    adjust(&mut problem, &Options::default()).unwrap();
    let error = relative_ate(&problem, &truth);
    assert!(error < 0.004, "{error}");
    let untouched = disturbed(&masked, 0.01, 0.2, 4);
    assert!(problem.points[1].inverse_depth > 0.0 && all_finite(&problem));
    let ratio = |k: usize| problem.points[k].inverse_depth / untouched.points[k].inverse_depth;
    // A point without observations is changed only by the common rescaling.
    assert!((ratio(1) / ratio(3) - 1.0).abs() < 1e-9);
}

#[test]
fn focal_length_is_found_where_it_can_be_and_kept_where_not() {
    // A camera that rotates and moves: the focal length is observable.
    let truth = sequence(Make { turn: 0.06, points: 800, reach: 6, ..MAKE });
    let mut problem = disturbed(&truth, 0.005, 0.1, 5);
    problem.intrinsics = Intrinsics::centred(480.0, 480, 270);
    let gated = Options { focal: FocalMode::Gated(0.03), steps: 40, ..Default::default() };
    let report = adjust(&mut problem, &gated).unwrap();
    eprintln!("focal {} ± {}", problem.intrinsics.fx, report.focal_std);
    assert!(report.focal_released && report.focal_std < 0.02, "{report:?}");
    assert!((problem.intrinsics.fx / 420.0 - 1.0).abs() < 0.02, "{}", problem.intrinsics.fx);
    assert!((problem.intrinsics.fx - problem.intrinsics.fy).abs() < 1e-9);

    // A fronto-parallel wall seen from a sliding camera: focal and depth are one unknown.
    let mut wall = sequence(Make { turn: 0.0, ..MAKE });
    for p in &mut wall.points {
        p.inverse_depth = 0.25;
    }
    for (i, p) in wall.poses.iter_mut().enumerate() {
        *p = Pose::new(DQuat::IDENTITY, DVec3::new(-0.1 * i as f64, 0.0, 0.0));
    }
    for o in &mut wall.observations {
        let point = wall.points[o.point];
        let x = wall.poses[o.frame]
            .apply(wall.poses[point.frame].inverse().apply(wall.intrinsics.ray(point.pixel) * 4.0));
        o.pixel = wall.intrinsics.project(x) + (o.pixel - o.pixel.floor() - 0.5) * 0.5;
    }
    let mut problem = wall.clone();
    problem.intrinsics = Intrinsics::centred(480.0, 480, 270);
    let report = adjust(&mut problem, &gated).unwrap();
    assert!(!report.focal_released, "{} {}", report.focal_std, problem.intrinsics.fx);
    assert_eq!(problem.intrinsics.fx, 480.0);
    // A prior supplies what the data do not determine.
    let mut problem = wall.clone();
    problem.intrinsics = Intrinsics::centred(480.0, 480, 270);
    let prior =
        Options { focal: FocalMode::Free, focal_prior: Some((420.0, 0.01)), ..Default::default() };
    adjust(&mut problem, &prior).unwrap();
    assert!((problem.intrinsics.fx / 420.0 - 1.0).abs() < 0.05, "{}", problem.intrinsics.fx);
}

#[test]
fn hard_cases_end_finite_and_say_so() {
    // Pure rotation: no parallax at all. Rotations are still right.
    let still = Make { step: 0.0, turn: 0.03, ..MAKE };
    let truth = sequence(still);
    let mut problem = disturbed(&truth, 0.005, 0.5, 6);
    let report = adjust(&mut problem, &Options::default()).unwrap();
    assert!(all_finite(&problem) && report.final_cost <= report.initial_cost);
    for (a, b) in problem.poses.iter().zip(&truth.poses) {
        assert!(angle_between(a.rotation, b.rotation).to_degrees() < 0.2);
    }
    assert!(report.depth_std > 0.4, "no parallax must show: {}", report.depth_std);

    // All points at infinity: inverse depth 0 stays legal, rotations are found.
    let mut far = sequence(Make { turn: 0.03, ..MAKE });
    for o in &mut far.observations {
        let p = far.points[o.point];
        let turn = far.poses[o.frame].rotation * far.poses[p.frame].rotation.conjugate();
        o.pixel = far.intrinsics.project(turn * far.intrinsics.ray(p.pixel));
    }
    far.points.iter_mut().for_each(|p| p.inverse_depth = 0.0);
    let mut problem = disturbed(&far, 0.005, 0.0, 7);
    adjust(&mut problem, &Options::default()).unwrap();
    assert!(all_finite(&problem));
    for (a, b) in problem.poses.iter().zip(&far.poses) {
        assert!(angle_between(a.rotation, b.rotation).to_degrees() < 0.05);
    }

    // One point, one observation: underdetermined, finite.
    let mut problem = sequence(Make { points: 1, frames: 2, ..MAKE });
    problem.observations.truncate(1);
    problem.poses[1] = retract(&problem.poses[1], &Twist::new(0.1, 0.0, 0.0, 0.0, 0.1, 0.0));
    let report = adjust(&mut problem, &Options::default()).unwrap();
    assert!(report.underdetermined && all_finite(&problem));

    // Everything is fixed: nothing changes, and the report is still valid.
    let truth = sequence(MAKE);
    let mut problem = truth.clone();
    problem.fixed = vec![true; MAKE.frames];
    let report = adjust(&mut problem, &Options { depths: false, ..Default::default() }).unwrap();
    assert_eq!(problem.poses, truth.poses);
    assert_eq!(report.initial_squared, report.final_squared);

    // A start that is far off, with poses rotated by a radian and more and some points behind their
    // cameras, converges to the same result as a near one. Measured: 0.09 % of the path, 99.6 % inliers.
    let truth = sequence(MAKE);
    let mut problem = disturbed(&truth, 1.5, 2.0, 8);
    let before = relative_ate(&problem, &truth);
    let report = adjust(&mut problem, &Options::default()).unwrap();
    assert!(all_finite(&problem) && report.final_cost <= report.initial_cost);
    let after = relative_ate(&problem, &truth);
    assert!(after < 0.004 && after < 0.1 * before, "{after} from {before}");
    assert!(report.inlier_ratio > 0.95, "{}", report.inlier_ratio);

    // A static camera without a prior: there is nothing to solve, and nothing breaks.
    let mut problem = sequence(Make { step: 0.0, turn: 0.0, ..MAKE });
    adjust(&mut problem, &Options { focal: FocalMode::Gated(0.05), ..Default::default() }).unwrap();
    assert!(all_finite(&problem));
}

#[test]
fn bad_problems_are_refused_in_words() {
    let good = sequence(MAKE);
    let refuse = |change: &dyn Fn(&mut Problem), words: &str| {
        let mut problem = good.clone();
        change(&mut problem);
        let message = adjust(&mut problem, &Options::default()).unwrap_err().to_string();
        assert!(message.contains(words), "{message}");
    };
    refuse(&|p| p.fixed.clear(), "one for each pose");
    refuse(&|p| p.points[3].frame = 99, "point 3 refers to frame 99");
    refuse(&|p| p.observations[5].point = 9999, "observation 5");
    refuse(&|p| p.observations[5].pixel.x = f64::NAN, "observation 5");
    refuse(&|p| p.points[2].inverse_depth = -1.0, "point 2");
    refuse(&|p| p.poses[1].translation.x = f64::INFINITY, "frame 1");
    refuse(&|p| p.observations.clear(), "no observation counts");
    refuse(&|p| p.intrinsics.fx = 0.0, "intrinsics");
    refuse(&|p| p.observations.iter_mut().for_each(|o| o.weight = 0.0), "no observation counts");
}

#[test]
fn scale_is_kept_unless_something_anchors_it() {
    let truth = sequence(MAKE);
    let mut problem = disturbed(&truth, 0.01, 0.2, 9);
    let before = bundle::median_inverse_depth(&problem).unwrap();
    adjust(&mut problem, &Options::default()).unwrap();
    let after = bundle::median_inverse_depth(&problem).unwrap();
    assert!((after / before - 1.0).abs() < 1e-9);
    // Depth priors of twice the size pull the world to half of it.
    let mut problem = disturbed(&truth, 0.002, 0.02, 9);
    for (p, t) in problem.points.iter_mut().zip(&truth.points) {
        p.prior = Some(DepthPrior { inverse_depth: 2.0 * t.inverse_depth, weight: 1e4 });
    }
    adjust(&mut problem, &Options { steps: 60, ..Default::default() }).unwrap();
    let found = bundle::median_inverse_depth(&problem).unwrap();
    let exact = bundle::median_inverse_depth(&truth).unwrap();
    assert!((found / exact - 2.0).abs() < 0.02, "{}", found / exact);
    // Rescaling changes no projected pixel.
    let mut scaled = truth.clone();
    bundle::rescale(&mut scaled, 3.7);
    let held = Options { rounds: 1, steps: 0, ..Default::default() };
    let (a, b) = (adjust(&mut truth.clone(), &held).unwrap(), adjust(&mut scaled, &held).unwrap());
    assert!((a.final_squared / b.final_squared - 1.0).abs() < 1e-9);
}

#[test]
fn two_runs_give_the_same_bits_on_any_number_of_threads() {
    let truth = sequence(Make { points: 900, outliers: 0.1, ..MAKE });
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let mut problem = disturbed(&truth, 0.01, 0.2, 10);
            adjust(&mut problem, &Options::default()).unwrap();
            problem
        })
    };
    let (a, b) = (run(1), run(3));
    assert_eq!(a.poses, b.poses);
    assert_eq!(a.points, b.points);
}

/// 100 frames, 10,000 points, five observations each: prints how long it takes.
#[test]
fn a_long_clip_is_adjusted() {
    let truth = sequence(Make {
        frames: 100,
        points: 10_000,
        reach: 6,
        outliers: 0.1,
        turn: 0.004,
        step: 0.05,
        ..MAKE
    });
    let mut problem = disturbed(&truth, 0.002, 0.2, 11);
    let start = std::time::Instant::now();
    let options = Options { focal: FocalMode::Gated(0.05), ..Default::default() };
    let report = adjust(&mut problem, &options).unwrap();
    eprintln!(
        "{} observations, {} steps, {:.1} s: relative ATE {:.5} -> {:.5}, focal {:.1} ± {:.4}",
        problem.observations.len(),
        report.steps,
        start.elapsed().as_secs_f64(),
        relative_ate(&disturbed(&truth, 0.002, 0.2, 11), &truth),
        relative_ate(&problem, &truth),
        problem.intrinsics.fx,
        report.focal_std,
    );
    assert!(report.final_cost < 0.5 * report.initial_cost);
    assert!(relative_ate(&problem, &truth) < 0.01);
}

/// Converts classical bundle data to an anchored problem: each point is anchored at its first
/// observation, with the inverse depth of the given position.
fn anchored(intrinsics: Intrinsics, poses: Vec<Pose>, points: &[DVec3], seen: &[Seen]) -> Problem {
    let mut index = vec![None; points.len()];
    let (mut anchors, mut observations) = (Vec::new(), Vec::new());
    for &(frame, point, pixel) in seen {
        match index[point] {
            None => {
                let depth = poses[frame].apply(points[point]).z;
                index[point] = Some(anchors.len());
                anchors.push(Point { frame, pixel, inverse_depth: 1.0 / depth, prior: None });
            }
            Some(point) => {
                observations.push(Observation { point, frame, pixel, weight: 1.0, deviation: 1.0 })
            }
        }
    }
    let fixed = (0..poses.len()).map(|i| i == 0).collect();
    Problem { intrinsics, k1: 0.0, poses, fixed, points: anchors, observations }
}

/// A file of the Bundle Adjustment in the Large collection: 3 cameras, 7 points, 19 observations.
#[test]
fn bal_dubrovnik_reprojects_by_its_own_model_and_is_improved() {
    let Some(path) = data("ba/gtsam/dubrovnik-3-7-pre.txt") else { return };
    let v = numbers(&std::fs::read_to_string(path).unwrap());
    let (cameras, points, count) = (v[0] as usize, v[1] as usize, v[2] as usize);
    assert_eq!((cameras, points, count), (3, 7, 19));
    let (observed, rest) = v[3..].split_at(4 * count);
    let (camera_values, point_values) = rest.split_at(9 * cameras);
    let points: Vec<DVec3> = point_values.chunks(3).map(DVec3::from_slice).collect();
    // BAL looks down −z with y up; two flips make it OpenCV's.
    let flip = DQuat::from_xyzw(1.0, 0.0, 0.0, 0.0);
    let (mut poses, mut lens) = (Vec::new(), Vec::new());
    for c in camera_values.chunks(9) {
        let bal = Pose::new(exp_so3(DVec3::from_slice(c)), DVec3::from_slice(&c[3..]));
        poses.push(Pose::new(flip, DVec3::ZERO) * bal);
        lens.push((c[6], c[7], c[8]));
    }
    let common = Intrinsics::centred(1500.0, 2000, 2000);
    let (mut seen, mut bal_squared) = (Vec::new(), 0.0);
    for o in observed.chunks(4) {
        let (camera, point) = (o[0] as usize, o[1] as usize);
        let (f, k1, k2) = lens[camera];
        let pixel = DVec2::new(o[2], -o[3]);
        let p = poses[camera].apply(points[point]);
        assert!(p.z > 0.0, "in front of the camera");
        let n = p.truncate() / p.z;
        let r2 = n.length_squared();
        bal_squared += (f * (1.0 + k1 * r2 + k2 * r2 * r2) * n - pixel).length_squared();
        // Pixels are converted to one common pinhole camera; the distortion of 1e-7 is negligible.
        let centre = DVec2::new(common.cx, common.cy);
        seen.push((camera, point, pixel / f * common.fx + centre));
    }
    // GTSAM prints this initial error, half the sum of squares, for the same file.
    assert!((0.5 * bal_squared - 2764.22).abs() < 0.005, "{}", 0.5 * bal_squared);
    let mut problem = anchored(common, poses, &points, &seen);
    let options = Options { kernel: Kernel::None, steps: 60, ..Default::default() };
    let report = adjust(&mut problem, &options).unwrap();
    eprintln!("anchored: {:.4} -> {:.6} px²", report.initial_squared, report.final_squared);
    assert!(report.final_squared < 0.02 * report.initial_squared);
    assert!(report.inlier_rmse < 1.5 && all_finite(&problem));
}

/// Frame, point and pixel.
type Seen = (usize, usize, DVec2);

/// Camera, `view_from_world`, points, and observations.
type Classical = (Intrinsics, Vec<Pose>, Vec<DVec3>, Vec<Seen>);

/// Real tracks and cameras from Blender's motion tracker (Tears of Steel).
fn libmv() -> Option<Classical> {
    let bytes = std::fs::read(data("ba/libmv_ceres/problem_01.bin")?).unwrap();
    assert_eq!(&bytes[..2], b"vP", "little endian, pixels");
    let words: Vec<[u8; 4]> = bytes[2..].chunks(4).map(|c| c.try_into().unwrap()).collect();
    let at = std::cell::Cell::new(0);
    let word = || words[at.replace(at.get() + 1)];
    let int = || i32::from_le_bytes(word());
    let float = || f64::from(f32::from_le_bytes(word()));
    let k: Vec<f64> = (0..8).map(|_| float()).collect();
    assert!(k[3..].iter().all(|d| *d == 0.0), "no distortion");
    let intrinsics =
        Intrinsics { fx: k[0], fy: k[0], cx: k[1], cy: k[2], width: 2048, height: 1080 };
    let mut images = std::collections::BTreeMap::new();
    for _ in 0..int() {
        let image = int();
        let r: Vec<f64> = (0..9).map(|_| float()).collect();
        let t = DVec3::from_array(std::array::from_fn(|_| float()));
        images.insert(image, Pose::new(DQuat::from_mat3(&DMat3::from_cols_slice(&r)), t));
    }
    let mut tracks = std::collections::BTreeMap::new();
    for _ in 0..int() {
        let track = int();
        tracks.insert(track, DVec3::from_array(std::array::from_fn(|_| float())));
    }
    // Image and track numbers may have gaps; indices in the sorted list do not.
    let place = |keys: &[i32], key: i32| keys.binary_search(&key).unwrap();
    let (image_keys, track_keys): (Vec<i32>, Vec<i32>) =
        (images.keys().copied().collect(), tracks.keys().copied().collect());
    let seen = (0..int())
        .map(|_| {
            let (image, track) = (int(), int());
            let pixel = DVec2::new(float(), float());
            (place(&image_keys, image), place(&track_keys, track), pixel)
        })
        .collect();
    Some((intrinsics, images.into_values().collect(), tracks.into_values().collect(), seen))
}

#[test]
fn libmv_cameras_are_found_again_by_pnp_and_bundle_adjustment() {
    let Some((intrinsics, poses, points, seen)) = libmv() else { return };
    // Every eighth frame: consecutive ones hardly differ.
    let poses: Vec<Pose> = poses.into_iter().step_by(8).collect();
    let seen: Vec<_> =
        seen.into_iter().filter(|s| s.0 % 8 == 0).map(|s| (s.0 / 8, s.1, s.2)).collect();
    let mut worst = 0.0f64;
    for (frame, pose) in poses.iter().enumerate() {
        let here: Vec<_> = seen.iter().filter(|s| s.0 == frame).collect();
        let world: Vec<DVec3> = here.iter().map(|s| points[s.1]).collect();
        let pixels: Vec<DVec2> = here.iter().map(|s| s.2).collect();
        let options = PnpOptions::for_width(intrinsics.width);
        let found = pnp_ransac(&world, &pixels, None, &intrinsics, None, &options).unwrap();
        // Pixels of an image 2,048 wide; the tracker's own solution leaves 0.6 to 1.8.
        assert!(found.rmse < 2.5 && found.inlier_ratio > 0.8, "{frame}: {}", found.rmse);
        worst = worst.max(angle_between(found.view_from_world.rotation, pose.rotation));
    }
    eprintln!("libmv: PnP differs from the tracker by at most {:.4} degrees", worst.to_degrees());
    assert!(worst.to_degrees() < 0.1);
    let exact = anchored(intrinsics, poses, &points, &seen);
    let mut problem = disturbed(&exact, 0.01, 0.1, 12);
    let options = Options { steps: 40, ..Default::default() };
    let report = adjust(&mut problem, &options).unwrap();
    let before = relative_ate(&disturbed(&exact, 0.01, 0.1, 12), &exact);
    let after = relative_ate(&problem, &exact);
    eprintln!(
        "libmv: rmse {:.3} px over {:.3}, relative ATE {before:.4} -> {after:.4}",
        report.inlier_rmse, report.inlier_ratio
    );
    assert!(report.inlier_rmse < 1.0 && report.inlier_ratio > 0.7);
    assert!(after < 0.005 && after < 0.5 * before);
}

/// Wild problems cause neither a panic nor a NaN.
#[test]
fn wild_problems_end_finite_or_in_words() {
    let mut rng = ChaCha8Rng::seed_from_u64(99);
    let mut wild = |limit: f64| {
        let size = 10f64.powf(rng.random_range(-limit..limit));
        if rng.random::<bool>() { size } else { -size }
    };
    let (mut solved, trials) = (0, 300);
    for trial in 0..trials {
        let limit = [1.0, 3.0, 12.0][trial % 3];
        let frames = 1 + trial % 5;
        let poses = (0..frames)
            .map(|_| {
                let turn = DVec3::new(wild(1.0), wild(1.0), wild(1.0));
                Pose::new(exp_so3(turn), DVec3::new(wild(limit), wild(limit), wild(limit)))
            })
            .collect();
        let points: Vec<Point> = (0..1 + trial % 7)
            .map(|i| Point {
                frame: i % frames,
                pixel: DVec2::new(wild(limit), wild(limit)),
                inverse_depth: wild(limit).max(0.0),
                prior: (i % 3 == 0)
                    .then(|| DepthPrior { inverse_depth: wild(limit), weight: wild(limit).abs() }),
            })
            .collect();
        let observations = (0..20)
            .map(|i| Observation {
                point: i % points.len(),
                frame: (i * 7 / 3) % frames,
                pixel: DVec2::new(wild(limit), wild(limit)),
                weight: wild(limit).max(0.0),
                deviation: wild(limit).abs().max(1e-3),
            })
            .collect();
        let mut problem = Problem {
            intrinsics: Intrinsics::centred(wild(2.0).abs() * 10.0, 64, 48),
            k1: 0.0,
            poses,
            fixed: (0..frames).map(|i| i % 4 == 1).collect(),
            points,
            observations,
        };
        let options = Options {
            focal: [FocalMode::Fixed, FocalMode::Free, FocalMode::Gated(0.1)][trial % 3],
            kernel: [Kernel::None, Kernel::Cauchy, Kernel::GemanMcClure][trial / 3 % 3],
            ..Default::default()
        };
        if let Ok(report) = adjust(&mut problem, &options) {
            solved += 1;
            assert!(report.final_cost.is_finite() && report.scale.is_finite(), "{report:?}");
            assert!(!report.focal_std.is_nan() && !report.depth_std.is_nan());
        }
        assert!(all_finite(&problem), "trial {trial}: {problem:?}");
    }
    assert!(solved > trials / 2, "{solved} of {trials} reached a result");

    // The robust searches on pure noise of any size.
    for trial in 0..60 {
        let limit = [1.0, 3.0, 100.0][trial % 3];
        let k = Intrinsics::centred(50.0, 64, 48);
        let a: Vec<DVec2> = (0..trial).map(|_| DVec2::new(wild(limit), wild(limit))).collect();
        let b: Vec<DVec2> = (0..trial).map(|_| DVec2::new(wild(limit), wild(limit))).collect();
        let world: Vec<DVec3> =
            (0..trial).map(|_| DVec3::new(wild(limit), wild(limit), wild(limit))).collect();
        if let Ok(found) = two_view(&a, &b, None, &k, &k, &TwoViewOptions::default()) {
            assert!(found.b_from_a.rotation.is_finite() && found.b_from_a.translation.is_finite());
        }
        if let Ok(found) = pnp_ransac(&world, &b, None, &k, None, &PnpOptions::default()) {
            assert!(found.view_from_world.translation.is_finite());
            assert!(found.covariance.iter().all(|v| v.is_finite()));
        }
    }
}
