//! Cameras and depth of a clip from the pointmaps of its pairs of frames: the global alignment of DUSt3R
//! (Wang et al., CVPR 2024, section 3.3).
//!
//! The unknowns are the pose of each frame, its depth at the points of a grid, one focal length, and a
//! scale factor per pair. The points of a pair are in the camera frame of its first frame. For each map,
//! its points, multiplied by the pair's factor and transformed into the frame whose pixels they belong to,
//! should lie at that frame's depth on the rays of the pixels. The residual is the deviation relative to
//! that depth. Its cost is weighted by the logarithm of the confidence and grows linearly instead of
//! quadratically, so that wrong parts of the maps have bounded influence. Because the residual is relative,
//! shrinking everything does not lower the cost; DUSt3R excludes this with a constraint on the factors.
//!
//! DUSt3R gives each pair a pose of its own and runs 300 steps of gradient descent over whole maps. By
//! definition of the network, the points of a pair are in the camera frame of its first frame, so this
//! implementation uses that frame's pose. It eliminates the depths with a Schur complement, so that
//! iteratively reweighted Gauss–Newton needs a few steps (`solve`). The initial estimate has closed forms
//! (`start`): focal lengths from Weiszfeld's iterations, and similarities of pairs from their common
//! pixels, joined along the maximum spanning tree. Time is linear in the number of pairs.

mod solve;
mod start;
#[cfg(test)]
mod tests;

use glam::{DVec2, DVec3};

use super::pointmaps::{Pair, Pointmaps, quantile};
use crate::types::{Image, Intrinsics, Pose};
use crate::{Error, Result};

/// Cameras and depth scales that were estimated from pointmaps.
#[derive(Clone, Debug)]
pub struct Aligned {
    /// World-to-camera pose per frame. The first camera is the world frame, and the median depth is the
    /// unit of length.
    pub view_from_world: Vec<Pose>,
    /// Focal length in pixels of the frames.
    pub focal: f64,
    /// Relative standard deviation of the focal length, from its variation between frames and from `off`; 0
    /// where the focal length was known.
    pub focal_deviation: f64,
    /// Factor per frame that converts its depth ([`Pointmaps::into_depth`]) to the world's unit.
    pub depth_factors: Vec<f64>,
    /// Median deviation of the points, relative to their depth.
    pub off: f64,
}

/// Pairs with fewer points in common than this are not used.
const LEAST: usize = 12;
/// Bounds of the robust cost's threshold; the threshold is the median relative deviation, below which the
/// cost is quadratic.
const CLOSE: [f64; 2] = [1e-3, 0.1];

/// The unknowns of the alignment.
#[derive(Clone, Debug)]
struct State {
    /// World to camera, per frame.
    poses: Vec<Pose>,
    focal: f64,
    /// Logarithm of each pair's scale factor.
    scales: Vec<f64>,
    /// Inverse depth per frame and grid point; 0 where unknown.
    inverse: Vec<Vec<f64>>,
    /// Relative deviation below which the cost is quadratic.
    close: f64,
}

/// The maps that constrain a frame's depth: index of the pair, and which of its two views the frame is.
type Told = Vec<(usize, usize)>;

/// The pairs that are used, and the quantities that stay constant.
struct Problem<'a> {
    pairs: Vec<&'a Pair>,
    /// Pixel offsets of the grid points from the image centre.
    offsets: Vec<DVec2>,
    /// The maps of each frame.
    told: Vec<Told>,
    /// Whether the focal length is fixed.
    held: bool,
}

impl<'a> Problem<'a> {
    /// Builds the problem from the pairs that have enough points.
    fn new(maps: &'a Pointmaps, held: bool) -> Problem<'a> {
        // A pair is used in both directions or not at all.
        let used = maps.pairs.chunks_exact(2).filter(|both| {
            both.iter().all(|pair| {
                pair.views.iter().all(|v| v.weights.iter().filter(|w| **w > 0.0).count() >= LEAST)
            })
        });
        let pairs: Vec<&Pair> = used.flatten().collect();
        let middle = maps.placement.middle();
        let mut told = vec![Told::new(); maps.frames];
        for (e, pair) in pairs.iter().enumerate() {
            (0..2).for_each(|k| told[pair.frames[k]].push((e, k)));
        }
        let offsets = maps.pixels.iter().map(|pixel| *pixel - middle).collect();
        Problem { pairs, offsets, told, held }
    }

    /// The point at depth 1 on the ray of a grid point.
    fn ray(&self, place: usize, focal: f64) -> DVec3 {
        (self.offsets[place] / focal).extend(1.0)
    }

    /// Transform of a pair's points, after scaling by their factor, into the camera of one of its frames.
    fn view_from_pair(&self, state: &State, (e, k): (usize, usize)) -> Pose {
        let [first, second] = self.pairs[e].frames;
        match k {
            0 => Pose::IDENTITY,
            _ => state.poses[second] * state.poses[first].inverse(),
        }
    }
}

/// Aligns the pointmaps of a clip. A known `focal` length, in pixels of the frames, is kept fixed.
///
/// # Errors
/// The confident points determine no focal length, or do not connect every frame to every other one.
pub fn align(maps: &Pointmaps, focal: Option<f64>) -> Result<Aligned> {
    let problem = Problem::new(maps, focal.is_some());
    if problem.pairs.is_empty() {
        return Err(Error::Failed(
            "the pointmaps are not believed by their own network: hardly a point has a confidence above 1.1".into(),
        ));
    }
    let (told, spread) = match focal {
        Some(focal) => (focal, 0.0),
        None => start::focal(&problem).ok_or_else(|| {
            Error::Failed("the pointmaps tell no focal length: all points lie on one ray".into())
        })?,
    };
    let mut state = start::start(&problem, told)?;
    let off = solve::solve(&problem, &mut state);
    let known = state.inverse.iter().flatten().filter(|inverse| **inverse > 0.0);
    let unit = quantile(known.map(|inverse| inverse.recip()).collect(), 0.5);
    let (width, height) = maps.placement.frame;
    let sane = unit > 0.0 && Intrinsics::centred(state.focal, width, height).check().is_ok();
    if !sane || state.poses.iter().any(|pose| pose.check().is_err()) {
        return Err(Error::Failed(
            "the pointmaps of the clip's pairs contradict each other".into(),
        ));
    }
    let world_from_first = state.poses[0].inverse();
    for pose in &mut state.poses {
        *pose = *pose * world_from_first;
        pose.translation /= unit;
    }
    let factor = |(inverse, map): (&Vec<f64>, &Image)| {
        let at = |(inverse, pixel): (&f64, &DVec2)| {
            let (x, y) = (pixel.x as u32, pixel.y as u32);
            let inside = x < map.width && y < map.height && *inverse > 0.0;
            let ratio = inside.then(|| (inverse * unit * f64::from(map.at(x, y)[0])).recip())?;
            ratio.is_finite().then_some(ratio)
        };
        let ratios: Vec<f64> = inverse.iter().zip(&maps.pixels).filter_map(at).collect();
        if ratios.is_empty() { 1.0 } else { quantile(ratios, 0.5) }
    };
    let depth_factors = state.inverse.iter().zip(&maps.depth).map(factor).collect();
    // A bias common to all frames does not show in their spread, so the disagreement between pairs is added.
    let focal_deviation = if focal.is_some() { 0.0 } else { spread.hypot(off) };
    let State { poses, focal, .. } = state;
    Ok(Aligned { view_from_world: poses, focal, focal_deviation, depth_factors, off })
}
