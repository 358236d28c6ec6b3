//! Focal length, poses and sparse points of the static world.

use std::collections::HashMap;
use std::ops::Range;

use glam::{DVec2, DVec3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::observer::Work;
use super::still::{relate, shared};
use super::{FocalSource, Options, Stage, intrinsics_size, quantile};
use crate::geometry::bundle::{self, FocalMode, Observation, Point, Problem, adjust};
use crate::geometry::focal::{FocalPair, estimate_focal};
use crate::geometry::pnp::{PnpOptions, pnp_ransac};
use crate::geometry::ransac::RansacOptions;
use crate::geometry::triangulate::inverse_depth;
use crate::geometry::two_view::{Motion, TwoView, fundamental_ransac};
use crate::observe::{NeighbourFlow, PointTrack};
use crate::types::{Intrinsics, Pose};
use crate::{Error, Result};

/// The focal length to begin with, and what may be done with it.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct Focal {
    pub intrinsics: Intrinsics,
    pub source: FocalSource,
    pub deviation: f64,
}

/// A focal length that nobody tells, as a multiple of the longer side: phones film at 0.75 to 1.1,
/// and video stabilisation crops.
const ASSUMED: f64 = 1.0;
/// Relative standard deviation of that guess.
const ASSUMED_DEVIATION: f64 = 0.25;
/// The adjustment measures the focal length if it can to this relative standard deviation.
const MEASURABLE: f64 = 0.05;

impl Focal {
    /// What was given; else what image pairs tell; else a common value.
    pub fn choose(
        options: &Options,
        flow: &NeighbourFlow,
        tracks: &[PointTrack],
        weights: &[f64],
    ) -> Focal {
        let (w, h) = intrinsics_size(flow);
        let given = options.intrinsics.or(options.focal.map(|f| Intrinsics::centred(f, w, h)));
        if let Some(intrinsics) = given {
            return Focal { intrinsics, source: FocalSource::Given, deviation: 0.0 };
        }
        let n = flow.frames;
        let gaps = [n / 8, n / 5, n / 3].map(|g| g.clamp(1, n - 1));
        let ends: Vec<(usize, usize)> = gaps
            .iter()
            .flat_map(|&gap| (0..n - gap).step_by(gap).map(move |a| (a, a + gap)))
            .collect();
        let threshold = (f64::from(w) / 320.0).max(0.7);
        let ransac = RansacOptions { threshold, seed: options.seed, ..Default::default() };
        let pairs: Vec<FocalPair> = ends
            .par_iter()
            .filter_map(|&pair| {
                let s = shared(tracks, weights, pair, 500);
                let pixels: Vec<_> = s.a.into_iter().zip(s.b).collect();
                let found = fundamental_ransac(&pixels, &ransac)?;
                let inliers: Vec<_> = found.inliers.iter().map(|&i| pixels[i]).collect();
                (inliers.len() >= 50)
                    .then_some(FocalPair { fundamental: found.model, pixels: inliers })
            })
            .collect();
        let side = f64::from(w.max(h));
        let estimate = estimate_focal(&pairs, w, h, &Default::default()).ok();
        match estimate.filter(|e| e.observable) {
            Some(e) => Focal {
                intrinsics: Intrinsics::centred(e.focal, w, h),
                source: FocalSource::Measured,
                deviation: e.relative_std,
            },
            None => Focal {
                intrinsics: Intrinsics::centred(ASSUMED * side, w, h),
                source: FocalSource::Assumed,
                deviation: f64::INFINITY,
            },
        }
    }
}

/// Where a track's point lies along the ray of one of its pixels.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub(super) struct Anchor {
    pub frame: usize,
    pub inverse_depth: f64,
}

/// A track's point in a frame.
struct View {
    /// One over the variance of the pixel along each axis.
    known: f64,
    /// From where it is seen to where it should be, pixels.
    off: DVec2,
    /// How the latter changes with the inverse depth.
    per_inverse_depth: DVec2,
}

/// How well the point of a track is known.
#[derive(Clone, Copy, Debug)]
pub(super) struct Certainty {
    /// Standard deviation of its depth relative to the depth, as far as the deviations of the track's
    /// pixels are right.
    pub deviation: f64,
    /// Root mean square of its residuals' coordinates, in those deviations.
    pub residual: f64,
}

/// Poses of all frames, and an inverse depth for each track that has one.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct Cameras {
    pub intrinsics: Intrinsics,
    pub focal_source: FocalSource,
    pub focal_std: f64,
    /// `view_from_world`.
    pub poses: Vec<Pose>,
    /// Per track: a frame that it lives in, and 1 / z there.
    pub anchors: Vec<Option<Anchor>>,
    /// Frames whose pose is a guess.
    pub doubtful: Vec<usize>,
    pub inlier_share: f64,
    pub rms: f64,
    /// All poses are one.
    pub fixed: bool,
    /// Poses were supplied: only structure and focal length are adjusted.
    supplied: bool,
}

/// The scale of residuals is not taken below this, pixels, and deviations.
const SCALE_FLOOR: f64 = 0.1;
const DEVIATION_FLOOR: f64 = 0.5;
/// A residual of this square, in deviations, is explained by half.
const EXPLAINS: f64 = 9.0;
/// A point is seen to so many pixels along each axis, where it is followed without an error.
const DEVIATION: f64 = 0.05;

/// How much an observation counts beside one that is followed without an error.
fn information(deviation: f32) -> f64 {
    DEVIATION.powi(2) / (DEVIATION.powi(2) + f64::from(deviation).powi(2))
}
/// Most points of an adjustment on the way, and of the last one.
const POINTS: (usize, usize) = (900, 4000);

impl Cameras {
    /// The camera of a tripod.
    pub fn fixed(focal: &Focal, flow: &NeighbourFlow, tracks: usize) -> Cameras {
        Cameras { fixed: true, ..Cameras::new(focal, flow.frames, tracks) }
    }

    /// Measures how well the static tracks of a fixed camera stay in place, as an adjustment does for
    /// one that moves: what is seen at a pixel once is seen there in every frame.
    pub fn measure_fixed(&mut self, tracks: &[PointTrack], weights: &[f64]) {
        // Length and weight of each observation besides a track's first.
        let residuals: Vec<(DVec2, f64)> = tracks
            .iter()
            .zip(weights)
            .filter(|(_, weight)| **weight > 0.05)
            .flat_map(|(track, weight)| {
                let observed = track.pixels.iter().zip(&track.deviation).skip(1);
                observed.map(move |(pixel, deviation)| {
                    (*pixel - track.pixels[0], weight * information(*deviation))
                })
            })
            .collect();
        let coordinates = residuals.iter().flat_map(|(r, _)| [r.x.abs(), r.y.abs()]).collect();
        let limit = bundle::Options::default().kernel_width
            * (1.4826 * quantile(coordinates, 0.5)).max(SCALE_FLOOR);
        let (mut inliers, mut sum, mut total) = (0usize, 0.0, 0.0);
        for (residual, weight) in residuals.iter().filter(|(r, _)| r.length() <= limit) {
            inliers += 1;
            sum += weight * residual.length_squared();
            total += weight;
        }
        self.inlier_share = inliers as f64 / residuals.len().max(1) as f64;
        self.rms = if total > 0.0 { (sum / total).sqrt() } else { 0.0 };
    }

    /// Cameras that a unit test knows.
    #[cfg(test)]
    pub fn known(intrinsics: Intrinsics, poses: Vec<Pose>) -> Cameras {
        let focal = Focal { intrinsics, source: FocalSource::Given, deviation: 0.0 };
        Cameras { poses, ..Cameras::new(&focal, 0, 0) }
    }

    fn new(focal: &Focal, frames: usize, tracks: usize) -> Cameras {
        Cameras {
            intrinsics: focal.intrinsics,
            focal_source: focal.source,
            focal_std: focal.deviation,
            poses: vec![Pose::IDENTITY; frames],
            anchors: vec![None; tracks],
            doubtful: Vec::new(),
            inlier_share: 0.0,
            rms: 0.0,
            fixed: false,
            supplied: false,
        }
    }

    /// Cameras that the user knows.
    ///
    /// # Errors
    /// Those of the adjustment.
    pub fn supplied(
        poses: &[Pose],
        focal: &Focal,
        tracks: &[PointTrack],
        weights: &[f64],
    ) -> Result<Cameras> {
        let mut cameras = Cameras {
            poses: poses.to_vec(),
            supplied: true,
            ..Cameras::new(focal, poses.len(), tracks.len())
        };
        cameras.adjust(tracks, weights, focal)?;
        Ok(cameras)
    }

    /// Adjusts everything to all static tracks.
    ///
    /// # Errors
    /// No track that counts, or an adjustment that ran off.
    pub fn adjust(&mut self, tracks: &[PointTrack], weights: &[f64], focal: &Focal) -> Result<()> {
        let posed = vec![true; self.poses.len()];
        self.triangulate(tracks, weights, &posed, true);
        let mode = match focal.source {
            FocalSource::Given => FocalMode::Fixed,
            _ => FocalMode::Gated(MEASURABLE),
        };
        let report = self.solve(tracks, weights, &posed, mode, POINTS.1, 4)?;
        if focal.source != FocalSource::Given {
            self.focal_std = report.focal_std.min(focal.deviation);
            if report.focal_released {
                self.focal_std = report.focal_std;
                self.focal_source = FocalSource::Measured;
            }
        }
        self.inlier_share = report.inlier_ratio;
        self.rms = report.inlier_rmse;
        Ok(())
    }

    /// Gives inverse depths to static tracks that are seen by frames with poses; `afresh` also to
    /// those that have one. Points that movers may have left are kept out by asking three views to
    /// agree.
    fn triangulate(
        &mut self,
        tracks: &[PointTrack],
        weights: &[f64],
        posed: &[bool],
        afresh: bool,
    ) {
        let tolerance = 1.5 * (f64::from(self.intrinsics.width) / 320.0).max(1.0);
        let found: Vec<Option<Anchor>> = tracks
            .par_iter()
            .enumerate()
            .map(|(i, track)| {
                let known = self.anchors[i];
                if weights[i] <= 0.05 || (known.is_some() && !afresh) {
                    return known;
                }
                let seen: Vec<usize> = (track.first..track.end()).filter(|&f| posed[f]).collect();
                if seen.len() < 3 {
                    return known;
                }
                let frame = known.map_or(seen[0], |a| a.frame);
                let reference = self.poses[frame].inverse();
                let views: Vec<_> = seen
                    .iter()
                    .filter(|&&f| f != frame)
                    .map(|&f| {
                        let k = f - track.first;
                        let weight = information(track.deviation[k]);
                        (self.poses[f] * reference, track.pixels[k], weight)
                    })
                    .collect();
                let pixel = track.pixels[frame - track.first];
                let d = inverse_depth(&self.intrinsics, pixel, &views, tolerance)?;
                // Without parallax a depth is noise that would pull at the next pose.
                let certain = d.deviation < 0.5 * d.value.max(1e-9) || d.deviation < 1e-3;
                (d.rmse < tolerance && (certain || afresh))
                    .then_some(Anchor { frame, inverse_depth: d.value })
            })
            .collect();
        self.anchors = found;
    }

    /// One bundle adjustment over the frames with poses, on up to `most` tracks that cover all
    /// frames and places evenly.
    fn solve(
        &mut self,
        tracks: &[PointTrack],
        weights: &[f64],
        posed: &[bool],
        focal: FocalMode,
        most: usize,
        rounds: usize,
    ) -> Result<bundle::Report> {
        let places: Vec<usize> = (0..posed.len()).filter(|&f| posed[f]).collect();
        let mut place_of = vec![usize::MAX; posed.len()];
        places.iter().enumerate().for_each(|(place, &f)| place_of[f] = place);
        let chosen = self.choose(tracks, weights, posed, most);
        let mut problem = Problem {
            intrinsics: self.intrinsics,
            poses: places.iter().map(|&f| self.poses[f]).collect(),
            fixed: places.iter().map(|_| self.supplied).collect(),
            points: Vec::with_capacity(chosen.len()),
            observations: Vec::new(),
        };
        if let Some(first) = problem.fixed.first_mut() {
            *first = true;
        }
        for &i in &chosen {
            let track = &tracks[i];
            let Some(Anchor { frame, inverse_depth }) = self.anchors[i] else { continue };
            let point = problem.points.len();
            problem.points.push(Point {
                frame: place_of[frame],
                pixel: track.pixels[frame - track.first],
                inverse_depth,
                prior: None,
            });
            for f in track.first..track.end() {
                let k = f - track.first;
                if posed[f] && f != frame {
                    let since = track.deviation_between(frame - track.first, k);
                    problem.observations.push(Observation {
                        point,
                        frame: place_of[f],
                        pixel: track.pixels[k],
                        weight: weights[i],
                        deviation: DEVIATION.hypot(f64::from(since)),
                    });
                }
            }
        }
        let side = f64::from(self.intrinsics.width.max(self.intrinsics.height));
        let options = bundle::Options {
            focal,
            focal_prior: (self.focal_source == FocalSource::Assumed)
                .then_some((ASSUMED * side, ASSUMED_DEVIATION)),
            scale_floor: DEVIATION_FLOOR,
            rounds,
            ..Default::default()
        };
        let report = adjust(&mut problem, &options)?;
        for (place, &f) in places.iter().enumerate() {
            self.poses[f] = problem.poses[place];
        }
        for (point, &i) in problem.points.iter().zip(&chosen) {
            if let Some(anchor) = &mut self.anchors[i] {
                anchor.inverse_depth = point.inverse_depth;
            }
        }
        self.intrinsics = problem.intrinsics;
        Ok(report)
    }

    /// Tracks with a depth that see at least two posed frames besides their first, the long ones
    /// first, until each part of each frame has its share.
    fn choose(
        &self,
        tracks: &[PointTrack],
        weights: &[f64],
        posed: &[bool],
        most: usize,
    ) -> Vec<usize> {
        const COLUMNS: usize = 12;
        const ROWS: usize = 8;
        let (w, h) = (f64::from(self.intrinsics.width), f64::from(self.intrinsics.height));
        let cell = |p: DVec2| {
            let x = (p.x / w * COLUMNS as f64).clamp(0.0, COLUMNS as f64 - 1.0) as usize;
            let y = (p.y / h * ROWS as f64).clamp(0.0, ROWS as f64 - 1.0) as usize;
            y * COLUMNS + x
        };
        let views = |t: &PointTrack| (t.first..t.end()).filter(|&f| posed[f]).count() - 1;
        let mut order: Vec<(usize, usize)> = (0..tracks.len())
            .filter(|&i| weights[i] > 0.05 && self.anchors[i].is_some_and(|a| posed[a.frame]))
            .map(|i| (views(&tracks[i]), i))
            .filter(|(views, _)| *views >= 2)
            .collect();
        order.sort_by_key(|(views, i)| (std::cmp::Reverse(*views), *i));
        let frames = posed.iter().filter(|p| **p).count();
        let mean_views =
            order.iter().map(|o| o.0 + 1).sum::<usize>() as f64 / order.len().max(1) as f64;
        let share = (most as f64 * mean_views / (frames * COLUMNS * ROWS) as f64).ceil().max(2.0);
        let mut counts: HashMap<(usize, usize), usize> = HashMap::new();
        let mut chosen = Vec::new();
        for (views, i) in order {
            let track = &tracks[i];
            let cells: Vec<_> = (track.first..track.end())
                .filter(|&f| posed[f])
                .map(|f| (f, cell(track.pixels[f - track.first])))
                .collect();
            let open =
                cells.iter().filter(|c| (counts.get(c).copied().unwrap_or(0) as f64) < share);
            if 2 * open.count() > views {
                cells.into_iter().for_each(|c| *counts.entry(c).or_default() += 1);
                chosen.push(i);
                if chosen.len() == most {
                    break;
                }
            }
        }
        chosen.sort_unstable();
        chosen
    }

    /// The point of a track in the world.
    pub fn point(&self, tracks: &[PointTrack], i: usize) -> Option<DVec3> {
        let Anchor { frame, inverse_depth } = self.anchors[i].filter(|a| a.inverse_depth > 1e-9)?;
        let ray = self.intrinsics.ray(tracks[i].at(frame)?);
        Some(self.poses[frame].inverse().apply(ray / inverse_depth))
    }

    /// How well the pictures say how deep the point of a track lies.
    pub fn certainty(&self, tracks: &[PointTrack], i: usize) -> Option<Certainty> {
        let (mut information, mut squares, mut views) = (0.0, 0.0, 0.0);
        for view in self.reprojected(tracks, i)? {
            let View { known, off, per_inverse_depth } = view?;
            information += known * per_inverse_depth.length_squared();
            squares += known * off.length_squared();
            views += 1.0;
        }
        let inverse_depth = self.anchors[i]?.inverse_depth;
        (information > 0.0).then(|| Certainty {
            deviation: (inverse_depth * information.sqrt()).recip(),
            residual: (0.5 * squares / views).sqrt(),
        })
    }

    /// The share of what is seen of static tracks that the cameras explain: what is seen where it should
    /// be counts in full, what is far from there, or has no depth, not at all. Of two solutions the
    /// better one explains more.
    pub fn explained(&self, tracks: &[PointTrack], weights: &[f64]) -> f64 {
        // The adjustment has moved the cameras, and only the points that it chose.
        let mut cameras = self.clone();
        cameras.triangulate(tracks, weights, &vec![true; self.poses.len()], true);
        let counted = (0..tracks.len()).into_par_iter().filter(|i| weights[*i] > 0.05);
        let of_track = |i: usize| {
            let near = |view: View| 1.0 / (1.0 + view.known * view.off.length_squared() / EXPLAINS);
            let views = cameras.reprojected(tracks, i);
            let explained: f64 = views.map_or(0.0, |views| views.flatten().map(near).sum());
            (weights[i] * explained, weights[i] * (tracks[i].pixels.len() - 1) as f64)
        };
        let counted: Vec<(f64, f64)> = counted.map(of_track).collect();
        let (explained, seen) =
            counted.iter().fold((0.0, 0.0), |sum, one| (sum.0 + one.0, sum.1 + one.1));
        if seen > 0.0 { explained / seen } else { 0.0 }
    }

    /// The point of a track in the frames that see it besides the one that it is anchored in; `None` in
    /// a frame that it lies behind.
    fn reprojected<'a>(
        &'a self,
        tracks: &'a [PointTrack],
        i: usize,
    ) -> Option<impl Iterator<Item = Option<View>> + 'a> {
        let Anchor { frame, inverse_depth } = self.anchors[i].filter(|a| a.inverse_depth > 1e-9)?;
        let track = &tracks[i];
        let pixel = track.at(frame)?;
        let anchor_from_world = self.poses[frame].inverse();
        let others = (track.first..track.end()).filter(move |f| *f != frame);
        Some(others.map(move |f| {
            let k = f - track.first;
            let relative = self.poses[f] * anchor_from_world;
            let found = bundle::project(&self.intrinsics, &relative, pixel, inverse_depth);
            let (seen, jacobian) = found?;
            let since = track.deviation_between(frame - track.first, k);
            Some(View {
                known: DEVIATION.hypot(f64::from(since)).powi(-2),
                off: seen - track.pixels[k],
                per_inverse_depth: jacobian.inverse_depth,
            })
        }))
    }

    /// Makes the median depth of the static points in the cameras that see them the unit, and the
    /// first camera the world.
    pub fn normalise(
        &mut self,
        tracks: &[PointTrack],
        weights: &[f64],
        seen: &mut [super::residual::Seen],
    ) {
        let mut depths = Vec::new();
        for i in (0..tracks.len()).filter(|&i| weights[i] > 0.5) {
            let Some(point) = self.point(tracks, i) else { continue };
            for f in tracks[i].first..tracks[i].end() {
                depths.push(self.poses[f].apply(point).z);
            }
        }
        depths.retain(|z| *z > 0.0 && z.is_finite());
        if depths.is_empty() {
            return;
        }
        let unit = quantile(depths, 0.5);
        let first = self.poses[0].inverse();
        for pose in &mut self.poses {
            *pose = *pose * first;
            pose.translation /= unit;
        }
        self.anchors.iter_mut().flatten().for_each(|a| a.inverse_depth *= unit);
        for frame in seen {
            frame.inverse_depth.iter_mut().for_each(|d| *d *= unit as f32);
            frame.deviation.iter_mut().for_each(|d| *d *= unit as f32);
        }
    }

    /// The median over the static tracks of the widest angle between their rays, radians.
    pub fn parallax(&self, tracks: &[PointTrack], weights: &[f64]) -> f64 {
        let angles = (0..tracks.len())
            .filter(|&i| weights[i] > 0.5 && tracks[i].pixels.len() > 2)
            .filter_map(|i| {
                let point = self.point(tracks, i)?;
                let to = |f: usize| (point - self.poses[f].inverse().translation).normalize();
                let (first, last) = (tracks[i].first, tracks[i].end() - 1);
                let middle = (first + last) / 2;
                let angle = |a: DVec3, b: DVec3| a.angle_between(b);
                Some(
                    angle(to(first), to(last))
                        .max(angle(to(first), to(middle)))
                        .max(angle(to(middle), to(last))),
                )
            })
            .collect();
        quantile(angles, 0.5)
    }
}

/// The pair to start from: many tracks, wide parallax, no plane.
fn start(
    tracks: &[PointTrack],
    weights: &[f64],
    k: &Intrinsics,
    frames: usize,
    seed: u64,
) -> Option<((usize, usize), TwoView, Vec<usize>)> {
    let gaps = [frames / 12, frames / 8, frames / 5, frames / 3, frames / 2];
    let mut gaps: Vec<usize> = gaps.iter().map(|g| (*g).clamp(1, frames - 1)).collect();
    gaps.dedup();
    let pairs: Vec<(usize, usize)> = gaps
        .iter()
        .flat_map(|&gap| {
            let step = (gap / 2).max(frames / 10).max(1);
            (0..frames - gap).step_by(step).map(move |a| (a, a + gap))
        })
        .collect();
    let living = pairs.iter().map(|p| shared(tracks, weights, *p, usize::MAX).tracks.len());
    let most = living.max()? as f64;
    pairs
        .par_iter()
        .filter_map(|&pair| {
            let all = shared(tracks, weights, pair, usize::MAX).tracks.len() as f64;
            let s = shared(tracks, weights, pair, 700);
            let found = relate(&s, k, seed).ok()?;
            if matches!(found.motion, Motion::Static | Motion::PureRotation) {
                return None;
            }
            let wide = found.parallax_deg / (found.parallax_deg + 2.0);
            let depth = 1.05 - found.homography_ratio.min(1.0);
            let score = found.inlier_ratio * (all / most).sqrt() * wide * depth.sqrt();
            Some((score, pair, found, s.tracks))
        })
        .max_by(|a, b| a.0.total_cmp(&b.0).then(b.1.cmp(&a.1)))
        .map(|(_, pair, found, tracks)| (pair, found, tracks))
}

/// Frames getting their poses one by one.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct Posing {
    cameras: Cameras,
    /// Per frame: it has its pose.
    posed: Vec<bool>,
    /// How many had when all were last adjusted.
    adjusted: usize,
}

/// The start from two frames.
///
/// # Errors
/// No pair of frames shows parallax.
fn begin(
    tracks: &[PointTrack],
    weights: &[f64],
    focal: &Focal,
    n: usize,
    seed: u64,
) -> Result<Posing> {
    let k = focal.intrinsics;
    let Some(((a, b), found, ids)) = start(tracks, weights, &k, n, seed) else {
        return Err(Error::Input(
            "no two frames of this video show parallax that one moving camera explains; film while \
             walking or moving the camera sideways, or supply poses"
                .into(),
        ));
    };
    let mut cameras = Cameras::new(focal, n, tracks.len());
    let mut posed = vec![false; n];
    (posed[a], posed[b]) = (true, true);
    cameras.poses[b] = found.b_from_a;
    for (&i, _) in ids.iter().zip(&found.inliers).filter(|(_, inlier)| **inlier) {
        let (Some(pa), Some(pb)) = (tracks[i].at(a), tracks[i].at(b)) else { continue };
        if let Some(d) = inverse_depth(&k, pa, &[(found.b_from_a, pb, 1.0)], 1.0)
            && d.value > 1e-6
            && d.deviation < d.value
        {
            cameras.anchors[i] = Some(Anchor { frame: a, inverse_depth: d.value });
        }
    }
    Ok(Posing { cameras, posed, adjusted: 2 })
}

/// Cameras from tracks alone: a start from two frames, then frame by frame by PnP, adjusted on the
/// way and all together at the end. `part` is the name under which the way there is kept.
///
/// # Errors
/// No pair of frames shows parallax; too few static points; what the observer of `work` returns.
pub(super) fn reconstruct(
    tracks: &[PointTrack],
    weights: &[f64],
    focal: &Focal,
    frames: usize,
    seed: u64,
    work: &mut Work,
    part: &str,
) -> Result<Cameras> {
    let posing = pose(tracks, weights, focal, frames, seed, work, part)?;
    posing.adjusted(tracks, weights, focal)
}

impl Posing {
    /// The cameras, adjusted to all static tracks.
    ///
    /// # Errors
    /// A frame without a pose; those of the adjustment.
    pub(super) fn adjusted(
        self,
        tracks: &[PointTrack],
        weights: &[f64],
        focal: &Focal,
    ) -> Result<Cameras> {
        let Posing { mut cameras, posed, .. } = self;
        cameras.doubtful.sort_unstable();
        if let Some(lost) = posed.iter().position(|p| !p) {
            return Err(Error::Failed(format!(
                "the cameras were lost at frame {lost}: too few points are followed from the \
                 frames before it; the video may have a cut there"
            )));
        }
        cameras.adjust(tracks, weights, focal)?;
        Ok(cameras)
    }

    /// The longest run of frames with poses.
    pub(super) fn longest_run(&self) -> Range<usize> {
        let frames = self.posed.len();
        let (mut best, mut start) = (0..0, 0);
        for f in 0..=frames {
            if f == frames || !self.posed[f] {
                if f - start > best.len() {
                    best = start..f;
                }
                start = f + 1;
            }
        }
        best
    }
}

/// Poses frame after frame, as long as points lead from one to the next.
///
/// # Errors
/// No pair of frames shows parallax; what the observer of `work` returns.
pub(super) fn pose(
    tracks: &[PointTrack],
    weights: &[f64],
    focal: &Focal,
    frames: usize,
    seed: u64,
    work: &mut Work,
    part: &str,
) -> Result<Posing> {
    let mut posing: Posing = match work.kept(part)? {
        Some(kept) => kept,
        None => {
            let begun = begin(tracks, weights, focal, frames, seed)?;
            work.keep(part, &begun)?;
            begun
        }
    };
    loop {
        let count = posing.posed.iter().filter(|p| **p).count();
        work.progress(Stage::Cameras, 0.9 * count as f64 / frames as f64)?;
        let Some(frame) = next_frame(tracks, &posing.posed, &posing.cameras.anchors) else { break };
        pose_frame(&mut posing, frame, tracks, weights, seed)?;
        work.keep(part, &posing)?;
    }
    Ok(posing)
}

/// Gives a frame its pose by PnP, and adjusts all where enough frames have come since.
fn pose_frame(
    posing: &mut Posing,
    frame: usize,
    tracks: &[PointTrack],
    weights: &[f64],
    seed: u64,
) -> Result<()> {
    let Posing { cameras, posed, adjusted } = posing;
    let n = posed.len();
    let visible: Vec<(usize, DVec3, DVec2)> = (0..tracks.len())
        .filter_map(|i| Some((i, cameras.point(tracks, i)?, tracks[i].at(frame)?)))
        .collect();
    let stride = visible.len().div_ceil(1500).max(1);
    let visible: Vec<_> = visible.into_iter().step_by(stride).collect();
    let points: Vec<DVec3> = visible.iter().map(|v| v.1).collect();
    let pixels: Vec<DVec2> = visible.iter().map(|v| v.2).collect();
    let weight: Vec<f64> = visible.iter().map(|v| weights[v.0]).collect();
    let nearest = (0..n).filter(|&f| posed[f]).min_by_key(|f| f.abs_diff(frame));
    let prediction = nearest.map(|f| cameras.poses[f]);
    let k = &cameras.intrinsics;
    let options = PnpOptions {
        seed,
        threshold: 2.0 * (f64::from(k.width) / 320.0).max(1.0),
        max_iterations: 1500,
        ..PnpOptions::for_width(k.width)
    };
    match pnp_ransac(&points, &pixels, Some(&weight), k, prediction.as_ref(), &options) {
        Ok(found) => {
            cameras.poses[frame] = found.view_from_world;
            if found.inlier_ratio < 0.25 {
                cameras.doubtful.push(frame);
            }
        }
        Err(_) => {
            cameras.poses[frame] = prediction.unwrap_or(Pose::IDENTITY);
            cameras.doubtful.push(frame);
        }
    }
    posed[frame] = true;
    let count = posed.iter().filter(|p| **p).count();
    cameras.triangulate(tracks, weights, posed, false);
    if count == n || count as f64 >= 1.3 * *adjusted as f64 || count <= 5 {
        *adjusted = count;
        cameras.solve(tracks, weights, posed, FocalMode::Fixed, POINTS.0, 2)?;
        cameras.triangulate(tracks, weights, posed, true);
    }
    Ok(())
}

/// The frame without pose that sees most of the points known.
fn next_frame(tracks: &[PointTrack], posed: &[bool], anchors: &[Option<Anchor>]) -> Option<usize> {
    let mut counts = vec![0usize; posed.len()];
    for (track, _) in tracks.iter().zip(anchors).filter(|(_, anchor)| anchor.is_some()) {
        for f in track.first..track.end() {
            counts[f] += usize::from(!posed[f]);
        }
    }
    let best = (0..posed.len()).max_by_key(|&f| (counts[f], std::cmp::Reverse(f)))?;
    (counts[best] >= 12).then_some(best)
}

#[cfg(test)]
mod tests {
    use super::super::sliding::*;
    use super::*;

    fn track(pixels: Vec<DVec2>) -> PointTrack {
        PointTrack { first: 0, deviation: vec![0.1; pixels.len()], pixels }
    }

    #[test]
    fn a_fixed_cameras_tracks_are_measured() {
        let at = |i: usize| DVec2::new(3.0 * i as f64, 2.0 * i as f64);
        // Nine tracks tremble by 0.1 px, one goes away.
        let mut tracks: Vec<PointTrack> = (1..10)
            .map(|i| track(vec![at(i), at(i) + DVec2::new(0.1, 0.0), at(i) - DVec2::new(0.0, 0.1)]))
            .collect();
        tracks.push(track(vec![at(3), at(3) + DVec2::new(5.0, 0.0), at(3) + DVec2::new(9.0, 0.0)]));
        let mut cameras = cameras(0.0);
        cameras.measure_fixed(&tracks, &[1.0; 10]);
        assert!((cameras.inlier_share - 0.9).abs() < 1e-9, "{}", cameras.inlier_share);
        assert!((cameras.rms - 0.1).abs() < 1e-9, "{}", cameras.rms);
        // A mover has no say.
        let weights: Vec<f64> = (0..10).map(|i| f64::from(i < 9)).collect();
        cameras.measure_fixed(&tracks, &weights);
        assert_eq!(cameras.inlier_share, 1.0);
        // Without a static track nothing agrees.
        cameras.measure_fixed(&tracks, &[0.0; 10]);
        assert_eq!((cameras.inlier_share, cameras.rms), (0.0, 0.0));
    }

    #[test]
    fn static_tracks_get_their_depth() {
        let mut cameras = cameras(STEP);
        let wall =
            |x: f64| track((0..5).map(|f| DVec2::new(x, 20.0) + wall() * f as f64).collect());
        let down = |x: f64| {
            track((0..5).map(|f| DVec2::new(x, 9.0) + DVec2::new(-2.0, 4.0) * f as f64).collect())
        };
        let tracks = [wall(40.0), wall(30.0), down(50.0), wall(50.0)];
        cameras.anchors = vec![None; 4];
        cameras.triangulate(&tracks, &[1.0, 1.0, 1.0, 0.0], &[true; FRAMES], true);
        for i in [0, 1] {
            let point = cameras.point(&tracks, i).unwrap();
            assert!((point.z - WALL).abs() < 1e-6, "{point}");
        }
        assert!(cameras.anchors[2].is_none(), "it leaves its epipolar lines");
        assert!(cameras.anchors[3].is_none(), "it moves, says the mask");
    }

    #[test]
    fn the_better_of_two_solutions_explains_more() {
        let wall =
            |x: f64| track((0..FRAMES).map(|f| DVec2::new(x, 20.0) + wall() * f as f64).collect());
        let tracks: Vec<PointTrack> = (0..20).map(|i| wall(20.0 + 2.0 * f64::from(i))).collect();
        let weights = vec![1.0; tracks.len()];
        let mut right = cameras(STEP);
        right.anchors = vec![None; tracks.len()];
        assert!((right.explained(&tracks, &weights) - 1.0).abs() < 1e-6);
        // One camera is off by half a pixel.
        let mut wrong = right.clone();
        wrong.poses[3].translation.y += 0.5 * WALL / FOCAL;
        let explained = wrong.explained(&tracks, &weights);
        assert!(explained > 0.3 && explained < 0.95, "{explained}");
        // What moves does not count; of nothing, nothing is explained.
        let mut weights = weights;
        let mut tracks = tracks;
        tracks.push(track((0..FRAMES).map(|f| DVec2::new(9.0, 5.0 + 3.0 * f as f64)).collect()));
        weights.push(0.0);
        right.anchors.push(None);
        assert!((right.explained(&tracks, &weights) - 1.0).abs() < 1e-6);
        weights[20] = 1.0;
        assert!(right.explained(&tracks, &weights) < 0.97);
        assert_eq!(right.explained(&tracks, &[0.0; 21]), 0.0);
    }
}
