//! Windows of a clip: stretches of its frames in which what moves has Gaussians and control points of its
//! own.
//!
//! One set of Gaussians that follows the scaffold through the whole clip has to look right in all frames.
//! Where the scaffold does not carry a mover's surface to where it is, or what moves turns and changes its
//! light, that set fits none of them: it dissolves. Then a clip is cut: in each window what moves is
//! seeded from the window's own frames, and is absent in all others. Neighbouring windows share two
//! frames, so that one takes over from the other without a gap. Where the look of movers, carried by the
//! scaffold, hardly changes, one window sees more of them, and is better from aside.
//!
//! A Gaussian follows the control points that are nearest to it in the canonical frame. So that it
//! follows those of its own window only, the canonical places of windows lie side by side along x, apart
//! by more than movers extend.

use super::lifting::MOVING;
use super::sequence::{Sequence, SequenceSettings, first_control_points};
use crate::observe::luminance::Luminance;
use crate::track::scaffold::{Node, value};
use crate::track::{Scaffold, Track};
use glam::{DVec2, DVec3};
use rayon::prelude::*;
use std::ops::Range;

/// Frames of a window, besides those that it shares, where there are control points enough.
const LENGTH: usize = 4;
/// A window has about so many control points, or there are fewer windows.
const LEAST_CONTROL_POINTS: usize = 24;
/// A clip is cut where the luminance of movers changes by more than this within [`LENGTH`] frames, as a
/// root mean square.
const CHANGE: f64 = 0.1;
/// Of the pixels of movers every so-manieth tells how the look changes, along each axis.
const EVERY: usize = 2;
/// The windows' canonical places are apart by so many times what movers extend along x.
const APART: f64 = 2.0;

/// A stretch of frames with Gaussians and control points of its own.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Window {
    /// Those in which they are there.
    pub frames: Range<usize>,
    /// The frame in which things are where their canonical places are, but for `offset`.
    pub canonical: usize,
    /// From where things are in the canonical frame to their canonical places.
    pub offset: DVec3,
    /// Who is in it.
    pub holds: Holds,
}

/// Whose Gaussians and control points a window has.
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

    /// The nodes of the scaffold that it holds and that are there in some of its frames.
    pub fn nodes<'a>(&'a self, track: &'a Track) -> impl Iterator<Item = &'a Node> {
        track.scaffold.nodes.iter().filter(|node| self.takes(track, node))
    }

    fn takes(&self, track: &Track, node: &Node) -> bool {
        let shadow = node.owner > track.movers.len();
        let held = if shadow { self.holds_shadows() } else { self.holds_movers() };
        held && node.alive.start < self.frames.end && self.frames.start < node.alive.end
    }

    /// The canonical place of a node.
    pub fn place(&self, node: &Node) -> DVec3 {
        node.world_from_node[self.canonical].translation + self.offset
    }
}

/// The windows of a clip, in order, then that of shadows; one that holds all where it is not cut.
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

/// So many windows of movers over the frames, and one of shadows, which change little.
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

/// What the nodes' places extend along x, over all frames.
fn extent(scaffold: &Scaffold) -> f64 {
    let places = scaffold.nodes.iter().flat_map(|node| &node.world_from_node);
    let (low, high) = places
        .map(|pose| pose.translation.x)
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), x| (low.min(x), high.max(x)));
    (high - low).max(0.0)
}

/// By how much the luminance of what moves differs between a frame and the last of the [`LENGTH`] that
/// begin with it, at the places to which the scaffold carries it: the root mean square over the clip.
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
    // Summed in the order of the frames: the same for any number of threads.
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
        // Nodes of different windows are farther from each other than those of one.
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
