//! Windows of a clip: intervals of its frames in which the movers have their own Gaussians and control
//! points.
//!
//! One set of Gaussians that follows the scaffold through the whole clip must match all frames. Where
//! the scaffold does not carry a mover's surface to its true position, or a mover turns and changes its
//! shading, that set fits no frame and blurs. Such a clip is cut into windows: in each window the movers
//! are seeded from the window's frames, and they are absent in all others. Neighbouring windows share
//! two frames, so that there is no gap between them. Where the appearance of movers, carried by the
//! scaffold, hardly changes, a single window sees more of them and gives better offset views.
//!
//! A Gaussian follows the control points that are nearest to it in the canonical frame. To make it
//! follow those of its own window only, the canonical positions of the windows are offset along x by
//! more than the movers' extent.

use super::lifting::MOVING;
use super::sequence::{Sequence, SequenceSettings, first_control_points};
use crate::observe::luminance::Luminance;
use crate::track::scaffold::{Node, value};
use crate::track::{Scaffold, Track};
use glam::{DVec2, DVec3};
use rayon::prelude::*;
use std::ops::Range;

/// Number of frames of a window, except the shared ones, if there are enough control points.
const LENGTH: usize = 4;
/// Approximate number of control points that a window must have; otherwise there are fewer windows.
const LEAST_CONTROL_POINTS: usize = 24;
/// Root mean square change of the movers' luminance within [`LENGTH`] frames above which a clip is cut.
const CHANGE: f64 = 0.1;
/// Step along each axis between the pixels of movers at which the change is measured.
const EVERY: usize = 2;
/// Offset between the canonical positions of windows, in units of the movers' extent along x.
const APART: f64 = 2.0;

/// An interval of frames with its own Gaussians and control points.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Window {
    /// The frames in which they are present.
    pub frames: Range<usize>,
    /// The canonical frame: objects are at their canonical positions minus `offset` in it.
    pub canonical: usize,
    /// Offset from the objects' positions in the canonical frame to their canonical positions, world
    /// units.
    pub offset: DVec3,
    /// What the window holds.
    pub holds: Holds,
}

/// The kind of Gaussians and control points that a window has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Holds {
    All,
    Movers,
    Shadows,
}

impl Window {
    pub fn holds_movers(&self) -> bool {
        self.holds != Holds::Shadows
    }

    pub fn holds_shadows(&self) -> bool {
        self.holds != Holds::Movers
    }

    /// The nodes of the scaffold that the window holds and that are alive in some of its frames.
    pub fn nodes<'a>(&'a self, track: &'a Track) -> impl Iterator<Item = &'a Node> {
        track.scaffold.nodes.iter().filter(|node| self.takes(track, node))
    }

    fn takes(&self, track: &Track, node: &Node) -> bool {
        let shadow = node.owner > track.movers.len();
        let held = if shadow { self.holds_shadows() } else { self.holds_movers() };
        held && node.alive.start < self.frames.end && self.frames.start < node.alive.end
    }

    /// The canonical position of a node, world units.
    pub fn place(&self, node: &Node) -> DVec3 {
        node.world_from_node[self.canonical].translation + self.offset
    }
}

/// The windows of movers in order, then the window of shadows; one window that holds everything where
/// the clip is not cut.
pub(super) fn windows(sequence: Sequence<'_>, settings: &SequenceSettings) -> Vec<Window> {
    let (track, frames) = (sequence.track, sequence.frames.len());
    let count =
        (frames / LENGTH).min(first_control_points(settings.control_points) / LEAST_CONTROL_POINTS);
    if settings.windows && count > 1 && change_of_look(sequence) > CHANGE {
        cut(&track.scaffold, frames, count)
    } else {
        vec![Window {
            frames: 0..frames,
            canonical: track.scaffold.canonical,
            offset: DVec3::ZERO,
            holds: Holds::All,
        }]
    }
}

/// `count` windows of movers over the frames, and one of shadows, which change little.
fn cut(scaffold: &Scaffold, frames: usize, count: usize) -> Vec<Window> {
    let apart = DVec3::X * APART * extent(scaffold);
    let of_shadows = Window {
        frames: 0..frames,
        canonical: scaffold.canonical,
        offset: DVec3::ZERO,
        holds: Holds::Shadows,
    };
    let of_movers = (0..count).map(|k| {
        let own = k * frames / count..(k + 1) * frames / count;
        Window {
            frames: own.start.saturating_sub(1)..(own.end + 1).min(frames),
            canonical: (own.start + own.end) / 2,
            offset: apart * (k + 1) as f64,
            holds: Holds::Movers,
        }
    });
    of_movers.chain([of_shadows]).collect()
}

/// The extent of the nodes' positions along x, over all frames.
fn extent(scaffold: &Scaffold) -> f64 {
    let places = scaffold.nodes.iter().flat_map(|node| &node.world_from_node);
    let (low, high) = places
        .map(|pose| pose.translation.x)
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), x| (low.min(x), high.max(x)));
    (high - low).max(0.0)
}

/// The root mean square change of the movers' luminance over the clip, between each frame and the last
/// of the [`LENGTH`] frames that begin with it, at the positions to which the scaffold carries the
/// pixels.
fn change_of_look(sequence: Sequence<'_>) -> f64 {
    let (track, frames) = (sequence.track, sequence.frames);
    let pictures: Vec<Luminance> = frames.par_iter().map(Luminance::of).collect();
    let of_frame = |from: usize| {
        let to = from + LENGTH - 1;
        let (mask, owners) = (&track.masks[from], &track.owners[from]);
        let (mut sum, mut count) = (0.0, 0.0);
        for y in (0..mask.height).step_by(EVERY) {
            for x in (0..mask.width).step_by(EVERY) {
                if mask.at(x, y)[0] <= MOVING {
                    continue;
                }
                let pixel = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
                let point = track.lift(from, pixel);
                let owner = owners.at(x, y)[0] as usize;
                let Some((point, _)) = track.scaffold.carry(owner, point, from, to) else {
                    continue;
                };
                let seen = track.view_from_world[to].apply(point);
                if seen.z <= 0.0 {
                    continue;
                }
                let there = track.intrinsics.project(seen);
                let pair = (pictures[from].sample(pixel), pictures[to].sample(there));
                let (Some((before, _)), Some((after, _))) = pair else { continue };
                if value(&track.masks[to], there) > MOVING
                    && value(&track.owners[to], there) as usize == owner
                {
                    sum += (after - before).powi(2);
                    count += 1.0;
                }
            }
        }
        [sum, count]
    };
    let starts = 0..(frames.len() + 1).saturating_sub(LENGTH);
    // The sum is in the order of the frames, so it does not depend on the number of threads.
    let sums: Vec<[f64; 2]> = starts.into_par_iter().map(of_frame).collect();
    let [sum, count] = sums.iter().fold([0.0; 2], |[s, c], [ds, dc]| [s + ds, c + dc]);
    if count > 0.0 { (sum / count).sqrt() } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::types::Pose;
    use glam::DQuat;

    fn node(owner: usize, x: f64, alive: Range<usize>) -> Node {
        let pose =
            |f: u32| Pose::new(DQuat::IDENTITY, DVec3::new(x + 0.1 * f64::from(f), 0.0, 2.0));
        Node { owner, world_from_node: (0..30).map(pose).collect(), spacing: 0.1, alive }
    }

    #[test]
    fn windows_follow_each_other_without_a_gap_and_lie_apart() {
        let scaffold =
            Scaffold { canonical: 12, nodes: vec![node(1, 0.0, 0..30), node(1, 0.5, 0..30)] };
        let windows = cut(&scaffold, 30, 7);
        let (shadows, movers) = windows.split_last().unwrap();
        assert_eq!(
            (shadows.frames.clone(), shadows.canonical, shadows.offset),
            (0..30, 12, DVec3::ZERO)
        );
        assert!(shadows.holds_shadows() && !shadows.holds_movers());
        assert_eq!((movers.len(), movers[0].frames.start, movers[6].frames.end), (7, 0, 30));
        for pair in movers.windows(2) {
            assert_eq!(pair[0].frames.end - pair[1].frames.start, 2, "{pair:?}");
        }
        // Nodes of different windows are farther from each other than those of one window.
        for (k, window) in movers.iter().enumerate() {
            assert!(window.frames.contains(&window.canonical) && window.frames.len() > LENGTH);
            let reach =
                |w: &Window| scaffold.nodes.iter().map(|n| w.place(n).x).collect::<Vec<_>>();
            for other in movers.iter().take(k).chain([shadows]) {
                for (a, b) in reach(window)
                    .into_iter()
                    .flat_map(|a| reach(other).into_iter().map(move |b| (a, b)))
                {
                    assert!((a - b).abs() > 0.5, "{window:?}, {other:?}");
                }
            }
        }
    }
}
