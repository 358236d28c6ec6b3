//! Where the points of a moving object are at every frame: what control points start from.
//!
//! Point tracks on movers are lifted to the world by the frames' depth. A control point goes with
//! its own track while that lives, and beyond with the tracks that are nearest to it at the time.

use crate::observe::PointTrack;
use crate::track::Track;
use crate::types::{Camera, Image};
use glam::{DVec2, DVec3};
use rayon::prelude::*;

/// Above this a pixel of a mask counts as moving.
pub(super) const MOVING: f32 = 0.5;
/// Tracks that a point without one of its own goes with.
const COMPANIONS: usize = 4;
/// Standard deviation of the smoothing over time, frames: depth on movers is inferred frame by
/// frame and trembles.
const SMOOTHING: f64 = 1.0;

/// Points of movers through all frames, in the world.
pub(super) struct Trajectories {
    /// The frame whose positions are the canonical ones.
    pub(super) canonical: usize,
    /// By point, then by frame.
    pub(super) positions: Vec<Vec<DVec3>>,
}

/// The camera of a frame.
pub(super) fn camera(track: &Track, frame: usize) -> Camera {
    Camera { intrinsics: track.intrinsics, view_from_world: track.view_from_world[frame] }
}

/// The point in the world that a pixel shows.
pub(super) fn lift(track: &Track, frame: usize, pixel: DVec2) -> DVec3 {
    let z = f64::from(value(&track.depth[frame], pixel));
    let view = track.intrinsics.ray(pixel) * z;
    track.view_from_world[frame].inverse().apply(view)
}

/// The value of a one-channel image at the pixel that holds a position.
pub(super) fn value(image: &Image, pixel: DVec2) -> f32 {
    let x = (pixel.x.max(0.0) as u32).min(image.width - 1);
    let y = (pixel.y.max(0.0) as u32).min(image.height - 1);
    image.at(x, y)[0]
}

/// The frame that shows most of the movers, the one nearest to the middle among the good ones: from
/// there motion has to reach least far.
fn canonical_frame(masks: &[Image]) -> usize {
    let area = |mask: &Image| mask.pixels.iter().filter(|&&m| m > MOVING).count();
    let areas: Vec<usize> = masks.iter().map(area).collect();
    let most = areas.iter().copied().max().unwrap_or(0);
    let middle = masks.len() / 2;
    (0..masks.len())
        .filter(|&frame| areas[frame] * 10 >= most * 7)
        .min_by_key(|&frame| frame.abs_diff(middle))
        .unwrap_or(middle)
}

/// Tracks on movers, lifted: by track, the first frame and the positions.
fn lifted(track: &Track) -> Vec<(usize, Vec<DVec3>)> {
    let moving = |t: &PointTrack| {
        let on = t.pixels.iter().enumerate();
        let on = on.filter(|(k, p)| value(&track.masks[t.first + k], **p) > MOVING).count();
        on * 2 > t.pixels.len()
    };
    track
        .tracks
        .iter()
        .filter(|t| moving(t))
        .map(|t| {
            let lift = |(k, p): (usize, &DVec2)| lift(track, t.first + k, *p);
            (t.first, t.pixels.iter().enumerate().map(lift).collect())
        })
        .collect()
}

impl Trajectories {
    /// Follows every track on a mover that lives in the canonical frame through the whole clip.
    pub(super) fn of(track: &Track) -> Trajectories {
        let frames = track.masks.len();
        let canonical = canonical_frame(&track.masks);
        let lifted = lifted(track);
        let at = |t: &(usize, Vec<DVec3>), frame: usize| {
            frame.checked_sub(t.0).and_then(|k| t.1.get(k)).copied()
        };
        let positions = lifted
            .par_iter()
            .filter_map(|own| {
                let start = at(own, canonical)?;
                let mut path = vec![start; frames];
                let mut walk = |from: usize, to: usize| {
                    let here = path[from];
                    let step = match (at(own, from), at(own, to)) {
                        (Some(a), Some(b)) => b - a,
                        _ => companions_step(&lifted, here, from, to),
                    };
                    path[to] = here + step;
                };
                (canonical + 1..frames).for_each(|frame| walk(frame - 1, frame));
                (0..canonical).rev().for_each(|frame| walk(frame + 1, frame));
                Some(smoothed(&path, canonical))
            })
            .collect();
        Trajectories { canonical, positions }
    }

    /// The trajectory that is nearest to a point at a frame.
    pub(super) fn nearest(&self, frame: usize, point: DVec3) -> Option<&Vec<DVec3>> {
        let distance = |path: &&Vec<DVec3>| path[frame].distance_squared(point);
        self.positions.iter().min_by(|a, b| distance(a).total_cmp(&distance(b)))
    }
}

/// The mean step of the tracks nearest to a place; none where no track spans the two frames.
fn companions_step(lifted: &[(usize, Vec<DVec3>)], here: DVec3, from: usize, to: usize) -> DVec3 {
    let mut near: Vec<(f64, DVec3)> = lifted
        .iter()
        .filter_map(|(first, path)| {
            let a = path.get(from.checked_sub(*first)?)?;
            let b = path.get(to.checked_sub(*first)?)?;
            Some((a.distance_squared(here), *b - *a))
        })
        .collect();
    near.sort_by(|a, b| a.0.total_cmp(&b.0));
    near.truncate(COMPANIONS);
    let count = near.len().max(1) as f64;
    near.into_iter().map(|(_, step)| step).sum::<DVec3>() / count
}

/// A Gaussian window over time, of displacements from the canonical frame, which stays in place.
fn smoothed(path: &[DVec3], canonical: usize) -> Vec<DVec3> {
    let reach = (3.0 * SMOOTHING).ceil() as usize;
    let mean = |frame: usize| {
        let (mut sum, mut weight) = (DVec3::ZERO, 0.0);
        let last = (frame + reach).min(path.len() - 1);
        for (other, &position) in path.iter().enumerate().take(last + 1).skip(frame.saturating_sub(reach)) {
            let d = frame.abs_diff(other) as f64 / SMOOTHING;
            let w = (-0.5 * d * d).exp();
            sum += w * position;
            weight += w;
        }
        sum / weight
    };
    let shift = path[canonical] - mean(canonical);
    (0..path.len()).map(|frame| mean(frame) + shift).collect()
}
