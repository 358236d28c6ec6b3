//! Bundle adjustment: camera poses, one shared focal length and radial distortion, and an inverse depth
//! per point.
//!
//! A point is a pixel of its reference frame r and an inverse depth d along that pixel's ray. With `G =
//! view_from_world` and `t_from_r = G_t G_r⁻¹ = (R, t)`, frame t sees it at `Π(R ray + d t)`, which is
//! defined even at d = 0, a point at infinity. This is the parametrisation of dense bundle adjustment
//! (DROID-SLAM, Teed and Deng 2021), here over sparse observations with a robust kernel, because flow has
//! no learned weights.
//!
//! The normal equations are reduced to the cameras by the Schur complement over the inverse depths (one
//! scalar per point), and solved by Cholesky decomposition within Levenberg–Marquardt. A camera is coupled
//! with those that see the same points: where points are tracked over a bounded number of frames, time and
//! memory grow linearly with the number of frames. The focal length is one more column of the camera block,
//! as log f; it is released only when the data determine it ([`FocalMode::Gated`], MegaSaM's Hessian gate
//! expressed as a standard deviation).
//!
//! Gauge: the first frame is fixed when none is marked fixed. The overall scale, where nothing anchors it,
//! is fixed by preserving the median inverse depth of the input.

mod deviation;
mod normal;
mod residual;

use crate::error::{Error, Result};
use crate::types::{Intrinsics, Pose};
pub use deviation::{PoseDeviation, focal_deviation_of_regions, pose_deviations};
use glam::DVec2;
use normal::{Layout, NormalEquations};
pub use residual::{Jacobian, project};

/// A point: a pixel of its reference frame, and its inverse depth along the pixel's ray.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Point {
    /// Index of the frame that the pixel belongs to.
    pub frame: usize,
    /// Pixel in that frame; treated as exact (as a grid pixel of dense flow is; a noisy detection biases
    /// its whole track).
    pub pixel: DVec2,
    /// 1 / depth (z) in that frame, in 1 / world units; 0 for a point at infinity.
    pub inverse_depth: f64,
    /// Prior on the inverse depth.
    pub prior: Option<DepthPrior>,
}

/// Prior knowledge of a point's inverse depth: adds `weight · (d − inverse_depth)²` to the cost.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DepthPrior {
    /// The expected inverse depth.
    pub inverse_depth: f64,
    /// Pixels² per (inverse depth)², not negative.
    pub weight: f64,
}

/// Observation of a point in another frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Observation {
    /// Index of the point.
    pub point: usize,
    /// Index of the frame that saw it; observations in the point's own frame are ignored.
    pub frame: usize,
    /// Pixel in that frame, pixels.
    pub pixel: DVec2,
    /// Weight, such as 1 − P(dynamic); 0 disables the observation.
    pub weight: f64,
    /// Standard deviation of the pixel along each axis, pixels, or a value proportional to it.
    pub deviation: f64,
}

/// A bundle adjustment problem, which [`adjust`] changes in place.
#[derive(Clone, Debug)]
pub struct Problem {
    /// Intrinsics shared by all frames; only the focal length is ever changed, fx and fy by one factor.
    pub intrinsics: Intrinsics,
    /// Radial distortion of the lens, shared by all frames: the ideal position p in the plane of unit depth
    /// is imaged at p (1 + k1 |p|²). 0 for a pinhole camera.
    pub k1: f64,
    /// `view_from_world` per frame.
    pub poses: Vec<Pose>,
    /// Per frame: whether its pose is fixed. When none is, the first frame is fixed.
    pub fixed: Vec<bool>,
    /// The points.
    pub points: Vec<Point>,
    /// Their observations, in any order.
    pub observations: Vec<Observation>,
}

/// The robust kernel; its width c is [`Options::kernel_width`] times the scale of the residuals.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kernel {
    /// ρ = r². Not robust.
    None,
    /// ρ = c² ln(1 + r²/c²). Outliers keep a small influence.
    Cauchy,
    /// ρ = r² c² / (c² + r²). The influence of outliers vanishes.
    GemanMcClure,
}

/// Treatment of the focal length.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum FocalMode {
    /// Kept.
    Fixed,
    /// Adjusted if its relative standard deviation would be at most this value; else kept.
    Gated(f64),
    /// Always adjusted.
    Free,
}

/// Options of a bundle adjustment.
#[derive(Clone, Copy, Debug)]
pub struct Options {
    /// Treatment of the focal length.
    pub focal: FocalMode,
    /// Prior focal length (fx, pixels) and its relative standard deviation.
    pub focal_prior: Option<(f64, f64)>,
    /// Whether the lens distortion is adjusted.
    pub distortion: bool,
    /// Whether the inverse depths are adjusted.
    pub depths: bool,
    /// Whether the rotations of the poses are adjusted; otherwise only their translations are.
    pub rotations: bool,
    /// Robust kernel.
    pub kernel: Kernel,
    /// Kernel width in units of the scale (1.4826 · median absolute residual coordinate, each divided by
    /// its observation's deviation).
    pub kernel_width: f64,
    /// Lower bound of the scale, in standard deviations of the observations.
    pub scale_floor: f64,
    /// Number of rounds, each of which estimates the scale anew.
    pub rounds: usize,
    /// Maximum number of Levenberg–Marquardt steps per round.
    pub steps: usize,
}

impl Default for Options {
    fn default() -> Self {
        Options {
            focal: FocalMode::Fixed,
            focal_prior: None,
            distortion: false,
            depths: true,
            rotations: true,
            kernel: Kernel::GemanMcClure,
            kernel_width: 3.0,
            scale_floor: 0.5,
            rounds: 4,
            steps: 15,
        }
    }
}

/// Result of a bundle adjustment.
#[derive(Clone, Debug)]
pub struct Report {
    /// Σ w r² / σ² before, without a kernel, over the observations in front of their cameras.
    pub initial_squared: f64,
    /// The same sum afterwards.
    pub final_squared: f64,
    /// Robust cost at the first round's scale, before.
    pub initial_cost: f64,
    /// Robust cost at the first round's scale, afterwards.
    pub final_cost: f64,
    /// Weighted root mean square residual of the inliers (within the kernel width), pixels.
    pub inlier_rmse: f64,
    /// Share of inliers among the observations used.
    pub inlier_ratio: f64,
    /// Final robust scale of a residual coordinate, in standard deviations, after the lower bound.
    pub scale: f64,
    /// Number of steps tried.
    pub steps: usize,
    /// Whether the last round converged before its maximum number of steps.
    pub converged: bool,
    /// Whether the focal length was adjusted.
    pub focal_released: bool,
    /// Relative standard deviation of the focal length for independent errors, with all other unknowns free;
    /// infinite if unobservable. [`focal_deviation_of_regions`] is that for errors that image regions share.
    pub focal_std: f64,
    /// Standard deviation of k1, with all other unknowns free; infinite if unobservable, 0 where it was kept.
    pub k1_std: f64,
    /// Median over the points of the relative standard deviation of the inverse depth, σ_d / d, with poses
    /// fixed. Well-posed clips are below 0.1; above 0.3 there is practically no parallax.
    pub depth_std: f64,
    /// Whether there are more unknowns than residuals, so that the solution is not unique.
    pub underdetermined: bool,
    /// Per observation: final residual, pixels; infinite behind the camera.
    pub residuals: Vec<f64>,
}

/// Root mean square residual, in standard deviations, below which steps only follow rounding errors.
const EXACT: f64 = 1e-10;

/// Maximum factor by which the focal length may leave its initial value; beyond, it diverges.
const FOCAL_RANGE: f64 = 8.0;

/// Adjusts the poses, inverse depths and, as requested, the focal length and the distortion of a problem in
/// place.
///
/// Pure rotation, no parallax and points at infinity leave directions undetermined, which damping then
/// holds: the result is finite and the report gives its uncertainty (`depth_std`, `focal_std`,
/// `underdetermined`). On an error the problem is unchanged.
///
/// # Errors
/// Inconsistent lengths or indices, non-finite values, a negative weight or inverse depth, no frames, no
/// observation with weight.
pub fn adjust(problem: &mut Problem, options: &Options) -> Result<Report> {
    check(problem, options)?;
    let original = problem.clone();
    let anchored = scale_is_anchored(problem);
    let median = median_inverse_depth(problem);
    let first_scale = residual::robust_scale(problem, options);
    let initial_squared = residual::squared_sum(problem);
    let initial_cost = residual::cost(problem, options, first_scale);

    let released = match options.focal {
        FocalMode::Fixed => false,
        FocalMode::Free => true,
        FocalMode::Gated(_) => false,
    };
    let mut work = solve(problem, options, released);
    let mut focal_released = released;
    let mut focal_std = focal_deviation(problem, options);
    if let FocalMode::Gated(limit) = options.focal
        && focal_std <= limit
    {
        let held = problem.clone();
        let second = solve(problem, options, true);
        let std = focal_deviation(problem, options);
        let ratio = problem.intrinsics.fx / held.intrinsics.fx;
        // Released on its predicted information; reverted if the actual one is insufficient.
        if std <= limit && (1.0 / FOCAL_RANGE..FOCAL_RANGE).contains(&ratio) {
            work = Work { steps: work.steps + second.steps, ..second };
            (focal_released, focal_std) = (true, std);
        } else {
            *problem = held;
        }
    }
    if !anchored && let (Some(before), Some(now)) = (median, median_inverse_depth(problem)) {
        rescale(problem, now / before);
    }
    if !is_finite(problem) {
        *problem = original;
        return Err(Error::Failed(
            "bundle adjustment: the solution left the range of numbers; the observations \
             contradict each other too much, lower the weights of doubtful ones"
                .into(),
        ));
    }
    let scale = residual::robust_scale(problem, options);
    let (inlier_rmse, inlier_ratio) = residual::inliers(problem, options, scale);
    let layout = Layout::new(problem, options, focal_released);
    let residuals_used = 2 * problem.observations.iter().filter(|o| counts(problem, o)).count();
    let depths = if options.depths { problem.points.len() } else { 0 };
    let priors = problem.points.iter().filter(|p| p.prior.is_some()).count();
    Ok(Report {
        initial_squared,
        final_squared: residual::squared_sum(problem),
        initial_cost,
        final_cost: residual::cost(problem, options, first_scale),
        inlier_rmse,
        inlier_ratio,
        scale,
        steps: work.steps,
        converged: work.converged,
        focal_released,
        focal_std,
        k1_std: distortion_deviation(problem, options, focal_released),
        depth_std: normal::median_depth_deviation(problem, options, scale),
        underdetermined: residuals_used + priors < layout.size + depths,
        residuals: residual::lengths(problem),
    })
}

/// Scales the world about the centre of the first fixed camera so that inverse depths are multiplied by `1
/// / factor`: depths and baselines grow by `factor`, residuals are unchanged.
pub fn rescale(problem: &mut Problem, factor: f64) {
    if !(factor.is_finite() && factor > 0.0) || factor == 1.0 || problem.poses.is_empty() {
        return;
    }
    let anchor = problem.fixed.iter().position(|f| *f).unwrap_or(0);
    let centre = problem.poses[anchor].inverse().translation;
    for (i, pose) in problem.poses.iter_mut().enumerate() {
        if i != anchor {
            let moved = centre + factor * (pose.inverse().translation - centre);
            pose.translation = -(pose.rotation * moved);
        }
    }
    for point in &mut problem.points {
        point.inverse_depth /= factor;
        if let Some(prior) = &mut point.prior {
            prior.inverse_depth /= factor;
            prior.weight *= factor * factor;
        }
    }
}

/// The median inverse depth of the points that are not at infinity; `None` without such points.
pub fn median_inverse_depth(problem: &Problem) -> Option<f64> {
    let mut d: Vec<f64> =
        problem.points.iter().map(|p| p.inverse_depth).filter(|d| *d > 0.0).collect();
    let middle = d.len() / 2;
    (!d.is_empty()).then(|| *d.select_nth_unstable_by(middle, f64::total_cmp).1)
}

/// Result of the rounds.
struct Work {
    steps: usize,
    converged: bool,
}

/// All rounds of IRLS: a scale estimate, then Levenberg–Marquardt on the cost that it defines.
fn solve(problem: &mut Problem, options: &Options, focal: bool) -> Work {
    let layout = Layout::new(problem, options, focal);
    let mut work = Work { steps: 0, converged: true };
    for _ in 0..options.rounds.max(1) {
        let scale = residual::robust_scale(problem, options);
        let (steps, converged) = levenberg_marquardt(problem, options, &layout, scale);
        work.steps += steps;
        work.converged = converged;
        // Without a kernel the cost does not depend on the scale, so one round suffices.
        if options.kernel == Kernel::None && converged {
            break;
        }
    }
    work
}

/// Which unknowns are adjusted.
struct Unknowns {
    intrinsics: Intrinsics,
    k1: f64,
    poses: Vec<Pose>,
    points: Vec<Point>,
}

impl Unknowns {
    fn of(problem: &Problem) -> Unknowns {
        Unknowns {
            intrinsics: problem.intrinsics,
            k1: problem.k1,
            poses: problem.poses.clone(),
            points: problem.points.clone(),
        }
    }

    fn restore(self, problem: &mut Problem) {
        let Unknowns { intrinsics, k1, poses, points } = self;
        (problem.intrinsics, problem.k1) = (intrinsics, k1);
        (problem.poses, problem.points) = (poses, points);
    }
}

fn levenberg_marquardt(
    problem: &mut Problem,
    options: &Options,
    layout: &Layout,
    scale: f64,
) -> (usize, bool) {
    let mut cost = residual::cost(problem, options, scale);
    let exact = EXACT.powi(2) * problem.observations.len() as f64;
    let mut damping = 1e-4;
    let mut growth = 2.0;
    let mut equations = NormalEquations::build(problem, options, layout, scale);
    for step in 0..options.steps {
        let Some(delta) = equations.solve(layout, damping) else {
            damping *= growth;
            growth *= 2.0;
            if damping > 1e12 {
                return (step, false);
            }
            continue;
        };
        let before = Unknowns::of(problem);
        layout.apply(problem, &delta);
        let next_cost = residual::cost(problem, options, scale);
        let predicted = equations.predicted_decrease(&delta, damping);
        if next_cost.is_finite() && next_cost < cost {
            let decrease = cost - next_cost;
            let converged = decrease <= 1e-9 * cost || next_cost <= exact;
            cost = next_cost;
            // Nielsen's rule: the damping decreases with the agreement between the quadratic model and the
            // actual decrease.
            let gain = if predicted > 0.0 { decrease / predicted } else { 1.0 };
            damping *= (1.0 - (2.0 * gain - 1.0).powi(3)).clamp(1.0 / 3.0, 2.0);
            damping = damping.max(1e-10);
            growth = 2.0;
            if converged {
                return (step + 1, true);
            }
            equations = NormalEquations::build(problem, options, layout, scale);
        } else {
            before.restore(problem);
            if predicted <= 1e-12 * cost {
                return (step + 1, true);
            }
            damping *= growth;
            growth *= 2.0;
            if damping > 1e12 {
                return (step + 1, true);
            }
        }
    }
    (options.steps, false)
}

/// Relative standard deviation of the focal length with all other unknowns free.
fn focal_deviation(problem: &Problem, options: &Options) -> f64 {
    let scale = residual::robust_scale(problem, options);
    let layout = Layout::new(problem, options, true);
    let equations = NormalEquations::build(problem, options, &layout, scale);
    let information = layout.focal().and_then(|column| equations.information(&layout, column));
    information.map_or(f64::INFINITY, |i| scale / i.sqrt())
}

/// Standard deviation of k1 with all other unknowns free; 0 where it is kept.
fn distortion_deviation(problem: &Problem, options: &Options, focal: bool) -> f64 {
    let layout = Layout::new(problem, options, focal);
    let Some(column) = layout.distortion() else { return 0.0 };
    let scale = residual::robust_scale(problem, options);
    let equations = NormalEquations::build(problem, options, &layout, scale);
    equations.information(&layout, column).map_or(f64::INFINITY, |i| scale / i.sqrt())
}

/// Whether the scale of the world is determined by several fixed cameras at different positions, or by
/// depth priors.
fn scale_is_anchored(problem: &Problem) -> bool {
    let mut centres = problem
        .poses
        .iter()
        .zip(&problem.fixed)
        .filter(|(_, fixed)| **fixed)
        .map(|(pose, _)| pose.inverse().translation);
    let apart = centres.next().is_some_and(|first| {
        centres.any(|c| (c - first).length() > 1e-12 * (1.0 + first.length()))
    });
    apart || problem.points.iter().any(|p| p.prior.is_some_and(|prior| prior.weight > 0.0))
}

/// Whether an observation is used.
fn counts(problem: &Problem, o: &Observation) -> bool {
    o.weight > 0.0 && problem.points[o.point].frame != o.frame
}

fn is_finite(problem: &Problem) -> bool {
    problem.intrinsics.fx.is_finite()
        && problem.k1.is_finite()
        && problem.poses.iter().all(|p| p.rotation.is_finite() && p.translation.is_finite())
        && problem.points.iter().all(|p| p.inverse_depth.is_finite())
}

fn check(problem: &Problem, options: &Options) -> Result<()> {
    let op = "bundle adjustment";
    super::pnp::check_intrinsics(&problem.intrinsics)?;
    let frames = problem.poses.len();
    if problem.fixed.len() != frames {
        let expected = format!("{frames}, one for each pose");
        return Err(Error::Shape { op, arg: "fixed", expected, actual: problem.fixed.len() });
    }
    let bad = |what: String| Err(Error::Input(format!("{op}: {what}")));
    if !(problem.k1.is_finite() && problem.k1.abs() <= 1.0) {
        return bad(format!("k1 {} is no lens's distortion; it is within ±1", problem.k1));
    }
    for (i, p) in problem.poses.iter().enumerate() {
        if !p.translation.is_finite() || !p.rotation.is_normalized() {
            return bad(format!("the pose of frame {i} is not a rigid transform: {p:?}"));
        }
    }
    for (i, p) in problem.points.iter().enumerate() {
        if p.frame >= frames {
            return bad(format!("point {i} refers to frame {} of {frames}", p.frame));
        }
        let fine = p.pixel.is_finite() && p.inverse_depth.is_finite() && p.inverse_depth >= 0.0;
        let prior = p
            .prior
            .is_none_or(|q| q.inverse_depth.is_finite() && q.weight.is_finite() && q.weight >= 0.0);
        if !fine || !prior {
            return bad(format!(
                "point {i} needs a finite pixel, an inverse depth ≥ 0 and a prior weight ≥ 0: {p:?}"
            ));
        }
    }
    let positive = |v: f64| v.is_finite() && v > 0.0;
    for (i, o) in problem.observations.iter().enumerate() {
        if o.point >= problem.points.len() || o.frame >= frames {
            return bad(format!(
                "observation {i} refers to point {} of {} in frame {} of {frames}",
                o.point,
                problem.points.len(),
                o.frame
            ));
        }
        let fine = o.pixel.is_finite() && o.weight.is_finite() && o.weight >= 0.0;
        if !fine || !positive(o.deviation) {
            return bad(format!(
                "observation {i} needs a finite pixel, a weight ≥ 0 and a positive deviation: {o:?}"
            ));
        }
    }
    if !positive(options.kernel_width) || options.scale_floor.is_nan() || options.scale_floor < 0.0
    {
        return bad(format!(
            "the kernel width {} must be positive and the scale floor {} not negative",
            options.kernel_width, options.scale_floor
        ));
    }
    if let Some((focal, std)) = options.focal_prior
        && !(positive(focal) && positive(std))
    {
        return bad(format!("the focal prior {focal} ± {std} must be positive"));
    }
    if !problem.observations.iter().any(|o| counts(problem, o)) {
        return bad(
            "no observation counts: all weights are 0 or all points are seen in their own \
                    frame only; track points over more frames"
                .into(),
        );
    }
    Ok(())
}
