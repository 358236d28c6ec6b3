//! Selects the frames that a frame is compared with, and the inverse depths to test.

use glam::DVec2;

use super::super::cameras::Cameras;
use super::super::quantile;
use super::super::residual::Seen;
use crate::types::Pose;

/// Maximum number of frames that a frame is compared with.
pub(super) const VIEWS: usize = 8;
/// Maximum distance of these frames, in frames.
const REACH: usize = 60;
/// Minimum share of the frame that each of them shows.
const OVERLAP: f64 = 0.4;
/// Minimum parallax of a view, in pixels, for points at the median depth.
const PARALLAX: f64 = 0.5;
/// Spacing of the levels: a point at the median depth shifts by this many pixels between two levels in the
/// view with the most parallax. The spacing is enlarged if there would be more than [`LEVELS`] levels.
const STEP: f64 = 1.0;
/// Minimum spacing of the levels, relative to the inverse depth.
const RELATIVE_STEP: f64 = 0.02;
/// Maximum number of levels.
pub(super) const LEVELS: usize = 256;
/// The lowest and the highest level: a quantile of the inverse depths from flow, times a factor.
const RANGE: [(f64, f64); 2] = [(0.01, 0.4), (0.995, 1.3)];
/// Relative deviation below which the inverse depth from flow counts as known.
const CERTAIN: f32 = 0.2;

/// A frame that another is compared with.
#[derive(Clone, Copy, Debug)]
pub(super) struct View {
    pub frame: usize,
    /// Transforms from the reference frame to this view, and back.
    pub view_from_frame: Pose,
    pub frame_from_view: Pose,
    /// Mean parallax over the image of points at the median depth, pixels.
    pub parallax: f64,
}

/// The views that a frame is compared with, sorted by parallax: evenly sampled from the least to the most
/// parallax, and including the most.
pub(super) fn views(cameras: &Cameras, frame: usize) -> Vec<View> {
    let frame_from_world = cameras.poses[frame].inverse();
    let first = frame.saturating_sub(REACH);
    let last = (frame + REACH).min(cameras.poses.len() - 1);
    let mut all: Vec<View> = (first..=last)
        .filter(|other| *other != frame)
        .filter_map(|other| {
            let view_from_frame = cameras.poses[other] * frame_from_world;
            let parallax = parallax(cameras, view_from_frame)?;
            let frame_from_view = view_from_frame.inverse();
            Some(View { frame: other, view_from_frame, frame_from_view, parallax })
        })
        .collect();
    all.sort_by(|a, b| a.parallax.total_cmp(&b.parallax));
    let n = all.len().min(VIEWS);
    // The last view of each of n equal parts is taken, so that the widest is included.
    (1..=n).map(|k| all[k * all.len() / n - 1]).collect()
}

/// The mean parallax of a view; `None` if it shows too little of the frame or its parallax is too small.
fn parallax(cameras: &Cameras, view_from_frame: Pose) -> Option<f64> {
    const GRID: usize = 6;
    let k = &cameras.intrinsics;
    let size = DVec2::new(k.width.into(), k.height.into());
    let (mut sum, mut shown) = (0.0, 0usize);
    for i in 0..GRID * GRID {
        let part = DVec2::new((i % GRID) as f64 + 0.5, (i / GRID) as f64 + 0.5) / GRID as f64;
        let ray = view_from_frame.rotation * k.ray(part * size);
        let point = ray + view_from_frame.translation;
        if ray.z < 1e-3 || point.z < 1e-3 {
            continue;
        }
        let at = k.project(point);
        if at.cmpge(DVec2::ZERO).all() && at.cmplt(size).all() {
            shown += 1;
            sum += at.distance(k.project(ray));
        }
    }
    let parallax = sum / shown.max(1) as f64;
    (shown as f64 >= OVERLAP * (GRID * GRID) as f64 && parallax >= PARALLAX).then_some(parallax)
}

/// The inverse depths to test, in increasing order; `views` are the frame's. Empty if flow gives no inverse
/// depth.
pub(super) fn levels(seen: &Seen, views: &[View]) -> Vec<f64> {
    let known: Vec<f64> = (0..seen.inverse_depth.len())
        .step_by(5)
        .filter(|i| certain(seen, *i))
        .map(|i| f64::from(seen.inverse_depth[i]))
        .collect();
    let widest = views.iter().map(|view| view.parallax).fold(0.0, f64::max);
    if known.is_empty() || widest <= 0.0 {
        return Vec::new();
    }
    let [low, high] = RANGE.map(|(part, factor)| quantile(known.clone(), part) * factor);
    let mut scale = 1.0;
    loop {
        let mut levels = vec![low];
        while *levels.last().unwrap() < high && levels.len() <= LEVELS {
            let d = *levels.last().unwrap();
            levels.push(d + scale * (STEP / widest).max(RELATIVE_STEP * d));
        }
        if levels.len() <= LEVELS {
            return levels;
        }
        scale *= 1.1;
    }
}

/// The spacing of the levels around an inverse depth.
pub(super) fn step(levels: &[f64], inverse_depth: f64) -> f64 {
    let at = levels.partition_point(|level| *level < inverse_depth);
    match levels.len() {
        0 | 1 => 0.0,
        n => {
            let high = at.clamp(1, n - 1);
            levels[high] - levels[high - 1]
        }
    }
}

/// Whether the inverse depth of a pixel is known from flow.
pub(super) fn certain(seen: &Seen, i: usize) -> bool {
    seen.support[i] >= 0.5 && seen.deviation[i] < CERTAIN * seen.inverse_depth[i]
}

/// The index of the level nearest to an inverse depth.
pub(super) fn nearest(levels: &[f64], inverse_depth: f64) -> usize {
    let above = levels.partition_point(|level| *level < inverse_depth).min(levels.len() - 1);
    let below = above.saturating_sub(1);
    let off = |l: usize| (levels[l] - inverse_depth).abs();
    if off(below) < off(above) { below } else { above }
}

#[cfg(test)]
mod tests {
    use super::super::super::sliding;
    use super::*;

    #[test]
    fn the_widest_view_is_among_those_taken_and_a_fixed_camera_has_none() {
        let cameras = sliding::cameras(sliding::STEP);
        let views = views(&cameras, 1);
        assert_eq!(views.last().unwrap().frame, sliding::FRAMES - 1);
        assert!(views.is_sorted_by(|a, b| a.parallax <= b.parallax));
        // The parallax of a point at depth 1 is the focal length times the camera's displacement.
        for view in &views {
            let way = sliding::STEP * view.frame.abs_diff(1) as f64;
            assert!((view.parallax / (sliding::FOCAL * way) - 1.0).abs() < 0.01, "{view:?}");
        }
        assert!(super::views(&sliding::cameras(0.0), 1).is_empty());
    }

    #[test]
    fn levels_cover_what_flow_said_and_are_no_farther_apart_than_they_may() {
        let views = views(&sliding::cameras(sliding::STEP), 0);
        let widest = views.last().unwrap().parallax;
        let mut seen = Seen {
            inverse_depth: (0..1000).map(|i| 0.1 + 0.001 * i as f32).collect(),
            deviation: vec![0.001; 1000],
            score: vec![0.0; 1000],
            support: vec![1.0; 1000],
        };
        let found = levels(&seen, &views);
        assert!(found[0] < 0.1 && *found.last().unwrap() > 1.1 && found.len() <= LEVELS);
        for pair in found.windows(2) {
            let allowed = (STEP / widest).max(RELATIVE_STEP * pair[0]);
            assert!(pair[1] > pair[0] && pair[1] - pair[0] <= 1.001 * allowed, "{pair:?}");
        }
        assert_eq!(nearest(&found, found[3] + 0.1 * (found[4] - found[3])), 3);
        assert_eq!(nearest(&found, 1e9), found.len() - 1);
        seen.support.fill(0.0);
        assert!(levels(&seen, &views).is_empty());
    }
}
