//! Cameras and depth of a clip from the pointmaps of its pairs of frames: the global alignment of DUSt3R (Wang et al.,
//! CVPR 2024, section 3.3).
//!
//! Unknown are each frame's pose and its depth at the places of a grid, one focal length, and a factor for each pair,
//! whose points are in the camera of its first frame. Each map asks that its points, times the pair's factor and
//! seen from the frame whose pixels they belong to, lie at that frame's depth on the pixels' rays. By how much they
//! are off relative to that depth counts by the logarithm of the confidence, and not squared, so that what is wrong
//! in a part of the maps does not pull. Being relative, it does not fall by making everything small, which DUSt3R
//! excludes by a condition on the factors.
//!
//! DUSt3R gives each pair a pose of its own and descends along the gradient for 300 steps over whole maps. A pair's points are
//! in the camera of its first frame by the network's definition, so here they keep it, and depths are eliminated
//! (Schur complement), so that Gauss–Newton, reweighted, needs a few steps (`solve`). The start is closed: focal
//! lengths by Weiszfeld's iterations, similarities of pairs by their common pixels, joined along the
//! maximum spanning tree (`start`). Time is linear in the number of pairs.

mod solve;
mod start;
#[cfg(test)]
mod tests;

use glam::{DVec2, DVec3};

use super::pointmaps::{Pair, Pointmaps, quantile};
use crate::types::{Image, Intrinsics, Pose};
use crate::{Error, Result};

/// Cameras that pointmaps tell.
#[derive(Clone, Debug)]
pub struct Aligned {
    /// World to camera, per frame. The first camera is the world, the median depth its unit.
    pub view_from_world: Vec<Pose>,
    /// In pixels of the frames.
    pub focal: f64,
    /// Relative standard deviation of the focal length, by how much frames differ in it and by `off`; 0 where it was
    /// known.
    pub focal_deviation: f64,
    /// By what the depth of each frame ([`Pointmaps::into_depth`]) is to be multiplied to be in the world's unit.
    pub depth_factors: Vec<f64>,
    /// By how much half of the points are off at least, relative to their depth.
    pub off: f64,
}

/// A pair with fewer points in common is not used.
const LEAST: usize = 12;
/// What is off by less than half of the points are counts squared, within these bounds.
const CLOSE: [f64; 2] = [1e-3, 0.1];

/// What is being looked for.
#[derive(Clone, Debug)]
struct State {
    /// World to camera.
    poses: Vec<Pose>,
    focal: f64,
    /// Of each pair: the logarithm of its factor.
    scales: Vec<f64>,
    /// Inverse depth per frame and place of the grid; 0 where nothing is known.
    inverse: Vec<Vec<f64>>,
    /// What is off by less than this, relative to its depth, counts squared.
    close: f64,
}

/// What a frame's depth is told by: pairs, and which of their two views the frame is.
type Told = Vec<(usize, usize)>;

/// The pairs that are used, and what does not change.
struct Problem<'a> {
    pairs: Vec<&'a Pair>,
    /// Of the grid's places, from the middle of the picture.
    offsets: Vec<DVec2>,
    /// Per frame.
    told: Vec<Told>,
    /// The focal length is kept.
    held: bool,
}

impl<'a> Problem<'a> {
    /// Of the pairs that have enough points.
    fn new(maps: &'a Pointmaps, held: bool) -> Problem<'a> {
        // Both ways or none.
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

    /// The point at depth 1 on the ray of a place of the grid.
    fn ray(&self, place: usize, focal: f64) -> DVec3 {
        (self.offsets[place] / focal).extend(1.0)
    }

    /// What a pair's points are mapped by into the camera of one of its frames, but for their factor.
    fn view_from_pair(&self, state: &State, (e, k): (usize, usize)) -> Pose {
        let [first, second] = self.pairs[e].frames;
        match k {
            0 => Pose::IDENTITY,
            _ => state.poses[second] * state.poses[first].inverse(),
        }
    }
}

/// Aligns the pointmaps of a clip. `focal` is kept where it is known, pixels of the frames.
///
/// # Errors
/// Points that are believed lead to no focal length, or not from each frame to each other one.
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
    // All frames may be wrong alike; only points that are right agree between pairs, too.
    let focal_deviation = if focal.is_some() { 0.0 } else { spread.hypot(off) };
    let State { poses, focal, .. } = state;
    Ok(Aligned { view_from_world: poses, focal, focal_deviation, depth_factors, off })
}
