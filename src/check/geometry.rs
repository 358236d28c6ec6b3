//! The contract's hard inputs of pose estimation. The cases run on the host only, so `validate` runs them
//! once, whatever the number of devices.

use super::{Bound, Case, Harness};
use crate::error::Result;
use crate::geometry::bundle::{self, Observation, Options, Point, Problem};
use crate::geometry::se3::{angle_between, exp_so3};
use crate::geometry::sim3::{Shape, Sim3, align_points, align_poses};
use crate::geometry::{PnpOptions, PnpResult, pnp_ransac};
use crate::types::{Intrinsics, Pose};
use glam::{DVec2, DVec3};
use rand::RngExt;

/// The family's cases.
pub const CASES: &[Case] = &[
    case("geometry/pnp_coplanar", pnp_coplanar),
    case("geometry/pnp_few_points", pnp_few_points),
    case("geometry/pnp_outliers", pnp_outliers),
    case("geometry/bundle_pure_rotation", bundle_pure_rotation),
    case("geometry/bundle_no_parallax", bundle_no_parallax),
    case("geometry/bundle_points_at_infinity", bundle_points_at_infinity),
    case("geometry/alignment_of_a_line", alignment_of_a_line),
];

const fn case(id: &'static str, run: fn(&mut Harness) -> Result<()>) -> Case {
    Case { id, run }
}

/// Compares an error with a limit.
fn within(h: &mut Harness, what: &str, error: f64, limit: f64) {
    h.close(what, &[error as f32], &[0.0], None, Bound { absolute: limit, relative: 0.0 });
}

const WIDTH: f64 = 512.0;
const HEIGHT: f64 = 384.0;

fn lens() -> Intrinsics {
    Intrinsics { fx: 520.0, fy: 515.0, cx: 250.0, cy: 190.0, width: 512, height: 384 }
}

fn anywhere(h: &mut Harness) -> DVec2 {
    DVec2::new(h.rng.random_range(0.0..WIDTH), h.rng.random_range(0.0..HEIGHT))
}

/// Points of a plane or of a volume, and the pixels at which a camera at `pose` sees them, with
/// noise of `noise` pixels; the first `wrong` observations are at random pixels.
fn seen(
    h: &mut Harness,
    pose: &Pose,
    flat: bool,
    count: usize,
    wrong: usize,
    noise: f64,
) -> (Vec<DVec3>, Vec<DVec2>) {
    let (mut points, mut pixels) = (Vec::new(), Vec::new());
    for i in 0..count {
        let pixel = anywhere(h);
        let ray = lens().ray(pixel);
        let volume = h.rng.random_range(1.5..8.0);
        let depth = if flat { 4.0 / (1.0 + 0.4 * ray.x - 0.3 * ray.y) } else { volume };
        points.push(pose.inverse().apply(ray * depth));
        let mut off = || h.rng.random_range(-1.0..1.0) * noise;
        let near = pixel + DVec2::new(off(), off());
        pixels.push(if i < wrong { anywhere(h) } else { near });
    }
    (points, pixels)
}

fn pose() -> Pose {
    Pose::new(exp_so3(DVec3::new(0.3, -0.4, 0.2)), DVec3::new(0.5, -0.2, 1.0))
}

/// Compares rotation (radians) and translation (world units) errors with `limits`.
fn pose_error(h: &mut Harness, what: &str, found: &PnpResult, limits: [f64; 2]) {
    let (found, truth) = (&found.view_from_world, pose());
    let turn = angle_between(found.rotation, truth.rotation);
    within(h, &format!("{what}: rotation"), turn, limits[0]);
    let shift = (found.translation - truth.translation).length();
    within(h, &format!("{what}: translation"), shift, limits[1]);
}

fn pnp_coplanar(h: &mut Harness) -> Result<()> {
    for count in [6, 8, 200] {
        let (points, pixels) = seen(h, &pose(), true, count, 0, 0.1);
        let found = pnp_ransac(&points, &pixels, None, &lens(), None, &PnpOptions::default())?;
        // A tenth of a pixel is 2e-4 radians; six points of a plane leave some directions weak.
        pose_error(h, &format!("{count} points"), &found, [1e-2, 5e-2]);
    }
    Ok(())
}

/// Four points suffice where four are allowed; fewer give an error.
fn pnp_few_points(h: &mut Harness) -> Result<()> {
    let (points, pixels) = seen(h, &pose(), false, 4, 0, 0.0);
    let four = PnpOptions { min_inliers: 4, ..Default::default() };
    let found = pnp_ransac(&points, &pixels, None, &lens(), None, &four)?;
    // P3P with f64 roots, then refinement.
    pose_error(h, "4 points", &found, [1e-6, 1e-6]);
    for count in 0..6 {
        let (points, pixels) = seen(h, &pose(), false, count, 0, 0.0);
        let found = pnp_ransac(&points, &pixels, None, &lens(), None, &PnpOptions::default());
        let refused = found.is_err_and(|error| error.to_string().contains("usable points"));
        h.holds(&format!("{count} points are too few"), refused);
    }
    Ok(())
}

fn pnp_outliers(h: &mut Harness) -> Result<()> {
    for flat in [false, true] {
        let (points, pixels) = seen(h, &pose(), flat, 1500, 1425, 0.5);
        let options = PnpOptions { min_inlier_ratio: 0.04, ..Default::default() };
        let found = pnp_ransac(&points, &pixels, None, &lens(), None, &options)?;
        pose_error(h, &format!("95 % wrong, flat {flat}"), &found, [1e-2, 5e-2]);
        let found = pnp_ransac(&points, &pixels, None, &lens(), None, &PnpOptions::default());
        let refused = found.is_err_and(|e| e.to_string().contains("keep the predicted pose"));
        h.holds("more than the default share of outliers is refused", refused);
    }
    Ok(())
}

const FRAMES: usize = 8;

/// The `view_from_world` poses of a camera that turns, and moves by `step` per frame.
fn path(step: f64) -> Vec<Pose> {
    let frame = |i: usize| {
        let t = i as f64;
        let turn = exp_so3(DVec3::new(0.03 * (0.5 * t).sin(), 0.03 * t, 0.0));
        Pose::new(turn, DVec3::new(step * t, 0.3 * step * (0.7 * t).sin(), 0.0)).inverse()
    };
    (0..FRAMES).map(frame).collect()
}

/// 300 points of the given inverse depths, observed exactly by the five frames around their own,
/// and the same problem with perturbed poses and depths.
fn clip(h: &mut Harness, poses: &[Pose], inverse_depth: impl Fn(f64) -> f64) -> (Problem, Problem) {
    let (mut points, mut observations) = (Vec::new(), Vec::new());
    for index in 0..300 {
        let frame = index % FRAMES;
        let pixel = anywhere(h);
        let point = Point {
            frame,
            pixel,
            inverse_depth: inverse_depth(h.rng.random_range(0.0..1.0)),
            prior: None,
        };
        for other in frame.saturating_sub(2)..(frame + 3).min(FRAMES) {
            let t_from_r = poses[other] * poses[frame].inverse();
            let ray = t_from_r.rotation * lens().ray(pixel);
            let x = ray + t_from_r.translation * point.inverse_depth;
            if other != frame && x.z > 0.1 {
                let pixel = lens().project(x);
                observations.push(Observation {
                    point: index,
                    frame: other,
                    pixel,
                    weight: 1.0,
                    deviation: 1.0,
                });
            }
        }
        points.push(point);
    }
    let fixed = (0..FRAMES).map(|i| i == 0).collect();
    let truth =
        Problem { intrinsics: lens(), k1: 0.0, poses: poses.to_vec(), fixed, points, observations };
    let mut start = truth.clone();
    for pose in start.poses.iter_mut().skip(1) {
        let mut off = || h.rng.random_range(-0.005..0.005);
        let turn = exp_so3(DVec3::new(off(), off(), off()));
        *pose = Pose::new(turn * pose.rotation, pose.translation);
    }
    for point in &mut start.points {
        point.inverse_depth *= h.rng.random_range(0.7f64..1.4);
    }
    (truth, start)
}

/// Runs the bundle adjustment and compares the rotations with the truth. All results must be
/// finite.
fn adjusted(h: &mut Harness, truth: &Problem, start: Problem) -> Result<bundle::Report> {
    let mut problem = start;
    let report = bundle::adjust(&mut problem, &Options::default())?;
    let finite = problem.poses.iter().all(|p| p.translation.is_finite() && p.rotation.is_finite())
        && problem.points.iter().all(|p| p.inverse_depth.is_finite() && p.inverse_depth >= 0.0);
    h.holds("finite", finite);
    h.holds("no worse than it was", report.final_cost <= report.initial_cost);
    let pairs = problem.poses.iter().zip(&truth.poses);
    let worst = pairs.map(|(a, b)| angle_between(a.rotation, b.rotation)).fold(0.0, f64::max);
    // A pixel is 2e-3 radians; the pixels are exact, and what damping leaves is far below one.
    within(h, "rotations", worst, 1e-3);
    Ok(report)
}

fn bundle_pure_rotation(h: &mut Harness) -> Result<()> {
    let (truth, start) = clip(h, &path(0.0), |t| 0.1 + 0.4 * t);
    let report = adjusted(h, &truth, start)?;
    h.holds("the report says that depth is not known", report.depth_std > 0.3);
    Ok(())
}

/// The camera moves by a ten-thousandth of the depths: a hundredth of a pixel.
fn bundle_no_parallax(h: &mut Harness) -> Result<()> {
    let (truth, start) = clip(h, &path(1e-4), |t| 0.1 + 0.1 * t);
    adjusted(h, &truth, start).map(drop)
}

fn bundle_points_at_infinity(h: &mut Harness) -> Result<()> {
    let (truth, start) = clip(h, &path(0.1), |_| 0.0);
    adjusted(h, &truth, start).map(drop)
}

/// Trajectories on one line, and at one position: the rotation about the line follows from the
/// cameras' axes.
fn alignment_of_a_line(h: &mut Harness) -> Result<()> {
    let truth = Sim3 {
        scale: 2.5,
        rotation: exp_so3(DVec3::new(0.7, -1.1, 0.4)),
        translation: DVec3::new(3.0, -4.0, 5.0),
    };
    for (length, shape) in [(1.0, Shape::Line), (0.0, Shape::Point)] {
        let camera = |i: usize| {
            let t = i as f64;
            let axes = exp_so3(DVec3::new(0.1 * t, 0.3, -0.2));
            Pose::new(axes, DVec3::new(1.0, 2.0, -0.5) * t * length)
        };
        let estimate: Vec<Pose> = (0..8).map(camera).collect();
        let reference: Vec<Pose> = estimate.iter().map(|p| truth.apply_pose(p)).collect();
        let found = align_poses(&estimate, &reference, true)?;
        let what = format!("{shape:?}");
        h.holds(&format!("{what}: told"), found.shape == shape);
        within(h, &format!("{what}: distance"), found.rmse, 1e-9);
        let turn = angle_between(found.reference_from_estimate.rotation, truth.rotation);
        within(h, &format!("{what}: rotation"), turn, 1e-7);
        let centres = |poses: &[Pose]| poses.iter().map(|p| p.translation).collect::<Vec<DVec3>>();
        let points = align_points(&centres(&estimate), &centres(&reference), None, true)?;
        within(h, &format!("{what}: centres alone"), points.rmse, 1e-9);
        h.holds(&format!("{what}: scale"), points.reference_from_estimate.scale > 0.0);
    }
    Ok(())
}
