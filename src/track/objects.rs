//! Objects: dense point tracks on the movers, grouped into those that belong together.
//!
//! Two points belong to one object if they are near each other and stay so: over a few frames their distance
//! changes by less than itself. Parts of a body are connected through the points between them. Two movers
//! that cross are not connected, although their masks touch.

use glam::DVec2;
use rayon::prelude::*;

use super::masks::regions;
use crate::observe::{NeighbourFlow, PointTrack, TrackOptions, follow, refine};
use crate::types::Image;

/// Approximate number of points per frame on all movers together.
const POINTS: f64 = 600.0;
/// Minimum length of a track on a mover, frames.
const LEAST_LIFE: usize = 4;
/// Maximum distance of neighbours, in spacings of the points.
const REACH: f64 = 5.0;
/// Frames over which the distance of two points is compared.
const WINDOW: usize = 4;
/// Maximum change of the offset between two points of one object within such a window: the first number times
/// its length plus the second number in pixels.
const CHANGE: (f64, f64) = (0.7, 2.0);
/// Maximum number of frames between the end of a group and the start of the group that continues it.
const GONE: usize = 3;
/// Minimum number of a group's points in a frame that counts as part of its life.
const FEW: usize = 3;
/// Minimum overlap of two regions of the same shape, as intersection over union after alignment.
const ALIKE: f64 = 0.6;
/// Minimum number of points of an object.
const LEAST_POINTS: usize = 10;

/// An object: a group of points that move together.
pub(super) struct Object {
    /// Tracks of points on the object.
    pub tracks: Vec<PointTrack>,
    /// The frame in which the first of them begins.
    pub first: usize,
    /// One past the frame in which the last of them ends.
    pub end: usize,
}

/// The spacing of the points that are tracked on movers, pixels.
pub(super) fn spacing(masks: &[Image]) -> usize {
    let moving: usize =
        masks.iter().map(|mask| mask.pixels.iter().filter(|u| **u > 0.5).count()).sum();
    (moving as f64 / masks.len() as f64 / POINTS).sqrt().round().max(2.0) as usize
}

/// Finds the objects of a clip, with their tracks refined in the images, sorted by the total length of their
/// tracks, longest first.
pub(super) fn find(frames: &[Image], flow: &NeighbourFlow, masks: &[Image]) -> Vec<Object> {
    if masks.iter().all(|mask| mask.pixels.iter().all(|u| *u <= 0.5)) {
        return Vec::new();
    }
    let spacing = spacing(masks);
    let options = TrackOptions { spacing, confidence: 0.3 };
    let mut tracks: Vec<PointTrack> =
        follow(flow, &options).iter().filter_map(|track| on_movers(track, masks, 2)).collect();
    refine(frames, flow, &mut tracks);
    // Refined tracks may be longer and may have left the movers.
    tracks = tracks.iter().filter_map(|track| on_movers(track, masks, LEAST_LIFE)).collect();
    let labels = together(&tracks, spacing as f64, masks.len());
    let mut groups: Vec<Vec<PointTrack>> = vec![Vec::new(); tracks.len()];
    for (track, label) in tracks.into_iter().zip(labels) {
        groups[label].push(track);
    }
    groups.retain(|group| group.len() >= LEAST_POINTS);
    while let Some((a, b)) = goes_on(&groups, masks) {
        let tracks = groups.swap_remove(b.max(a));
        groups[a.min(b)].extend(tracks);
    }
    let length = |group: &Vec<PointTrack>| group.iter().map(|t| t.pixels.len()).sum::<usize>();
    groups.sort_by_key(|group| std::cmp::Reverse(length(group)));
    groups
        .into_iter()
        .map(|tracks| Object {
            first: tracks.iter().map(|t| t.first()).min().unwrap_or(0),
            end: tracks.iter().map(PointTrack::end).max().unwrap_or(0),
            tracks,
        })
        .collect()
}

/// The longest part of a track that lies on movers without a gap, if it has at least `least` frames.
fn on_movers(track: &PointTrack, masks: &[Image], least: usize) -> Option<PointTrack> {
    let on = |k: usize| {
        let (mask, p) = (&masks[track.frames[k]], track.pixels[k]);
        let x = (p.x.max(0.0) as u32).min(mask.width - 1);
        let y = (p.y.max(0.0) as u32).min(mask.height - 1);
        mask.at(x, y)[0] > 0.5
    };
    let mut best = 0..0;
    for run in track.runs() {
        let mut start = run.start;
        for k in run.start..=run.end {
            if k == run.end || !on(k) {
                if k - start > best.len() {
                    best = start..k;
                }
                start = k + 1;
            }
        }
    }
    (best.len() >= least).then(|| track.places(best))
}

/// A label for each track; tracks of one object have the same label.
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

/// Two groups of which the second continues the first: it begins when the first ends, and both are alone in
/// mask regions of the same shape. All points were lost and others found.
fn goes_on(groups: &[Vec<PointTrack>], masks: &[Image]) -> Option<(usize, usize)> {
    let lives = |group: &Vec<PointTrack>| {
        let alive = |frame: usize| group.iter().filter(|t| t.at(frame).is_some()).count();
        let frames = (0..masks.len()).filter(|f| alive(*f) >= FEW);
        let frames: Vec<usize> = frames.collect();
        Some((*frames.first()?, *frames.last()?))
    };
    let lives: Vec<Option<(usize, usize)>> = groups.iter().map(lives).collect();
    let home = |group: usize, frame: usize| {
        let (mask, w) = (&masks[frame], masks[frame].width as usize);
        let place = |p: DVec2| {
            let x = (p.x.max(0.0) as usize).min(w - 1);
            (p.y.max(0.0) as usize).min(mask.height as usize - 1) * w + x
        };
        let inside = |region: &Vec<bool>, group: usize| {
            let points = groups[group].iter().filter_map(|t| t.at(frame));
            points.filter(|p| region[place(*p)]).count()
        };
        let as_map = |(region, _): (Vec<usize>, bool)| {
            let mut map = vec![false; mask.pixels.len()];
            region.into_iter().for_each(|i| map[i] = true);
            map
        };
        let regions = regions(&mask.pixels, w, true).into_iter().map(as_map);
        let region = regions.max_by_key(|region| inside(region, group))?;
        let within: Vec<usize> = (0..groups.len()).filter(|g| inside(&region, *g) > 0).collect();
        Some((within, region))
    };
    for (a, first) in lives.iter().enumerate() {
        for (b, second) in lives.iter().enumerate() {
            let (Some((begin, end)), Some((start, last))) = (first, second) else { continue };
            let follows = start > begin && last > end;
            if !follows || start + GONE < *end || *start > end + GONE {
                continue;
            }
            let (Some((in_a, before)), Some((in_b, after))) = (home(a, *end), home(b, *start))
            else {
                continue;
            };
            let alone = |within: &[usize]| within.iter().all(|g| *g == a || *g == b);
            if alone(&in_a) && alone(&in_b) && alike(&before, &after, masks[0].width as usize) {
                return Some((a, b));
            }
        }
    }
    None
}

/// Whether two regions have the same shape after alignment of their middles, and are shifted by less than
/// their size.
fn alike(a: &[bool], b: &[bool], width: usize) -> bool {
    let pixels = |map: &[bool]| -> Vec<(i64, i64)> {
        let inside = (0..map.len()).filter(|i| map[*i]);
        inside.map(|i| ((i % width) as i64, (i / width) as i64)).collect()
    };
    let (a_pixels, b_pixels) = (pixels(a), pixels(b));
    let middle = |pixels: &[(i64, i64)]| {
        let count = pixels.len().max(1) as f64;
        let sum =
            pixels.iter().fold(DVec2::ZERO, |sum, p| sum + DVec2::new(p.0 as f64, p.1 as f64));
        sum / count
    };
    let moved = middle(&b_pixels) - middle(&a_pixels);
    let (dx, dy) = (moved.x.round() as i64, moved.y.round() as i64);
    let height = (b.len() / width) as i64;
    let in_b = |(x, y): &&(i64, i64)| {
        let (x, y) = (x + dx, y + dy);
        (0..width as i64).contains(&x)
            && (0..height).contains(&y)
            && b[y as usize * width + x as usize]
    };
    let both = a_pixels.iter().filter(in_b).count();
    let either = a_pixels.len() + b_pixels.len() - both;
    let size = (a_pixels.len() as f64).sqrt();
    either > 0 && both as f64 >= ALIKE * either as f64 && moved.length() < size
}

/// Whether two tracks move together in all frames that both have.
fn as_one(a: &PointTrack, b: &PointTrack) -> bool {
    let (first, end) = (a.first().max(b.first()), a.end().min(b.end()));
    if end < first + WINDOW {
        return false;
    }
    // Tracks on movers have no gaps: see [`on_movers`].
    let offset = |frame: usize| b.pixels[frame - b.first()] - a.pixels[frame - a.first()];
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
        // Two movers start side by side; one moves up, the other down.
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

    #[test]
    fn one_whose_points_were_all_lost_goes_on() {
        // A mover moves to the right; its points end before the fourth frame, where others begin.
        let left = |frame: usize| 10.0 + 2.0 * frame as f64;
        let mover =
            |frame: usize, p: DVec2| within(p, (left(frame), 10.0), (left(frame) + 20.0, 30.0));
        let group = |frames: std::ops::Range<usize>, x: f64| -> Vec<PointTrack> {
            let track = |k: usize| {
                let at = |f: usize| DVec2::new(left(f) + x + 4.0 * k as f64, 20.0);
                let pixels: Vec<DVec2> = frames.clone().map(at).collect();
                PointTrack::followed(frames.start, pixels.clone(), vec![0.1; pixels.len()])
            };
            (0..4).map(track).collect()
        };
        let masks: Vec<Image> =
            (0..FRAMES).map(|f| map(|p| f32::from(u8::from(mover(f, p))))).collect();
        let groups = [group(0..3, 2.0), group(3..FRAMES, 3.0)];
        assert_eq!(goes_on(&groups, &masks), Some((0, 1)));
        // Two groups that exist at the same time are two objects.
        assert_eq!(goes_on(&[group(0..FRAMES, 2.0), group(0..FRAMES, 3.0)], &masks), None);
        // With a third group in the region the continuation is ambiguous.
        let crossing = [group(0..3, 2.0), group(3..FRAMES, 3.0), group(0..FRAMES, 1.0)];
        assert_eq!(goes_on(&crossing, &masks), None);
        // The region of the second group has another shape.
        let mut masks = masks;
        for mask in &mut masks[3..] {
            *mask = map(|p| f32::from(u8::from(within(p, (14.0, 18.0), (50.0, 23.0)))));
        }
        assert_eq!(goes_on(&groups, &masks), None);
    }
}
