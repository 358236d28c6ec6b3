//! Where the points of a moving object are at every frame: what control points start from.
//!
//! Point tracks on movers are lifted to the world by the frames' depth. A point goes with its own track
//! while that lives, and beyond with its object; on what is no object, with the tracks that are nearest
//! to it at the time.

use crate::observe::PointTrack;
use crate::track::{Mover, Track};
use crate::types::{Camera, Image};
use glam::{DVec2, DVec3};
use rayon::prelude::*;

/// Above this a pixel of a mask counts as moving.
pub(super) const MOVING: f32 = 0.5;
/// Tracks that a point without one of its own goes with.
const COMPANIONS: usize = 4;
/// A track on an object counts if it lives for so many frames.
const LEAST_LIFE: usize = 4;
/// A point is not on an object that is farther from its middle than so many times the median.
const STRAY: f64 = 3.0;
/// Standard deviation of the smoothing over time, frames: depth on movers is inferred frame by
/// frame and trembles.
const SMOOTHING: f64 = 1.0;

/// A point of a mover through all frames.
pub(super) struct Trajectory {
    /// The object it is on, as [`Track::owners`] numbers them; 0 where none is known.
    owner: usize,
    /// By frame, in the world.
    pub(super) positions: Vec<DVec3>,
}

/// Points of movers through all frames.
pub(super) struct Trajectories {
    /// The frame whose positions are the canonical ones.
    pub(super) canonical: usize,
    /// One by one.
    pub(super) all: Vec<Trajectory>,
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

/// Tracks on movers, lifted: by track, its object, and its first frame and positions.
fn lifted(track: &Track) -> Vec<(usize, (usize, Vec<DVec3>))> {
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
            (owner(track, t), (t.first, t.pixels.iter().enumerate().map(lift).collect()))
        })
        .collect()
}

/// The object that a track is on, if most of its pixels say the same.
fn owner(track: &Track, points: &PointTrack) -> usize {
    let at = |(k, p): (usize, &DVec2)| value(&track.owners[points.first + k], *p) as usize;
    let mut owners: Vec<usize> = points.pixels.iter().enumerate().map(at).collect();
    owners.sort_unstable();
    // One that holds more than half holds the middle.
    let middle = owners[owners.len() / 2];
    let count = owners.iter().filter(|o| **o == middle).count();
    if 2 * count > owners.len() { middle } else { 0 }
}

/// A track in the frame of its object, smoothed.
fn inside(own: &(usize, Vec<DVec3>), mover: &Mover) -> Vec<DVec3> {
    let (first, seen) = own;
    let inside = |(k, p): (usize, &DVec3)| mover.world_from_object(first + k).inverse().apply(*p);
    let inside: Vec<DVec3> = seen.iter().enumerate().map(inside).collect();
    (0..inside.len()).map(|k| mean(&inside, k)).collect()
}

/// A track's path through the whole clip, from its path in the frame of its object: where it is not
/// seen, it is where it was last.
fn with_mover(first: usize, inside: &[DVec3], mover: &Mover, frames: usize) -> Vec<DVec3> {
    (0..frames)
        .map(|frame| {
            let k = frame.saturating_sub(first).min(inside.len() - 1);
            mover.world_from_object(frame).apply(inside[k])
        })
        .collect()
}

/// Which of some points on an object are on it indeed: what lies far off, by another's depth or by
/// another's track, would swing widely where the object turns.
fn near_the_others(points: &[DVec3]) -> Vec<bool> {
    let median = |mut values: Vec<f64>| {
        let middle = values.len() / 2;
        *values.select_nth_unstable_by(middle, f64::total_cmp).1
    };
    if points.is_empty() {
        return Vec::new();
    }
    let centre = [0, 1, 2].map(|k| median(points.iter().map(|p| p[k]).collect()));
    let centre = DVec3::from_array(centre);
    let usual = median(points.iter().map(|p| p.distance(centre)).collect());
    points.iter().map(|p| p.distance(centre) <= STRAY * usual).collect()
}

impl Trajectories {
    /// Follows tracks on movers through the whole clip: all that are on an object, and of the others
    /// those that live in the canonical frame.
    pub(super) fn of(track: &Track) -> Trajectories {
        let frames = track.masks.len();
        let canonical = canonical_frame(&track.masks);
        let (owners, lifted): (Vec<usize>, Vec<_>) = lifted(track).into_iter().unzip();
        let at = |t: &(usize, Vec<DVec3>), frame: usize| {
            frame.checked_sub(t.0).and_then(|k| t.1.get(k)).copied()
        };
        let mut all = Vec::new();
        for (i, mover) in track.movers.iter().enumerate() {
            let own = lifted.iter().zip(&owners).filter(|(_, owner)| **owner == i + 1);
            let own = own.map(|(own, _)| own).filter(|own| own.1.len() >= LEAST_LIFE);
            let paths: Vec<(usize, Vec<DVec3>)> =
                own.map(|own| (own.0, inside(own, mover))).collect();
            let middles: Vec<DVec3> = paths.iter().map(|(_, path)| path[path.len() / 2]).collect();
            let kept = paths.iter().zip(near_the_others(&middles)).filter(|(_, near)| *near);
            all.extend(kept.map(|((first, path), _)| Trajectory {
                owner: i + 1,
                positions: with_mover(*first, path, mover, frames),
            }));
        }
        // What is on no object.
        let others: Vec<Trajectory> = lifted
            .par_iter()
            .zip(&owners)
            .filter(|(_, owner)| **owner == 0)
            .filter_map(|(own, _)| {
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
                Some(Trajectory { owner: 0, positions: smoothed(&path, canonical) })
            })
            .collect();
        all.extend(others);
        Trajectories { canonical, all }
    }

    /// Where a point that a pixel of a frame shows is in the canonical frame: it goes as the nearest
    /// trajectory on the same object does. None where there is no trajectory.
    pub(super) fn to_canonical(
        &self,
        track: &Track,
        frame: usize,
        pixel: DVec2,
        point: DVec3,
    ) -> Option<DVec3> {
        let owner = value(&track.owners[frame], pixel) as usize;
        let distance = |t: &&Trajectory| t.positions[frame].distance_squared(point);
        let nearest = |on: &dyn Fn(&&Trajectory) -> bool| {
            let on = self.all.iter().filter(on);
            on.min_by(|a, b| distance(a).total_cmp(&distance(b)))
        };
        let same = nearest(&|t| t.owner == owner);
        let path = &same.or_else(|| nearest(&|_| true))?.positions;
        let (here, there) = (path[frame], path[self.canonical]);
        let mover =
            owner.checked_sub(1).and_then(|i| track.movers.get(i)).filter(|_| same.is_some());
        let Some(mover) = mover else { return Some(point - here + there) };
        // The offset from the trajectory turns with the object.
        let turned = mover.world_from_object(self.canonical).rotation
            * mover.world_from_object(frame).rotation.conjugate();
        Some(turned * (point - here) + there)
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

/// The mean of a path around one of its places, in a Gaussian window over time.
fn mean(path: &[DVec3], place: usize) -> DVec3 {
    let reach = (3.0 * SMOOTHING).ceil() as usize;
    let (mut sum, mut weight) = (DVec3::ZERO, 0.0);
    let last = (place + reach).min(path.len() - 1);
    for (other, &position) in
        path.iter().enumerate().take(last + 1).skip(place.saturating_sub(reach))
    {
        let d = place.abs_diff(other) as f64 / SMOOTHING;
        let w = (-0.5 * d * d).exp();
        sum += w * position;
        weight += w;
    }
    sum / weight
}

/// A path smoothed over time, shifted so that it stays in place in the canonical frame.
fn smoothed(path: &[DVec3], canonical: usize) -> Vec<DVec3> {
    let shift = path[canonical] - mean(path, canonical);
    (0..path.len()).map(|frame| mean(path, frame) + shift).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::sim3::Sim3;
    use glam::DQuat;

    #[test]
    fn what_is_not_seen_goes_on_with_its_object() {
        // It turns by a tenth of a radian a frame and goes along x; it is known from frame 1 on.
        let at = |frame: usize| Sim3 {
            scale: 0.5,
            rotation: DQuat::from_rotation_y(0.1 * frame as f64),
            translation: DVec3::new(0.2 * frame as f64, 0.0, 3.0),
        };
        let mover = Mover { first: 1, world_from_object: (1..9).map(at).collect() };
        let point = DVec3::new(0.3, -0.2, 0.4);
        let seen = (4, (4..7).map(|frame| at(frame).apply(point)).collect());
        let path = with_mover(4, &inside(&seen, &mover), &mover, 10);
        for (frame, position) in path.iter().enumerate() {
            let expected = at(frame.clamp(1, 8)).apply(point);
            assert!(position.distance(expected) < 1e-9, "{frame}: {position} {expected}");
        }
    }

    #[test]
    fn what_lies_far_off_is_not_on_the_object() {
        let mut points: Vec<DVec3> =
            (0..20).map(|i| DVec3::new(f64::from(i % 5), f64::from(i / 5), 0.0)).collect();
        points.push(DVec3::new(2.0, 2.0, 20.0));
        let near = near_the_others(&points);
        assert!(near[..20].iter().all(|near| *near) && !near[20], "{near:?}");
        assert!(near_the_others(&[]).is_empty());
    }
}
