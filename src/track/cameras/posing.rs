//! Poses from tracks alone: an initial pair of frames, then frame by frame by PnP.

use std::ops::Range;

use glam::{DVec2, DVec3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::{Anchor, Cameras, Focal, Strictness};
use crate::geometry::bundle::FocalMode;
use crate::geometry::pnp::{PnpOptions, pnp_ransac};
use crate::geometry::triangulate::inverse_depth;
use crate::geometry::two_view::{Motion, TwoView};
use crate::observe::PointTrack;
use crate::track::Stage;
use crate::track::observer::Work;
use crate::track::still::{relate, shared};
use crate::types::{Intrinsics, Pose};
use crate::{Error, Result};

/// Number of posed views from which a point has its full weight in the next pose.
const SENIOR: f64 = 10.0;

/// The weight of a point by its number of posed views: a point on a mover can fit any camera for a few
/// frames.
fn seniority(views: usize) -> f64 {
    ((views as f64 - 2.0) / (SENIOR - 2.0)).clamp(0.02, 1.0)
}

/// Maximum number of points in an intermediate adjustment.
const POINTS: usize = 900;

/// Chooses the initial pair of frames: many shared tracks, large parallax, not a planar scene.
fn start(
    tracks: &[PointTrack],
    weights: &[f64],
    k: &Intrinsics,
    frames: usize,
    seed: u64,
    strictness: Strictness,
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
            let found = relate(&s, k, seed, strictness).ok()?;
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

/// The state of incremental posing.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(in crate::track) struct Posing {
    cameras: Cameras,
    /// Per frame: whether it has a pose.
    posed: Vec<bool>,
    /// Number of posed frames at the last adjustment of all of them.
    adjusted: usize,
}

/// Initialises posing from two frames.
fn begin(
    tracks: &[PointTrack],
    weights: &[f64],
    focal: &Focal,
    n: usize,
    seed: u64,
    strictness: Strictness,
) -> Result<Posing> {
    let k = focal.intrinsics;
    let Some(((a, b), found, ids)) = start(tracks, weights, &k, n, seed, strictness) else {
        return Err(Error::Input(
            "no two frames of this video show parallax that one moving camera explains; film while \
             walking or moving the camera sideways, or supply poses"
                .into(),
        ));
    };
    let mut cameras = Cameras { strictness, ..Cameras::new(focal, n, tracks.len()) };
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

/// Reconstructs cameras from tracks alone: an initial pair of frames, then frame by frame by PnP, with
/// intermediate adjustments and a final one over all frames. `strictness` scales the thresholds of outliers;
/// `part` is the name under which the intermediate state is saved.
pub(in crate::track) fn reconstruct(
    tracks: &[PointTrack],
    weights: &[f64],
    focal: &Focal,
    frames: usize,
    seed: u64,
    strictness: Strictness,
    work: &mut Work,
    part: &str,
) -> Result<Cameras> {
    let posing = pose(tracks, weights, focal, frames, seed, strictness, work, part)?;
    posing.adjusted(tracks, weights, focal)
}

impl Posing {
    /// The cameras, adjusted to all static tracks.
    ///
    /// # Errors
    /// A frame has no pose; errors of the adjustment.
    pub(in crate::track) fn adjusted(
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
                 frames before it; the video may have a cut there that was not found: give the frames \
                 up to it, or from it on, by themselves"
            )));
        }
        cameras.adjust(tracks, weights, focal)?;
        Ok(cameras)
    }

    /// The longest run of frames with poses.
    pub(in crate::track) fn longest_run(&self) -> Range<usize> {
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

/// Poses one frame after another, as long as enough points are shared with the posed frames.
pub(in crate::track) fn pose(
    tracks: &[PointTrack],
    weights: &[f64],
    focal: &Focal,
    frames: usize,
    seed: u64,
    strictness: Strictness,
    work: &mut Work,
    part: &str,
) -> Result<Posing> {
    let mut posing: Posing = match work.kept(part)? {
        Some(kept) => kept,
        None => {
            let begun = begin(tracks, weights, focal, frames, seed, strictness)?;
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

/// Poses a frame by PnP, and adjusts all frames if enough have been added since the last adjustment.
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
    let views = |i: usize| tracks[i].frames.iter().filter(|f| posed[**f]).count();
    let weight = |i: usize| match cameras.strictness {
        Strictness::Usual => weights[i],
        Strictness::Strict => weights[i] * seniority(views(i)),
    };
    let weight: Vec<f64> = visible.iter().map(|v| weight(v.0)).collect();
    let nearest = (0..n).filter(|&f| posed[f]).min_by_key(|f| f.abs_diff(frame));
    let prediction = nearest.map(|f| cameras.poses[f]);
    let k = &cameras.intrinsics;
    let options = PnpOptions {
        seed,
        threshold: 2.0 * cameras.strictness.factor() * (f64::from(k.width) / 320.0).max(1.0),
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
        cameras.solve(tracks, weights, posed, FocalMode::Fixed, POINTS, 2)?;
        cameras.triangulate(tracks, weights, posed, true);
    }
    Ok(())
}

/// The frame without a pose that sees most of the known points.
fn next_frame(tracks: &[PointTrack], posed: &[bool], anchors: &[Option<Anchor>]) -> Option<usize> {
    let mut counts = vec![0usize; posed.len()];
    for (track, _) in tracks.iter().zip(anchors).filter(|(_, anchor)| anchor.is_some()) {
        for &f in &track.frames {
            counts[f] += usize::from(!posed[f]);
        }
    }
    let best = (0..posed.len()).max_by_key(|&f| (counts[f], std::cmp::Reverse(f)))?;
    (counts[best] >= 12).then_some(best)
}
