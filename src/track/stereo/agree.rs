//! Cross-checks the inverse depths of several frames for one point.
//!
//! A point measured in one frame should, in another frame that shows it, lie at that frame's own inverse
//! depth. If the other frame's depth there is nearer, the point is hidden there, which is no evidence. If it
//! is farther, the other frame sees through the point, which contradicts the measurement.

use glam::DVec2;

use super::super::cameras::Cameras;
use super::super::residual::Seen;
use super::views::{self, View};

/// Maximum difference of two inverse depths of one point, in steps of the levels at that depth.
const SAME: f64 = 1.5;

/// The inverse depths of all frames, and the pixels that movers cover.
pub(super) struct Maps<'a> {
    pub cameras: &'a Cameras,
    pub seen: &'a [Seen],
    /// The pixels that movers cover.
    pub covered: &'a [Vec<bool>],
    pub views: &'a [Vec<View>],
    pub levels: &'a [Vec<f64>],
}

impl Maps<'_> {
    /// The weighted mean of a pixel's candidate inverse depth and of the values of the frames that agree with
    /// it; `None` if fewer than `witnesses` frames agree, or if more frames see through the point than agree.
    pub fn agreed(
        &self,
        frame: usize,
        i: usize,
        (inverse_depth, deviation): (f32, f32),
        witnesses: usize,
    ) -> Option<f32> {
        let k = &self.cameras.intrinsics;
        let size = DVec2::new(k.width.into(), k.height.into());
        let width = k.width as usize;
        let d = f64::from(inverse_depth);
        if d <= 0.0 {
            return None;
        }
        let ray = k.ray(DVec2::new((i % width) as f64 + 0.5, (i / width) as f64 + 0.5));
        let weigh = |deviation: f32| f64::from(deviation).max(1e-6).powi(-2);
        let (mut agree, mut through) = (0, 0);
        let mut weights = weigh(deviation);
        let mut sum = d * weights;
        for view in &self.views[frame] {
            let point = view.view_from_frame.apply(ray / d);
            if point.z < 1e-3 {
                continue;
            }
            let at = k.project(point);
            if !(at.cmpge(DVec2::ZERO).all() && at.cmplt(size).all()) {
                continue;
            }
            let j = at.y as usize * width + at.x as usize;
            let other = &self.seen[view.frame];
            if self.covered[view.frame][j] || other.support[j] <= 0.0 {
                continue;
            }
            let (expected, there) = (point.z.recip(), f64::from(other.inverse_depth[j]));
            let step = |frame: usize| views::step(&self.levels[frame], expected);
            if (there - expected).abs() > SAME * step(frame).max(step(view.frame)) {
                through += usize::from(there < expected);
                continue;
            }
            agree += 1;
            let back = view.frame_from_view.apply(k.ray(at) / there);
            let weight = weigh(other.deviation[j]);
            sum += weight / back.z;
            weights += weight;
        }
        (agree >= witnesses && through <= agree).then_some((sum / weights) as f32)
    }
}
