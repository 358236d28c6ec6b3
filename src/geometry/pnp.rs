//! Robust estimation of a camera's pose from world points and their pixels.

use super::p3p::p3p;
use super::ransac::{Consensus, Estimator, RansacOptions, ransac};
use super::se3::retract;
use crate::error::{Error, Result};
use crate::types::{Intrinsics, Pose};
use glam::{DVec2, DVec3};
use nalgebra::{Matrix2x6, Matrix6, Vector6};

/// Options of the pose estimation.
#[derive(Clone, Copy, Debug)]
pub struct PnpOptions {
    /// Maximum reprojection error of an inlier, pixels.
    pub threshold: f64,
    /// Threshold of the Huber kernel, pixels.
    pub huber: f64,
    /// Required probability that at least one sample is free of outliers.
    pub confidence: f64,
    /// Minimum number of samples.
    pub min_iterations: usize,
    /// Maximum number of samples.
    pub max_iterations: usize,
    /// Minimum share of inliers of a valid result. It also bounds the search: 0.15 needs at most about
    /// 2,700 samples, 0.05 about 74,000.
    pub min_inlier_ratio: f64,
    /// Minimum number of inliers of a valid result; never less than 4.
    pub min_inliers: usize,
    /// Random seed; the same seed gives the same result, bit for bit.
    pub seed: u64,
}

impl PnpOptions {
    /// Defaults for an image of this width: 3 px at 512.
    pub fn for_width(width: u32) -> PnpOptions {
        PnpOptions { threshold: 3.0 * f64::from(width.max(1)) / 512.0, ..Default::default() }
    }
}

impl Default for PnpOptions {
    fn default() -> Self {
        PnpOptions {
            threshold: 3.0,
            huber: 1.0,
            confidence: 0.9999,
            min_iterations: 100,
            max_iterations: 100_000,
            min_inlier_ratio: 0.15,
            min_inliers: 6,
            seed: 0,
        }
    }
}

/// An estimated pose with its uncertainty.
#[derive(Clone, Debug)]
pub struct PnpResult {
    /// World to camera.
    pub view_from_world: Pose,
    /// Per correspondence: whether it is within the threshold and in front of the camera.
    pub inliers: Vec<bool>,
    /// Share of inliers among the usable correspondences.
    pub inlier_ratio: f64,
    /// Root mean square reprojection error of the inliers, pixels.
    pub rmse: f64,
    /// Covariance of the left twist (translation, rotation) of the pose, from the inliers' residuals (with
    /// a noise of at least 0.1 px). Unconstrained directions have a variance of 1e12.
    pub covariance: Matrix6<f64>,
    /// Number of samples drawn.
    pub iterations: usize,
}

/// Estimates a camera's pose from world points and the pixels at which they were seen.
///
/// P3P within RANSAC (MSAC, local optimisation by Gauss–Newton on 14 points), then Levenberg–Marquardt with
/// a Huber kernel on the inliers. `weights` (1 if absent) scale each point's cost; points with a weight of
/// 0 or non-finite values are left out. `prediction` (for example a constant-velocity guess) competes with
/// the samples.
///
/// # Errors
/// Differing lengths; fewer usable points than `min_inliers`; no pose with enough inliers. The caller then
/// keeps its prediction and marks the frame.
pub fn pnp_ransac(
    points: &[DVec3],
    pixels: &[DVec2],
    weights: Option<&[f64]>,
    intrinsics: &Intrinsics,
    prediction: Option<&Pose>,
    options: &PnpOptions,
) -> Result<PnpResult> {
    let op = "PnP";
    let expected = || format!("{}, one for each point", points.len());
    if pixels.len() != points.len() {
        return Err(Error::Shape { op, arg: "pixels", expected: expected(), actual: pixels.len() });
    }
    if let Some(w) = weights
        && w.len() != points.len()
    {
        return Err(Error::Shape { op, arg: "weights", expected: expected(), actual: w.len() });
    }
    check_intrinsics(intrinsics)?;
    let (items, origin) = usable_items(points, pixels, weights);
    let data = Correspondences { intrinsics: *intrinsics, huber: options.huber, items };
    let usable = data.items.len();
    let fewest = options.min_inliers.max(4);
    if usable < fewest {
        return Err(Error::Failed(format!(
            "PnP: {usable} usable points of {}, needs {fewest}; track more points or widen the mask",
            points.len()
        )));
    }
    let search = RansacOptions {
        threshold: options.threshold,
        confidence: options.confidence,
        min_iterations: options.min_iterations,
        max_iterations: options.max_iterations,
        min_inlier_ratio: options.min_inlier_ratio,
        seed: options.seed,
    };
    let guesses: Vec<Pose> = prediction.iter().map(|p| **p).collect();
    let failed = |found: usize| {
        Error::Failed(format!(
            "PnP: the best pose agrees with {found} of {usable} points within {:.2} px, needs {} \
             ({:.0} %); keep the predicted pose for this frame",
            options.threshold,
            fewest.max((options.min_inlier_ratio * usable as f64).ceil() as usize),
            100.0 * options.min_inlier_ratio
        ))
    };
    let consensus = ransac(&data, &search, &guesses).ok_or_else(|| failed(0))?;
    let iterations = consensus.iterations;
    let (pose, inliers) = data.settle(consensus, fewest, options.threshold);
    let ratio = inliers.len() as f64 / usable as f64;
    if inliers.len() < fewest || ratio < options.min_inlier_ratio {
        return Err(failed(inliers.len()));
    }
    let squared: f64 = inliers.iter().map(|&i| data.squared_error(&pose, i)).sum();
    let rmse = (squared / inliers.len() as f64).sqrt();
    // Two residuals per point, minus the six degrees of freedom of the pose.
    let freedom = (2 * inliers.len()).saturating_sub(6).max(1) as f64;
    let variance = (squared / freedom).max(0.01);
    let (hessian, _, _) = data.normal_equations(&pose, &inliers);
    let mut mask = vec![false; points.len()];
    inliers.iter().for_each(|&i| mask[origin[i]] = true);
    Ok(PnpResult {
        view_from_world: pose,
        inliers: mask,
        inlier_ratio: ratio,
        rmse,
        covariance: bounded_inverse(&hessian) * variance,
        iterations,
    })
}

/// Refines a pose on all given correspondences (Huber kernel, at most 20 steps of Levenberg–Marquardt);
/// also returns the cost before and after, Σ w ρ(|r|), pixels².
///
/// # Errors
/// Differing lengths, an invalid focal length.
pub fn refine_pose(
    points: &[DVec3],
    pixels: &[DVec2],
    intrinsics: &Intrinsics,
    view_from_world: &Pose,
    huber: f64,
) -> Result<(Pose, f64, f64)> {
    if pixels.len() != points.len() {
        return Err(Error::Shape {
            op: "pose refinement",
            arg: "pixels",
            expected: format!("{}, one for each point", points.len()),
            actual: pixels.len(),
        });
    }
    check_intrinsics(intrinsics)?;
    let items = points.iter().zip(pixels).map(|(&x, &u)| (x, u, 1.0)).collect();
    let data = Correspondences { intrinsics: *intrinsics, huber, items };
    let all: Vec<usize> = (0..points.len()).collect();
    let before = data.cost(view_from_world, &all);
    let (pose, after) = data.minimise(view_from_world, &all, 20);
    Ok((pose, before, after))
}

/// Rejects intrinsics for which rays are undefined.
pub(crate) fn check_intrinsics(k: &Intrinsics) -> Result<()> {
    let finite = [k.fx, k.fy, k.cx, k.cy].iter().all(|v| v.is_finite());
    if !finite || k.fx <= 0.0 || k.fy <= 0.0 {
        return Err(Error::Input(format!(
            "the intrinsics fx {} fy {} cx {} cy {} are not those of a camera; give a positive \
             focal length in pixels",
            k.fx, k.fy, k.cx, k.cy
        )));
    }
    Ok(())
}

/// The pixel of a point in the camera frame and its derivative with respect to the left twist (translation,
/// rotation) of the pose that mapped it there; `None` for a point that is not in front.
pub fn project_with_jacobian(k: &Intrinsics, p: DVec3) -> Option<(DVec2, Matrix2x6<f64>)> {
    if p.z.is_nan() || p.z <= 1e-9 * p.abs().max_element() {
        return None;
    }
    let (x, y, iz) = (p.x / p.z, p.y / p.z, 1.0 / p.z);
    #[rustfmt::skip]
    let jacobian = Matrix2x6::new(
        k.fx * iz, 0.0, -k.fx * x * iz, -k.fx * x * y, k.fx * (1.0 + x * x), -k.fx * y,
        0.0, k.fy * iz, -k.fy * y * iz, -k.fy * (1.0 + y * y), k.fy * x * y, k.fy * x,
    );
    Some((DVec2::new(k.fx * x + k.cx, k.fy * y + k.cy), jacobian))
}

/// The inverse of a positive semidefinite matrix; directions without information have a variance of 1e12.
fn bounded_inverse(hessian: &Matrix6<f64>) -> Matrix6<f64> {
    let eigen = hessian.symmetric_eigen();
    let largest = eigen.eigenvalues.max();
    let inverse =
        eigen.eigenvalues.map(|v| if v > 1e-13 * largest { (1.0 / v).min(1e12) } else { 1e12 });
    eigen.eigenvectors * Matrix6::from_diagonal(&inverse) * eigen.eigenvectors.transpose()
}

/// The finite correspondences of positive weight (1 without weights), and the index of each.
fn usable_items(
    points: &[DVec3],
    pixels: &[DVec2],
    weights: Option<&[f64]>,
) -> (Vec<(DVec3, DVec2, f64)>, Vec<usize>) {
    let item = |i: usize| (points[i], pixels[i], weights.map_or(1.0, |w| w[i]));
    let usable = |(point, pixel, weight): (DVec3, DVec2, f64)| {
        point.is_finite() && pixel.is_finite() && weight.is_finite() && weight > 0.0
    };
    (0..points.len()).map(|i| (item(i), i)).filter(|(item, _)| usable(*item)).unzip()
}

struct Correspondences {
    intrinsics: Intrinsics,
    huber: f64,
    /// Point, pixel, weight.
    items: Vec<(DVec3, DVec2, f64)>,
}

impl Correspondences {
    fn within(&self, pose: &Pose, threshold: f64) -> Vec<usize> {
        let t2 = threshold * threshold;
        (0..self.items.len()).filter(|&i| self.squared_error(pose, i) < t2).collect()
    }

    /// Σ w ρ(|r|), infinite where a point is behind the camera.
    fn cost(&self, pose: &Pose, subset: &[usize]) -> f64 {
        subset
            .iter()
            .map(|&i| {
                let e2 = self.squared_error(pose, i);
                let e = e2.sqrt();
                let rho = if e <= self.huber { e2 } else { self.huber * (2.0 * e - self.huber) };
                self.items[i].2 * rho
            })
            .sum()
    }

    /// Hessian, gradient (of half the squared cost) and number of points in front.
    fn normal_equations(
        &self,
        pose: &Pose,
        subset: &[usize],
    ) -> (Matrix6<f64>, Vector6<f64>, usize) {
        let (mut h, mut g, mut count) = (Matrix6::zeros(), Vector6::zeros(), 0);
        for &i in subset {
            let (point, pixel, weight) = self.items[i];
            let Some((u, j)) = project_with_jacobian(&self.intrinsics, pose.apply(point)) else {
                continue;
            };
            let r = u - pixel;
            let e = r.length();
            let w = weight * if e <= self.huber { 1.0 } else { self.huber / e };
            h += j.transpose() * j * w;
            g += j.transpose() * nalgebra::Vector2::new(r.x, r.y) * w;
            count += 1;
        }
        (h, g, count)
    }

    /// Refines the pose of a consensus on its inliers, and the inliers with it.
    fn settle(
        &self,
        consensus: Consensus<Pose>,
        fewest: usize,
        threshold: f64,
    ) -> (Pose, Vec<usize>) {
        let Consensus { model: mut pose, mut inliers, .. } = consensus;
        // The refined pose may gain or lose inliers; a few rounds suffice to converge.
        for _ in 0..4 {
            if inliers.len() < fewest {
                break;
            }
            pose = self.minimise(&pose, &inliers, 20).0;
            let next = self.within(&pose, threshold);
            if next == inliers {
                break;
            }
            inliers = next;
        }
        (pose, inliers)
    }

    fn minimise(&self, start: &Pose, subset: &[usize], steps: usize) -> (Pose, f64) {
        let mut pose = *start;
        let mut cost = self.cost(&pose, subset);
        let mut damping = 1e-4;
        for _ in 0..steps {
            let (h, g, count) = self.normal_equations(&pose, subset);
            if count < 3 {
                break;
            }
            let mut damped = h;
            let floor = 1e-12 * h.diagonal().max();
            for k in 0..6 {
                damped[(k, k)] += damping * h[(k, k)] + floor;
            }
            let Some(factor) = damped.cholesky() else { break };
            let step = -factor.solve(&g);
            let next = retract(&pose, &step);
            let next_cost = self.cost(&next, subset);
            if next_cost.is_finite() && next_cost < cost {
                let small = cost - next_cost <= 1e-12 * cost;
                (pose, cost) = (next, next_cost);
                damping = (damping * 0.1).max(1e-12);
                if small {
                    break;
                }
            } else {
                damping *= 10.0;
                if damping > 1e8 {
                    break;
                }
            }
        }
        (pose, cost)
    }
}

impl Estimator for Correspondences {
    type Model = Pose;
    const SAMPLE: usize = 3;
    const LOCAL_SAMPLE: usize = 14;

    fn len(&self) -> usize {
        self.items.len()
    }

    fn minimal(&self, sample: &[usize], out: &mut Vec<Pose>) {
        let points = [0, 1, 2].map(|k| self.items[sample[k]].0);
        let rays = [0, 1, 2].map(|k| self.intrinsics.ray(self.items[sample[k]].1));
        out.extend(p3p(&rays, &points));
    }

    fn squared_error(&self, pose: &Pose, index: usize) -> f64 {
        let (point, pixel, _) = self.items[index];
        let p = pose.apply(point);
        if p.z > 1e-9 * p.abs().max_element() {
            (self.intrinsics.project(p) - pixel).length_squared()
        } else {
            f64::INFINITY
        }
    }

    fn refine(&self, pose: &Pose, sample: &[usize]) -> Option<Pose> {
        Some(self.minimise(pose, sample, 4).0)
    }

    fn weight(&self, index: usize) -> f64 {
        self.items[index].2
    }
}

#[cfg(test)]
mod tests;
