//! Fits a camera pose so that a scene's rendered image matches a given image.

use nalgebra::{SMatrix, SVector};
use rayon::prelude::*;

use crate::geometry::se3::{Twist, retract};
use crate::types::{Camera, Image, Pose};
use crate::{Error, Result};

/// Minimum length of the smaller side of the coarsest image, pixels.
const COARSEST_SIDE: u32 = 48;
/// Upper bound of the coarsest level; its pixels are 2 to this wide.
const MOST_LEVELS: u32 = 3;
/// Maximum number of steps per level.
const STEPS: usize = 6;
/// Trials of a step, with increasing damping.
const TRIALS: usize = 3;
/// Step of the finite differences, pixels of the level.
const DIFFERENCE: f64 = 0.5;
/// Maximum length of a step, beyond which the derivatives are invalid, pixels of the level.
const LONGEST: f64 = 2.0;
/// Step length below which a level ends, pixels of the level.
const SHORTEST: f64 = 0.02;

type Vector6 = SVector<f64, 6>;

/// Result of [`fit_pose`].
#[derive(Clone, Copy, Debug)]
pub struct PoseFit {
    /// The fitted pose, world to camera, or the initial one where no better pose was found.
    pub view_from_world: Pose,
    /// Mean squared error at the initial pose.
    pub before: f64,
    /// Mean squared error at the fitted pose; never larger than `before`.
    pub after: f64,
    /// Number of rendered images.
    pub renders: usize,
}

/// Fits a camera pose to an image: finds the pose near `start` whose rendered image, as `render` gives it,
/// has the least squared error against `truth` over the pixels where `mask` (one channel; `None`: all
/// pixels) is above one half.
///
/// Uses Levenberg–Marquardt over the six parameters of the pose with finite-difference derivatives of the
/// image, first on coarse images (means of at most 8×8 pixels), then on finer ones; a step is taken only
/// where the error decreases. `depth` is a typical depth of the view, which relates camera motion to image
/// motion.
///
/// # Errors
/// Images of differing sizes, a depth that is not positive, an empty mask, errors of `render`.
pub fn fit_pose(
    start: &Camera,
    depth: f64,
    truth: &Image,
    mask: Option<&Image>,
    render: impl FnMut(&Camera) -> Result<Image>,
) -> Result<PoseFit> {
    if !(depth.is_finite() && depth > 0.0) {
        let what = format!("fitting a pose needs a positive depth of the scene, not {depth}");
        return Err(Error::Input(what));
    }
    let chosen = |m: &Image| m.pixels.iter().any(|v| *v > 0.5);
    if mask.is_some_and(|m| {
        (m.width, m.height, m.channels) != (truth.width, truth.height, 1) || !chosen(m)
    }) {
        let what = "fitting a pose needs a mask of the image's size that chooses some pixels";
        return Err(Error::Input(what.into()));
    }
    let mut fit = Fit { start, depth, truth, mask, render, renders: 0 };
    let first = start.view_from_world;
    let mut pose = first;
    let side = truth.width.min(truth.height);
    let coarsest = (0..=MOST_LEVELS).rev().find(|level| side >> level >= COARSEST_SIDE);
    for level in (1..=coarsest.unwrap_or(0)).rev() {
        pose = fit.on_level(level, pose)?.0;
    }
    // A pose that is better on coarse images may be worse at full resolution.
    let before = fit.residuals(0, &first)?.cost();
    if pose != first && fit.residuals(0, &pose)?.cost() > before {
        pose = first;
    }
    let (view_from_world, after) = fit.on_level(0, pose)?;
    Ok(PoseFit { view_from_world, before, after, renders: fit.renders })
}

struct Fit<'a, R> {
    start: &'a Camera,
    depth: f64,
    truth: &'a Image,
    mask: Option<&'a Image>,
    render: R,
    renders: usize,
}

impl<R: FnMut(&Camera) -> Result<Image>> Fit<'_, R> {
    /// The best pose near `from` on images whose pixels are 2^`level` wide, and its cost.
    fn on_level(&mut self, level: u32, from: Pose) -> Result<(Pose, f64)> {
        let pixel = f64::from(1u32 << level);
        let mut pose = from;
        let mut here = self.residuals(level, &pose)?;
        let mut damping = 1e-2;
        for _ in 0..STEPS {
            let mut columns = Vec::with_capacity(6);
            for k in 0..6 {
                let mut step = Vector6::zeros();
                step[k] = DIFFERENCE * pixel;
                columns.push(self.residuals(level, &self.moved(&pose, &step))?);
            }
            let (hessian, gradient) = normal_equations(&here, &columns, DIFFERENCE * pixel);
            let mut best: Option<(Pose, Residuals, f64)> = None;
            for _ in 0..TRIALS {
                let mut damped = hessian;
                let floor = 1e-9 * hessian.trace();
                (0..6).for_each(|k| damped[(k, k)] += damping * hessian[(k, k)] + floor);
                let Some(solved) = damped.cholesky() else { break };
                let mut step = -solved.solve(&gradient);
                step *= (LONGEST * pixel / step.amax()).min(1.0);
                let candidate = self.moved(&pose, &step);
                let there = self.residuals(level, &candidate)?;
                if there.cost() < here.cost() {
                    damping = (damping * 0.1).max(1e-6);
                    best = Some((candidate, there, step.amax()));
                    break;
                }
                damping *= 10.0;
            }
            let Some((candidate, there, length)) = best else { break };
            (pose, here) = (candidate, there);
            if length < SHORTEST * pixel {
                break;
            }
        }
        let cost = here.cost();
        Ok((pose, cost))
    }

    /// Moves a pose by parameters in pixels: each is the image displacement of a point at the typical depth
    /// in the image centre, or at the border for parameters without displacement in the centre.
    fn moved(&self, pose: &Pose, pixels: &Vector6) -> Pose {
        let k = &self.start.intrinsics;
        let half_side = 0.5 * f64::from(k.width.min(k.height));
        let twist = Twist::new(
            pixels[0] * self.depth / k.fx,
            pixels[1] * self.depth / k.fy,
            pixels[2] * self.depth / half_side,
            pixels[3] / k.fy,
            pixels[4] / k.fx,
            pixels[5] / half_side,
        );
        retract(pose, &twist)
    }

    fn residuals(&mut self, level: u32, pose: &Pose) -> Result<Residuals> {
        self.renders += 1;
        let image = (self.render)(&Camera { view_from_world: *pose, ..*self.start })?;
        let truth = self.truth;
        let size = |i: &Image| (i.width, i.height, i.channels);
        if size(&image) != size(truth) {
            return Err(Error::Input(format!(
                "a pose is fitted to images of one size, not {}×{} and {}×{}",
                image.width, image.height, truth.width, truth.height
            )));
        }
        Ok(Residuals::of(&image, truth, self.mask, level))
    }
}

/// Differences to the ground truth, averaged over blocks of pixels.
struct Residuals {
    /// All channels of a block, one block after the other.
    values: Vec<f64>,
    /// Number of selected pixels of each block.
    weights: Vec<f64>,
    channels: usize,
}

impl Residuals {
    fn of(image: &Image, truth: &Image, mask: Option<&Image>, level: u32) -> Residuals {
        let (width, side) = (image.width as usize, 1usize << level);
        let (height, channels) = (image.height as usize, image.channels as usize);
        let (across, down) = (width.div_ceil(side), height.div_ceil(side));
        let mut values = vec![0.0; across * down * channels];
        let mut weights = vec![0.0; across * down];
        let rows = values.par_chunks_mut(across * channels).zip(weights.par_chunks_mut(across));
        rows.enumerate().for_each(|(row, (values, weights))| {
            for y in row * side..((row + 1) * side).min(height) {
                for x in 0..width {
                    let at = y * width + x;
                    if mask.is_some_and(|m| m.pixels[at] <= 0.5) {
                        continue;
                    }
                    let block = x / side;
                    weights[block] += 1.0;
                    for c in 0..channels {
                        let value =
                            |i: &Image| f64::from(i.pixels[at * channels + c].clamp(0.0, 1.0));
                        values[block * channels + c] += value(image) - value(truth);
                    }
                }
            }
            for (sums, weight) in values.chunks_exact_mut(channels).zip(weights.iter()) {
                sums.iter_mut().for_each(|sum| *sum /= f64::max(*weight, 1.0));
            }
        });
        Residuals { values, weights, channels }
    }

    /// Mean of the squares.
    fn cost(&self) -> f64 {
        let squares = self.values.chunks_exact(self.channels).zip(&self.weights);
        let sum: f64 =
            squares.map(|(block, weight)| weight * block.iter().map(|v| v * v).sum::<f64>()).sum();
        sum / (self.weights.iter().sum::<f64>() * self.channels as f64)
    }
}

/// JᵀWJ and JᵀWr, with the columns of J as finite differences over `step`.
fn normal_equations(
    here: &Residuals,
    columns: &[Residuals],
    step: f64,
) -> (SMatrix<f64, 6, 6>, Vector6) {
    let (mut hessian, mut gradient) = (SMatrix::<f64, 6, 6>::zeros(), Vector6::zeros());
    for (i, value) in here.values.iter().enumerate() {
        let weight = here.weights[i / here.channels];
        let row = Vector6::from_fn(|k, _| (columns[k].values[i] - value) / step);
        hessian += weight * row * row.transpose();
        gradient += weight * value * row;
    }
    (hessian, gradient)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::se3::exp;
    use crate::types::Intrinsics;
    use glam::DVec3;

    /// A camera's view of a wavy, coloured relief around z = 4.
    fn relief(camera: &Camera) -> Image {
        let k = camera.intrinsics;
        let mut image = Image::new(k.width, k.height, 3);
        let world_from_view = camera.view_from_world.inverse();
        for y in 0..k.height {
            for x in 0..k.width {
                let pixel = glam::DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
                let ray = world_from_view.rotation * k.ray(pixel);
                let origin = world_from_view.translation;
                let height = |p: DVec3| 4.0 + 0.5 * (1.3 * p.x).sin() * (1.1 * p.y).cos();
                let mut depth = 4.0;
                for _ in 0..20 {
                    depth = (height(origin + ray * depth) - origin.z) / ray.z;
                }
                let p = origin + ray * depth;
                // Coarse and fine waves, as in natural images: fine waves alone repeat within a few pixels.
                let wave = |a: f64, b: f64| {
                    let along = a * p.x + b * p.y;
                    (0.5 + 0.3 * along.sin() + 0.1 * (4.3 * along).sin()) as f32
                };
                let colour = [wave(1.9, 0.4), wave(-0.6, 2.1), wave(1.7, -1.5)];
                image.at_mut(x, y).copy_from_slice(&colour);
            }
        }
        image
    }

    fn camera() -> Camera {
        Camera { intrinsics: Intrinsics::centred(100.0, 128, 96), view_from_world: Pose::IDENTITY }
    }

    #[test]
    fn a_pose_is_found_from_its_picture() {
        let truth = relief(&camera());
        let off = exp(&Twist::new(0.08, -0.05, 0.06, 0.01, 0.02, -0.015));
        let start = Camera { view_from_world: off, ..camera() };
        let found = fit_pose(&start, 4.0, &truth, None, |c| Ok(relief(c))).unwrap();
        let found_from_true = found.view_from_world;
        assert!(found.after < 1e-3 * found.before, "{found:?}");
        // On a shallow relief an upward shift and a downward rotation nearly cancel: 0.3 pixels of each.
        assert!(found_from_true.translation.length() < 2e-2, "{found:?}");
        let angle = crate::geometry::se3::log_so3(found_from_true.rotation).length();
        assert!(angle < 5e-3, "{angle} rad");
        assert!(found.renders < 200, "{}", found.renders);
    }

    #[test]
    fn masked_pixels_have_no_say_and_worse_is_not_taken() {
        let start = camera();
        let mut truth = relief(&start);
        let mut mask = Image::new(128, 96, 1);
        for y in 0..96 {
            for x in 0..128 {
                match x < 80 {
                    true => mask.at_mut(x, y).fill(1.0),
                    false => truth.at_mut(x, y).fill(0.0),
                }
            }
        }
        let found = fit_pose(&start, 4.0, &truth, Some(&mask), |c| Ok(relief(c))).unwrap();
        assert_eq!((found.before, found.after), (0.0, 0.0));
        assert!(found.view_from_world.translation.length() < 1e-9, "{found:?}");
        let all = fit_pose(&start, 4.0, &truth, None, |c| Ok(relief(c))).unwrap();
        assert!(all.after <= all.before && all.before > 0.0);
        let flat = Image::new(128, 96, 3);
        let stays = fit_pose(&start, 4.0, &flat, None, |_| Ok(Image::new(128, 96, 3))).unwrap();
        assert_eq!(stays.view_from_world, start.view_from_world);
    }

    #[test]
    fn bad_input_is_named() {
        let (truth, start) = (relief(&camera()), camera());
        let fit = |depth, mask: Option<&Image>| {
            fit_pose(&start, depth, &truth, mask, |c| Ok(relief(c))).map(drop)
        };
        assert!(fit(0.0, None).is_err());
        assert!(fit(4.0, Some(&Image::new(128, 96, 1))).is_err());
        assert!(fit(4.0, Some(&Image::new(8, 8, 1))).is_err());
        let small = |_: &Camera| Ok(Image::new(8, 8, 3));
        assert!(fit_pose(&start, 4.0, &truth, None, small).is_err());
    }
}
