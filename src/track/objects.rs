//! Movers as objects: points followed densely on what moves, and which of them belong together.
//!
//! Two points are of one object when they are near each other and stay so: over a few frames their
//! distance changes by less than itself. Parts of a body hang together through the points between
//! them; two movers that cross do not, although their masks touch.

use glam::DVec2;
use rayon::prelude::*;

use crate::observe::{NeighbourFlow, PointTrack, TrackOptions, follow, refine};
use crate::types::Image;

/// Points per frame on all that moves, about.
const POINTS: f64 = 600.0;
/// A point's life on a mover, at least, frames.
const LEAST_LIFE: usize = 4;
/// Neighbours are looked for within so many spacings.
const REACH: f64 = 5.0;
/// Frames over which the distance of two points is compared.
const WINDOW: usize = 4;
/// In such a window, how much the offset between two points of one object may change, relative to
/// its length and a tolerance in pixels.
const CHANGE: (f64, f64) = (0.7, 2.0);
/// Points of an object, at least.
const LEAST_POINTS: usize = 10;

/// What moves as one.
pub(super) struct Object {
    /// Points on it.
    pub tracks: Vec<PointTrack>,
    /// The frame in which the first of them begins.
    pub first: usize,
    /// One past the frame in which the last of them ends.
    pub end: usize,
}

/// The distance of the points that are followed on movers, pixels.
pub(super) fn spacing(masks: &[Image]) -> usize {
    let moving: usize =
        masks.iter().map(|mask| mask.pixels.iter().filter(|u| **u > 0.5).count()).sum();
    (moving as f64 / masks.len() as f64 / POINTS).sqrt().round().max(2.0) as usize
}

/// Finds the objects of a clip, its points aligned with the pictures; those with the longest tracks first.
pub(super) fn find(frames: &[Image], flow: &NeighbourFlow, masks: &[Image]) -> Vec<Object> {
    if masks.iter().all(|mask| mask.pixels.iter().all(|u| *u <= 0.5)) {
        return Vec::new();
    }
    let spacing = spacing(masks);
    let options = TrackOptions { spacing, confidence: 0.3 };
    let mut tracks: Vec<PointTrack> =
        follow(flow, &options).iter().filter_map(|track| on_movers(track, masks, 2)).collect();
    refine(frames, flow, &mut tracks);
    // They have become longer, and may have left the movers.
    tracks = tracks.iter().filter_map(|track| on_movers(track, masks, LEAST_LIFE)).collect();
    let labels = together(&tracks, spacing as f64, masks.len());
    let mut groups: Vec<Vec<PointTrack>> = vec![Vec::new(); tracks.len()];
    for (track, label) in tracks.into_iter().zip(labels) {
        groups[label].push(track);
    }
    groups.retain(|group| group.len() >= LEAST_POINTS);
    let length = |group: &Vec<PointTrack>| group.iter().map(|t| t.pixels.len()).sum::<usize>();
    groups.sort_by_key(|group| std::cmp::Reverse(length(group)));
    groups
        .into_iter()
        .map(|tracks| Object {
            first: tracks.iter().map(|t| t.first).min().unwrap_or(0),
            end: tracks.iter().map(PointTrack::end).max().unwrap_or(0),
            tracks,
        })
        .collect()
}

/// The longest part of a track that lies on movers, if it has so many frames.
fn on_movers(track: &PointTrack, masks: &[Image], least: usize) -> Option<PointTrack> {
    let on = |k: usize| {
        let (mask, p) = (&masks[track.first + k], track.pixels[k]);
        let x = (p.x.max(0.0) as u32).min(mask.width - 1);
        let y = (p.y.max(0.0) as u32).min(mask.height - 1);
        mask.at(x, y)[0] > 0.5
    };
    let (mut best, mut start) = (0..0, None);
    for k in 0..=track.pixels.len() {
        match (k < track.pixels.len() && on(k), start) {
            (true, None) => start = Some(k),
            (false, Some(from)) => {
                if k - from > best.len() {
                    best = from..k;
                }
                start = None;
            }
            _ => {}
        }
    }
    let frames = track.first + best.start..track.first + best.end;
    (best.len() >= least).then(|| track.part(frames))
}

/// By track, a number that tracks of one object share.
fn together(tracks: &[PointTrack], spacing: f64, frames: usize) -> Vec<usize> {
    let reach = REACH * spacing;
    let mut root: Vec<usize> = (0..tracks.len()).collect();
    fn find(root: &mut [usize], mut i: usize) -> usize {
        while root[i] != i {
            root[i] = root[root[i]];
            i = root[i];
        }
        i
    }
    for frame in (0..frames).step_by(2) {
        let mut alive: Vec<(usize, DVec2)> = tracks
            .iter()
            .enumerate()
            .filter_map(|(i, track)| Some((i, track.at(frame)?)))
            .collect();
        alive.sort_by(|a, b| a.1.x.total_cmp(&b.1.x).then(a.0.cmp(&b.0)));
        let links: Vec<(usize, usize)> = (0..alive.len())
            .into_par_iter()
            .flat_map_iter(|a| {
                let (i, p) = alive[a];
                let near = alive[a + 1..].iter().take_while(move |(_, q)| q.x - p.x <= reach);
                let near = near.filter(move |(_, q)| p.distance(*q) <= reach);
                near.filter(move |(j, _)| as_one(&tracks[i], &tracks[*j]))
                    .map(move |(j, _)| (i, *j))
            })
            .collect();
        for (i, j) in links {
            let (a, b) = (find(&mut root, i), find(&mut root, j));
            root[a.max(b)] = a.min(b);
        }
    }
    (0..tracks.len()).map(|i| find(&mut root, i)).collect()
}

/// Whether two tracks go together wherever both live.
fn as_one(a: &PointTrack, b: &PointTrack) -> bool {
    let (first, end) = (a.first.max(b.first), a.end().min(b.end()));
    if end < first + WINDOW {
        return false;
    }
    let offset = |frame: usize| b.pixels[frame - b.first] - a.pixels[frame - a.first];
    (first..=end - WINDOW).all(|frame| {
        let (before, after) = (offset(frame), offset(frame + WINDOW - 1));
        let length = before.length().min(after.length());
        (after - before).length() <= CHANGE.0 * length + CHANGE.1
    })
}

#[cfg(test)]
mod tests {
    use super::super::sliding::*;
    use super::*;

    #[test]
    fn two_movers_that_touch_are_two_objects() {
        // Side by side at first; one goes up, the other down.
        let left = |frame: usize, p: DVec2| {
            let y = 20.0 - 2.0 * frame as f64;
            within(p, (12.0, y - 10.0), (30.0, y + 10.0))
        };
        let right = |frame: usize, p: DVec2| {
            let y = 20.0 + 2.0 * frame as f64;
            within(p, (30.0, y - 10.0), (48.0, y + 10.0))
        };
        let flow = flow(|frame, p| match (left(frame, p), right(frame, p)) {
            (true, _) => DVec2::new(0.0, -2.0),
            (_, true) => DVec2::new(0.0, 2.0),
            _ => DVec2::ZERO,
        });
        let mask = |f: usize| map(move |p| f32::from(u8::from(left(f, p) || right(f, p))));
        let masks: Vec<Image> = (0..FRAMES).map(mask).collect();
        let found = find(&frames(), &flow, &masks);
        assert_eq!(
            found.len(),
            2,
            "{:?}",
            found.iter().map(|o| o.tracks.len()).collect::<Vec<_>>()
        );
        for object in &found {
            let side = |t: &PointTrack| t.pixels[0].x < 30.0;
            let of_left = object.tracks.iter().filter(|t| side(t)).count();
            assert!(of_left == 0 || of_left == object.tracks.len(), "{of_left}");
            assert_eq!((object.first, object.end), (0, FRAMES));
        }
        let nothing = vec![map(|_| 0.0); FRAMES];
        assert!(find(&frames(), &flow, &nothing).is_empty());
    }
}
