//! What the inverse depths of several frames say of one point.
//!
//! A point that one frame tells lies, in another that shows it, where that frame's own inverse depth is.
//! Where that is nearer, the point is hidden there, which says nothing; where it is farther, the other frame
//! sees through the point, which contradicts it.

use glam::DVec2;

use super::super::cameras::Cameras;
use super::super::residual::Seen;
use super::views::{self, View};

/// Two inverse depths are of one point where they differ by no more than this, in steps of the levels at
/// that depth.
const SAME: f64 = 1.5;

/// The inverse depths of all frames, and what covers them.
pub(super) struct Maps<'a> {
    pub cameras: &'a Cameras,
    pub seen: &'a [Seen],
    /// Where movers are.
    pub covered: &'a [Vec<bool>],
    pub views: &'a [Vec<View>],
    pub levels: &'a [Vec<f64>],
}

impl Maps<'_> {
    /// The inverse depth of a pixel of a frame, by what is believed to be it and by the frames that
    /// agree with that: none where fewer than `witnesses` do, or more see through the point.
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
