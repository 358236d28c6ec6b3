//! Depth of movers: each object's shape and path up to one scale, then the scale.
//!
//! Up to scale: where an object moves rigidly, its points are to the camera what a static world is,
//! and the same structure from motion solves them. Otherwise the object stands upright before the
//! camera, and its size in the picture tells how its distance changes. The scale comes from where the
//! object touches static ground, if it does so in most frames; else from the smoothness of its path
//! ([`super::smooth`]), if that decides it; else only the bound is known that it is nearer than what
//! it hides.

use glam::{DVec2, DVec3};
use rayon::prelude::*;

use super::cameras::{self, Cameras, Focal};
use super::masks::regions;
use super::objects::{self, Object};
use super::observer::{Progress, Work};
use super::smooth::{self, Place};
use super::{FocalSource, Mover, Stage, quantile};
use crate::geometry::sim3::Sim3;
use crate::observe::{NeighbourFlow, PointTrack};
use crate::types::{Image, Pose};

/// Confidence of a mover's depth whose scale is known, and of one that only has a bound.
pub(super) const KNOWN: f32 = 0.4;
pub(super) const BOUND: f32 = 0.2;

/// A structure from motion of an object is believed with this share of inliers, this reprojection
/// error (pixels at 320 wide) and this parallax (degrees).
const RIGID: (f64, f64, f64) = (0.6, 0.8, 4.0);
/// Relative standard deviation of a contact's depth, and of the change of depth from frame to frame
/// by size, and by structure.
const CONTACT: f64 = 0.03;
const STEP: (f64, f64) = (0.01, 0.002);
/// A contact agrees with the path within this relative difference.
const AGREES: f64 = 0.1;
/// An object touches the ground if so many of its contacts agree.
const TOUCHES: f64 = 0.5;
/// A scale is known that has less than this relative deviation.
const DECIDED: f64 = 0.2;
/// How much nearer than what it hides a thing is that touches nothing: mean and deviation of the
/// logarithm. Few things fly right before a wall or right before the camera.
const BEFORE: (f64, f64) = (0.4, 0.3);

/// A point whose residuals are so many times the usual does not go with its object.
const ODD: f64 = 3.0;
/// No point of an object is farther before or behind its middle than this share of the depth.
const MOST_BEYOND: f64 = 0.7;

/// What is known of an object in one frame.
struct Frame {
    /// Depth (z) of its middle, in a unit that all frames share.
    depth: f64,
    /// Its middle's pixel.
    middle: DVec2,
    /// Depth of each track relative to the middle's, if the track lives in this frame.
    relative: Vec<Option<f64>>,
    /// Where the structure from motion holds.
    view_from_object: Option<Pose>,
}

/// An object up to scale.
struct Shape {
    /// From the object's first frame on.
    frames: Vec<Frame>,
    /// The middle in the object's own frame.
    middle: DVec3,
    rigid: bool,
}

/// The movers of a clip in three dimensions.
pub(super) struct Lifted {
    /// Inverse depth and confidence of the movers' pixels, frame by frame; none where no object is.
    pub pixels: Vec<Vec<Option<(f32, f32)>>>,
    /// As [`super::Track`] has them.
    pub movers: Vec<Mover>,
    /// As [`super::Track`] has them.
    pub owners: Vec<Image>,
}

/// Lifts all movers. `behind` is the static world's inverse depth, behind the movers too.
pub(super) fn lift(
    frames: &[Image],
    cameras: &Cameras,
    flow: &NeighbourFlow,
    masks: &[Image],
    behind: &[&[f32]],
) -> Lifted {
    let objects = objects::find(frames, flow, masks);
    let shapes: Vec<Shape> = objects.iter().map(|object| shape(object, cameras, flow)).collect();
    let owners: Vec<Vec<Option<u16>>> =
        (0..masks.len()).into_par_iter().map(|f| owners(&objects, &masks[f], f)).collect();
    let scaled: Vec<(Vec<f64>, f32)> = objects
        .par_iter()
        .zip(&shapes)
        .enumerate()
        .map(|(i, (object, shape))| scale(i, object, shape, cameras, &owners, behind, flow.width))
        .collect();
    let pixels = (0..masks.len())
        .into_par_iter()
        .map(|f| paint(f, &objects, &shapes, &scaled, &owners[f], flow.width))
        .collect();
    let movers = objects
        .iter()
        .zip(&shapes)
        .zip(&scaled)
        .map(|((object, shape), (depths, _))| Mover {
            first: object.first,
            world_from_object: motion(object, shape, depths, cameras),
        })
        .collect();
    let numbered = |owner: &Option<u16>| owner.map_or(0.0, |i| f32::from(i) + 1.0);
    let owners = owners
        .iter()
        .zip(masks)
        .map(|(own, mask)| Image { pixels: own.iter().map(numbered).collect(), ..*mask })
        .collect();
    Lifted { pixels, movers, owners }
}

/// Where an object is, frame by frame: as its structure from motion says; elsewhere it keeps the
/// orientation in the world that it had, and its middle goes on.
fn motion(object: &Object, shape: &Shape, depths: &[f64], cameras: &Cameras) -> Vec<Sim3> {
    let known: Vec<Option<Sim3>> = shape
        .frames
        .iter()
        .zip(depths)
        .enumerate()
        .map(|(k, (frame, depth))| {
            let view_from_object = frame.view_from_object?;
            let scale = depth / frame.depth;
            let world_from_view = cameras.poses[object.first + k].inverse();
            let world_from_object = world_from_view
                * Pose::new(view_from_object.rotation, scale * view_from_object.translation);
            let Pose { rotation, translation } = world_from_object;
            Some(Sim3 { scale, rotation, translation })
        })
        .collect();
    let run: Vec<usize> = (0..known.len()).filter(|k| known[*k].is_some()).collect();
    shape
        .frames
        .iter()
        .zip(depths)
        .enumerate()
        .map(|(k, (frame, depth))| {
            if let Some(known) = known[k] {
                return known;
            }
            let nearest = run.iter().min_by_key(|r| r.abs_diff(k)).and_then(|r| known[*r]);
            let nearest = nearest.unwrap_or(Sim3::IDENTITY);
            let ray = cameras.intrinsics.ray(frame.middle);
            let middle = cameras.poses[object.first + k].inverse().apply(ray * *depth);
            let translation = middle - nearest.scale * (nearest.rotation * shape.middle);
            Sim3 { translation, ..nearest }
        })
        .collect()
}

/// By pixel of a mover, the object whose point is nearest to it within its region.
fn owners(objects: &[Object], mask: &Image, frame: usize) -> Vec<Option<u16>> {
    let w = mask.width as usize;
    let mut points: Vec<(u16, DVec2)> = Vec::new();
    for (i, object) in objects.iter().enumerate() {
        points.extend(object.tracks.iter().filter_map(|t| Some((i as u16, t.at(frame)?))));
    }
    let mut out = vec![None; mask.pixels.len()];
    for (region, _) in regions(&mask.pixels, w, true) {
        let own: Vec<&(u16, DVec2)> = {
            let inside: std::collections::HashSet<usize> = region.iter().copied().collect();
            let place = |p: DVec2| {
                let x = (p.x.max(0.0) as usize).min(w - 1);
                (p.y.max(0.0) as usize).min(mask.height as usize - 1) * w + x
            };
            points.iter().filter(|(_, p)| inside.contains(&place(*p))).collect()
        };
        for i in region {
            let p = DVec2::new((i % w) as f64 + 0.5, (i / w) as f64 + 0.5);
            let distance = |q: &&&(u16, DVec2)| q.1.distance_squared(p);
            out[i] = own.iter().min_by(|a, b| distance(a).total_cmp(&distance(b))).map(|q| q.0);
        }
    }
    out
}

/// An object's shape and path up to scale: rigid in the frames in which it is, upright in the others.
fn shape(object: &Object, cameras: &Cameras, flow: &NeighbourFlow) -> Shape {
    let upright = upright(object);
    let Some((run, middle, rigid)) = rigid(object, cameras, flow) else { return upright };
    let mut frames = upright.frames;
    for (edge, rest) in [(run.start, 0..run.start), (run.end - 1, run.end..frames.len())] {
        let known = &rigid[edge - run.start];
        let ratio = known.depth / frames[edge].depth;
        let shift = known.middle - frames[edge].middle;
        for frame in &mut frames[rest] {
            frame.depth *= ratio;
            frame.middle += shift;
        }
    }
    let rigid_share = run.len() as f64 / frames.len() as f64;
    frames.iter_mut().skip(run.start).zip(rigid).for_each(|(to, from)| *to = from);
    Shape { frames, middle, rigid: rigid_share > 0.8 }
}

/// Structure from motion of a rigid object: the run of its frames that it holds for, the middle in
/// the object's own frame, and these frames.
fn rigid(
    object: &Object,
    cameras: &Cameras,
    flow: &NeighbourFlow,
) -> Option<(std::ops::Range<usize>, DVec3, Vec<Frame>)> {
    let frames = object.end - object.first;
    if frames < 5 || object.tracks.len() < 30 {
        return None;
    }
    let mut tracks = object.tracks.clone();
    tracks.iter_mut().for_each(|track| track.first -= object.first);
    let focal =
        Focal { intrinsics: cameras.intrinsics, source: FocalSource::Given, deviation: 0.0 };
    let mut nothing = |_: Stage, _: f64| Ok(());
    let mut progress = Progress(&mut nothing);
    let mut work = Work::new(&mut progress);
    let weights = vec![1.0; tracks.len()];
    let posing = cameras::pose(&tracks, &weights, &focal, frames, 0, &mut work, "object").ok()?;
    let run = posing.longest_run();
    if run.len() < 5 {
        return None;
    }
    // The tracks within the run.
    let within: Vec<Option<PointTrack>> = tracks.iter().map(|track| clipped(track, &run)).collect();
    let places: Vec<usize> = (0..within.len()).filter(|i| within[*i].is_some()).collect();
    let tracks: Vec<PointTrack> = within.into_iter().flatten().collect();
    let weights = vec![1.0; tracks.len()];
    let solved = if run.len() == frames {
        // Every track lies within.
        posing.adjusted(&tracks, &weights, &focal)
    } else {
        cameras::reconstruct(&tracks, &weights, &focal, run.len(), 0, &mut work, "object")
    };
    let solved = solved.ok()?;
    let size = (flow.width as f64 / 320.0).max(1.0);
    let parallax = solved.parallax(&tracks, &weights).to_degrees();
    if solved.inlier_share < RIGID.0 || solved.rms > RIGID.1 * size || parallax < RIGID.2 {
        return None;
    }
    let points: Vec<Option<DVec3>> = (0..tracks.len()).map(|i| solved.point(&tracks, i)).collect();
    let certainty: Vec<_> = (0..tracks.len()).map(|i| solved.certainty(&tracks, i)).collect();
    let usual = quantile(certainty.iter().flatten().map(|c| c.residual).collect(), 0.5);
    // Variance of a point's depth relative to the depth; none for what does not go with the object.
    let variance = |i: usize| {
        let known = certainty[i].filter(|c| c.residual <= ODD * usual)?;
        Some((usual.max(1.0) * known.deviation).powi(2))
    };
    let coordinate = |k: usize| quantile(points.iter().flatten().map(|p| p[k]).collect(), 0.5);
    let middle = DVec3::new(coordinate(0), coordinate(1), coordinate(2));
    let frames: Vec<Frame> = (0..run.len())
        .map(|f| {
            let centre = solved.poses[f].apply(middle);
            // What is not known lies as deep as the middle, to about half of the object's size.
            let seen = || tracks.iter().filter_map(|track| track.at(f));
            let extent = |k: usize| {
                let ends =
                    [0.05, 0.95].map(|share| quantile(seen().map(|p| p[k]).collect(), share));
                ends[1] - ends[0]
            };
            let half = 0.5 * extent(0).max(extent(1)) / cameras.intrinsics.fx;
            let mut relative = vec![None; object.tracks.len()];
            for (i, place) in places.iter().enumerate() {
                let alive = points[i].filter(|_| tracks[i].at(f).is_some());
                relative[*place] = alive.zip(variance(i)).map(|(point, variance)| {
                    let beyond = solved.poses[f].apply(point).z / centre.z - 1.0;
                    let share = half * half / (half * half + variance);
                    1.0 + (share * beyond).clamp(-MOST_BEYOND, MOST_BEYOND)
                });
            }
            Frame {
                depth: centre.z,
                middle: cameras.intrinsics.project(centre),
                relative,
                view_from_object: Some(solved.poses[f]),
            }
        })
        .collect();
    frames.iter().all(|f| f.depth > 0.0 && f.depth.is_finite()).then_some((run, middle, frames))
}

/// A track's part within a run of frames, which becomes the whole clip.
fn clipped(track: &PointTrack, run: &std::ops::Range<usize>) -> Option<PointTrack> {
    let (first, end) = (track.first.max(run.start), track.end().min(run.end));
    (end >= first + 2).then(|| {
        let part = track.part(first..end);
        PointTrack { first: first - run.start, ..part }
    })
}

/// An object that stands upright: its distance by its size.
fn upright(object: &Object) -> Shape {
    let frames = object.end - object.first;
    let alive = |f: usize| object.tracks.iter().filter(move |t| t.at(f).is_some());
    let best = (object.first..object.end).max_by_key(|f| alive(*f).count()).unwrap_or(object.first);
    let mean = |f: usize| {
        let count = alive(f).count().max(1) as f64;
        alive(f).filter_map(|t| t.at(f)).sum::<DVec2>() / count
    };
    let mut depth = vec![1.0; frames];
    let mut middle = vec![mean(best); frames];
    let mut walk = |from: usize, to: usize| {
        let (a, b) = (from - object.first, to - object.first);
        let both: Vec<(DVec2, DVec2)> =
            object.tracks.iter().filter_map(|t| Some((t.at(from)?, t.at(to)?))).collect();
        let mut ratios = Vec::new();
        for i in 0..both.len() {
            // Partners a fixed stride away: pairs of all distances, the same each time.
            for stride in [7, 31, 101] {
                let j = (i + stride) % both.len();
                let before = both[i].0.distance(both[j].0);
                if before > 6.0 {
                    ratios.push(both[i].1.distance(both[j].1) / before);
                }
            }
        }
        let ratio = if ratios.len() >= 10 { quantile(ratios, 0.5) } else { 1.0 };
        depth[b] = depth[a] / ratio.clamp(0.8, 1.25);
        let shift = |k: usize| quantile(both.iter().map(|(p, q)| (*q - *p)[k]).collect(), 0.5);
        middle[b] = middle[a] + DVec2::new(shift(0), shift(1));
    };
    (best + 1..object.end).for_each(|f| walk(f - 1, f));
    (object.first..best).rev().for_each(|f| walk(f + 1, f));
    let frames = (0..frames)
        .map(|f| Frame {
            depth: depth[f],
            middle: middle[f],
            relative: object.tracks.iter().map(|t| t.at(object.first + f).map(|_| 1.0)).collect(),
            view_from_object: None,
        })
        .collect();
    Shape { frames, middle: DVec3::ZERO, rigid: false }
}

/// The depth of an object's middle in the world's unit, frame by frame, and its confidence.
fn scale(
    index: usize,
    object: &Object,
    shape: &Shape,
    cameras: &Cameras,
    owners: &[Vec<Option<u16>>],
    behind: &[&[f32]],
    width: usize,
) -> (Vec<f64>, f32) {
    let n = shape.frames.len();
    let path: Vec<f64> = shape.frames.iter().map(|f| f.depth.ln()).collect();
    let contacts: Vec<Option<f64>> = (0..n)
        .map(|k| {
            let f = object.first + k;
            let (depth, pixel) = contact(index, &owners[f], behind[f], width)?;
            let near = object.tracks.iter().zip(&shape.frames[k].relative);
            let near = near.filter_map(|(t, r)| Some((t.at(f)?.distance(pixel), (*r)?)));
            let relative = near.min_by(|a, b| a.0.total_cmp(&b.0)).map_or(1.0, |near| near.1);
            Some((depth / relative).ln())
        })
        .collect();
    let step = if shape.rigid { STEP.1 } else { STEP.0 };
    let touching = touched(&path, &contacts, step);
    if let Some(path) = touching {
        return (path, KNOWN);
    }
    let unit = {
        let places: Vec<Place> = shape
            .frames
            .iter()
            .enumerate()
            .map(|(k, frame)| {
                let world_from_view = cameras.poses[object.first + k].inverse();
                let relative = cameras.intrinsics.ray(frame.middle) * frame.depth;
                let along = if shape.rigid { 0.005 } else { 0.1 };
                Place {
                    relative: world_from_view.rotation * relative,
                    centre: world_from_view.translation,
                    across: 0.1 * frame.depth / cameras.intrinsics.fx,
                    along: along * frame.depth,
                }
            })
            .collect();
        smooth::unit(&places)
    };
    // Nearer than what it hides, in nearly every frame.
    let bounds = (0..n)
        .filter_map(|k| {
            let f = object.first + k;
            let hidden: Vec<f64> = (0..owners[f].len())
                .filter(|i| owners[f][*i] == Some(index as u16))
                .map(|i| f64::from(behind[f][i]))
                .collect();
            (!hidden.is_empty()).then(|| -quantile(hidden, 0.8).max(1e-3).ln() - path[k])
        })
        .collect();
    let (mut logarithm, mut deviation) = (quantile(bounds, 0.1) - BEFORE.0, BEFORE.1);
    if let Some(unit) = unit.filter(|u| u.inverse > 0.0 && u.deviation < u.inverse) {
        let (other, its) = (-unit.inverse.ln(), unit.deviation / unit.inverse);
        let (a, b) = (deviation.powi(-2), its.powi(-2));
        (logarithm, deviation) = ((a * logarithm + b * other) / (a + b), (a + b).sqrt().recip());
    }
    let confidence = if deviation < DECIDED { KNOWN } else { BOUND };
    (shape.frames.iter().map(|f| f.depth * logarithm.exp()).collect(), confidence)
}

/// Where an object meets static ground: the ground's depth there, and the pixel. `None` where its
/// lower end is cut off by the picture or hidden.
fn contact(
    index: usize,
    owners: &[Option<u16>],
    behind: &[f32],
    width: usize,
) -> Option<(f64, DVec2)> {
    let height = owners.len() / width;
    let own = |i: usize| owners[i] == Some(index as u16);
    let mut lowest: Vec<(usize, usize)> = Vec::new();
    let (mut top, mut bottom) = (usize::MAX, 0);
    for x in 0..width {
        let mut column = (0..height).filter(|y| own(y * width + x));
        let Some(first) = column.next() else { continue };
        let last = column.next_back().unwrap_or(first);
        (top, bottom) = (top.min(first), bottom.max(last));
        lowest.push((x, last));
    }
    // Masks overhang by a pixel or two.
    if lowest.len() < 3 || bottom + 3 >= height {
        return None;
    }
    let band = (0.06 * (bottom - top) as f64).max(2.0) as usize;
    let below = |(x, y): (usize, usize)| (y + 2) * width + x;
    lowest.retain(|at| at.1 + band >= bottom && owners[below(*at)].is_none());
    let inverse = quantile(lowest.iter().map(|at| f64::from(behind[below(*at)])).collect(), 0.5);
    let (x, y) = *lowest.get(lowest.len() / 2)?;
    (inverse > 0.0).then(|| (1.0 / inverse, DVec2::new(x as f64 + 0.5, y as f64 + 0.5)))
}

/// The path, scaled and bent so that it meets its contacts; `None` where they do not agree.
fn touched(path: &[f64], contacts: &[Option<f64>], step: f64) -> Option<Vec<f64>> {
    let n = path.len();
    let offsets: Vec<(usize, f64)> =
        contacts.iter().enumerate().filter_map(|(k, c)| Some((k, (*c)? - path[k]))).collect();
    if offsets.len() < 3 {
        return None;
    }
    // From the offset that most agree with.
    let agreeing =
        |o: &(usize, f64)| offsets.iter().filter(|p| (p.1 - o.1).abs() < 0.5 * AGREES).count();
    let start = offsets.iter().max_by_key(|o| agreeing(o))?.1;
    let mut bent: Vec<f64> = path.iter().map(|p| p + start).collect();
    for _ in 0..10 {
        // Tridiagonal: contacts pull with a weight that falls beyond their deviation, steps keep the
        // shape of the path.
        let stiff = step.powi(-2);
        let (mut diagonal, mut right) = (vec![1e-9; n], vec![0.0; n]);
        for (k, contact) in contacts.iter().enumerate() {
            let Some(contact) = contact else { continue };
            let off = (contact - bent[k]) / CONTACT;
            let weight = CONTACT.powi(-2) / (1.0 + off * off).powi(2);
            diagonal[k] += weight;
            right[k] += weight * contact;
        }
        for k in 0..n - 1 {
            let change = path[k + 1] - path[k];
            diagonal[k] += stiff;
            diagonal[k + 1] += stiff;
            right[k] -= stiff * change;
            right[k + 1] += stiff * change;
        }
        for k in 1..n {
            let factor = stiff / diagonal[k - 1];
            diagonal[k] -= factor * stiff;
            right[k] += factor * right[k - 1];
        }
        bent[n - 1] = right[n - 1] / diagonal[n - 1];
        for k in (0..n - 1).rev() {
            bent[k] = (right[k] + stiff * bent[k + 1]) / diagonal[k];
        }
    }
    let agree = contacts.iter().zip(&bent).filter_map(|(c, b)| Some(((*c)? - b).abs() < AGREES));
    let agree = agree.filter(|a| *a).count();
    (agree as f64 >= TOUCHES * offsets.len() as f64).then(|| bent.iter().map(|b| b.exp()).collect())
}

/// Inverse depth and confidence of a frame's movers.
fn paint(
    frame: usize,
    objects: &[Object],
    shapes: &[Shape],
    scaled: &[(Vec<f64>, f32)],
    owners: &[Option<u16>],
    width: usize,
) -> Vec<Option<(f32, f32)>> {
    /// Points that a pixel's depth is the mean of.
    const NEAREST: usize = 4;
    let points: Vec<Vec<(DVec2, f64)>> = objects
        .iter()
        .zip(shapes)
        .map(|(object, shape)| {
            let Some(k) = frame.checked_sub(object.first).filter(|k| *k < shape.frames.len())
            else {
                return Vec::new();
            };
            let relative = object.tracks.iter().zip(&shape.frames[k].relative);
            relative.filter_map(|(t, r)| Some((t.at(frame)?, (*r)?))).collect()
        })
        .collect();
    owners
        .iter()
        .enumerate()
        .map(|(i, owner)| {
            let owner = usize::from((*owner)?);
            let k = frame.checked_sub(objects[owner].first)?;
            let (depth, confidence) = (*scaled[owner].0.get(k)?, scaled[owner].1);
            let p = DVec2::new((i % width) as f64 + 0.5, (i / width) as f64 + 0.5);
            let mut near: [(f64, f64); NEAREST] = [(f64::INFINITY, 1.0); NEAREST];
            for (q, relative) in &points[owner] {
                let d = q.distance_squared(p);
                if d < near[NEAREST - 1].0 {
                    let at = near.partition_point(|n| n.0 <= d);
                    near.copy_within(at..NEAREST - 1, at + 1);
                    near[at] = (d, *relative);
                }
            }
            let (mut sum, mut total) = (0.0, 0.0);
            for (d, relative) in near.iter().filter(|n| n.0.is_finite()) {
                let weight = 1.0 / (d + 1.0);
                sum += weight / relative;
                total += weight;
            }
            let inverse = if total > 0.0 { sum / total } else { 1.0 };
            Some(((inverse / depth) as f32, confidence))
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::super::sliding::*;
    use super::*;

    #[test]
    fn contacts_that_agree_bend_the_path_to_them() {
        // Up to scale the path is right; three contacts of ten are of something else.
        let path: Vec<f64> = (0..10).map(|k| (1.0 + 0.02 * f64::from(k)).ln()).collect();
        let contacts: Vec<Option<f64>> = (0..10)
            .map(|k| match k {
                4 => None,
                2 | 5 | 8 => Some((7.0 + f64::from(k)).ln()),
                _ => Some(path[k as usize] + 3f64.ln()),
            })
            .collect();
        let found = touched(&path, &contacts, 0.002).unwrap();
        for (depth, p) in found.iter().zip(&path) {
            assert!((depth / (3.0 * p.exp()) - 1.0).abs() < 0.01, "{depth}");
        }
        // Contacts that come from what happens to lie below do not agree.
        let below = |k: usize| Some((2.0 + k as f64).ln());
        assert!(touched(&path, &(0..10).map(below).collect::<Vec<_>>(), 0.002).is_none());
        assert!(touched(&path, &[None; 10], 0.002).is_none());
    }

    #[test]
    fn an_object_touches_the_ground_at_its_lower_end() {
        let (w, h) = (WIDTH as usize, HEIGHT as usize);
        let ground = map(|p| 0.1 + 0.02 * p.y as f32);
        let object = |bottom: f64| -> Vec<Option<u16>> {
            let on = |i| within(centre(i), (20.0, 8.0), (30.0, bottom));
            (0..w * h).map(|i| on(i).then_some(0)).collect()
        };
        let (depth, pixel) = contact(0, &object(30.0), &ground.pixels, w).unwrap();
        // Two rows below the last.
        assert!((1.0 / depth - (0.1 + 0.02 * 31.5)).abs() < 1e-6, "{depth}");
        assert_eq!(pixel.y, 29.5);
        assert!(contact(0, &object(39.0), &ground.pixels, w).is_none(), "it is cut off");
        assert!(contact(1, &object(30.0), &ground.pixels, w).is_none());
    }

    #[test]
    fn what_grows_comes_nearer() {
        // Twelve points that spread by 2 % a frame and go to the right.
        let track = |i: usize| PointTrack {
            first: 3,
            deviation: vec![0.1; 6],
            pixels: (0..6)
                .map(|k| {
                    let at = DVec2::new(10.0 * (i % 4) as f64, 10.0 * (i / 4) as f64);
                    at * 1.02f64.powi(k) + DVec2::new(f64::from(k), 0.0)
                })
                .collect(),
        };
        let object = Object { tracks: (0..12).map(track).collect(), first: 3, end: 9 };
        let shape = upright(&object);
        let ratio = shape.frames[0].depth / shape.frames[5].depth;
        assert!((ratio / 1.02f64.powi(5) - 1.0).abs() < 1e-6, "{ratio}");
    }
}
