//! Depth of movers: each object's shape and path up to one scale, then the scale.
//!
//! Up to scale: where an object moves rigidly, its points are to the camera what a static world is,
//! and the same structure from motion solves them. Otherwise the object stands upright before the
//! camera, and its size in the picture tells how its distance changes. The scale is
//! [`super::distance`]'s.

use glam::{DVec2, DVec3};
use rayon::prelude::*;

use super::cameras::{self, Cameras, Focal};
use super::distance::{Behind, distances};
use super::masks::regions;
use super::objects::{self, Object};
use super::observer::{Progress, Work};
use super::{FocalSource, Mover, Stage, quantile, unfollowed};
use crate::geometry::sim3::Sim3;
use crate::observe::{NeighbourFlow, PointTrack};
use crate::types::{Image, Pose};

/// Confidence of a mover's depth whose scale is known, and of one that only has a bound.
pub(super) const KNOWN: f32 = 0.4;
pub(super) const BOUND: f32 = 0.2;
/// Inverse depth of a thing of which only that is known what it hides, relative to what it hides.
pub(super) const NEARER: f64 = 1.25;

/// A structure from motion of an object is believed with this share of inliers, this reprojection
/// error (pixels at 320 wide) and this parallax (degrees).
const RIGID: (f64, f64, f64) = (0.6, 0.8, 4.0);
/// A point whose residuals are so many times the usual does not go with its object.
const ODD: f64 = 3.0;
/// No point of an object is farther before or behind its middle than this share of the depth.
const MOST_BEYOND: f64 = 0.7;

/// Standard deviation of the change of an object's depth from frame to frame that its size in the
/// picture tells, logarithm.
const UPRIGHT_DRIFT: f64 = 0.06;
/// A structure from motion drifts so many times as fast as if the errors of its tracks were
/// independent: those of neighbours are not.
const TOGETHER: f64 = 40.0;

/// What is known of an object in one frame.
pub(super) struct Frame {
    /// Depth (z) of its middle, in a unit that all frames share.
    pub depth: f64,
    /// Its middle's pixel.
    pub middle: DVec2,
    /// Depth of each track relative to the middle's, if the track lives in this frame.
    pub relative: Vec<Option<f64>>,
    /// Where the structure from motion holds.
    pub view_from_object: Option<Pose>,
}

/// An object up to scale.
pub(super) struct Shape {
    /// From the object's first frame on.
    pub frames: Vec<Frame>,
    /// Standard deviation of the change of depth from each frame to the next, logarithm.
    pub drift: Vec<f64>,
    /// The middle in the object's own frame.
    middle: DVec3,
    pub rigid: bool,
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

impl Lifted {
    /// No object is known in what the masks show to move.
    pub fn nothing(masks: &[Image]) -> Lifted {
        Lifted {
            pixels: masks.iter().map(|mask| vec![None; mask.pixels.len()]).collect(),
            movers: Vec::new(),
            owners: masks.iter().map(|mask| Image::new(mask.width, mask.height, 1)).collect(),
        }
    }
}

/// Lifts all movers, before the static world.
pub(super) fn lift(
    frames: &[Image],
    cameras: &Cameras,
    flow: &NeighbourFlow,
    masks: &[Image],
    behind: &[Behind<'_>],
) -> Lifted {
    let mut objects = objects::find(frames, flow, masks);
    let mut shapes: Vec<Shape> =
        objects.iter().map(|object| shape(object, cameras, flow)).collect();
    let mut owners: Vec<Vec<Option<u16>>> =
        (0..masks.len()).into_par_iter().map(|f| owners(&objects, &masks[f], f)).collect();
    let points: Vec<Vec<DVec2>> =
        (0..masks.len()).map(|f| followed(&objects, &shapes, f)).collect();
    let spacing = objects::spacing(masks) as f64;
    let parts = unfollowed::find(frames, masks, &points, spacing);
    if let Some(parts) = &parts {
        let own = Some(objects.len() as u16);
        for (owners, part) in owners.iter_mut().zip(parts) {
            owners.iter_mut().zip(part).filter(|(_, part)| **part).for_each(|(o, _)| *o = own);
        }
    }
    let mut scaled: Vec<(Vec<f64>, f32)> = objects
        .par_iter()
        .zip(&shapes)
        .enumerate()
        .map(|(i, (object, shape))| distances(i, object, shape, cameras, &owners, behind))
        .collect();
    let painted = |objects: &[Object], shapes: &[Shape], scaled: &[(Vec<f64>, f32)]| {
        let paint = |f: usize| paint(f, objects, shapes, scaled, &owners[f], flow.width);
        (0..masks.len()).into_par_iter().map(paint).collect::<Vec<_>>()
    };
    let mut pixels = painted(&objects, &shapes, &scaled);
    if let Some(parts) = &parts {
        let (shape, depths) = before(parts, &pixels, behind, flow.width);
        objects.push(Object { tracks: Vec::new(), first: 0, end: masks.len() });
        shapes.push(shape);
        scaled.push((depths, BOUND));
        pixels = painted(&objects, &shapes, &scaled);
    }
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

/// The followed points of a frame that go with their object.
fn followed(objects: &[Object], shapes: &[Shape], frame: usize) -> Vec<DVec2> {
    let of = |(object, shape): (&Object, &Shape)| {
        let k = frame.checked_sub(object.first).filter(|k| *k < shape.frames.len());
        let relative = k.map_or(&[][..], |k| &shape.frames[k].relative);
        let goes = object.tracks.iter().zip(relative).filter(|(_, relative)| relative.is_some());
        goes.filter_map(|(track, _)| track.at(frame)).collect::<Vec<_>>()
    };
    objects.iter().zip(shapes).flat_map(of).collect()
}

/// The shape and the depth of parts of movers that are not followed: flat, and nearer than what they
/// hide, followed movers (`pixels`: their inverse depth) and the static world.
fn before(
    parts: &[Vec<bool>],
    pixels: &[Vec<Option<(f32, f32)>>],
    behind: &[Behind<'_>],
    width: usize,
) -> (Shape, Vec<f64>) {
    let known: Vec<Option<(DVec2, f64)>> = (0..parts.len())
        .map(|f| {
            let own: Vec<usize> = (0..parts[f].len()).filter(|i| parts[f][*i]).collect();
            let middle = |k: usize| {
                let place = |i: &usize| [i % width, i / width][k] as f64 + 0.5;
                quantile(own.iter().map(place).collect(), 0.5)
            };
            let movers = pixels[f].iter().flatten().map(|(inverse, _)| f64::from(*inverse));
            let still = own.iter().map(|i| f64::from(behind[f].inverse[*i]));
            let hidden = [movers.collect::<Vec<_>>(), still.collect()]
                .into_iter()
                .filter(|hidden| !hidden.is_empty())
                .map(|hidden| quantile(hidden, 0.5))
                .fold(0.0, f64::max);
            (hidden > 0.0 && !own.is_empty())
                .then(|| (DVec2::new(middle(0), middle(1)), 1.0 / (NEARER * hidden)))
        })
        .collect();
    // Where it is not seen it is as in the nearest frame in which it is.
    let seen: Vec<usize> = (0..known.len()).filter(|f| known[*f].is_some()).collect();
    let (middles, depths): (Vec<DVec2>, Vec<f64>) = (0..known.len())
        .map(|f| {
            let nearest = seen.iter().min_by_key(|s| s.abs_diff(f));
            nearest.and_then(|s| known[*s]).unwrap_or((DVec2::ZERO, 1.0))
        })
        .unzip();
    let frame = |(middle, depth): (&DVec2, &f64)| Frame {
        depth: *depth,
        middle: *middle,
        relative: Vec::new(),
        view_from_object: None,
    };
    let frames = middles.iter().zip(&depths).map(frame).collect();
    let drift = vec![UPRIGHT_DRIFT; depths.len().saturating_sub(1)];
    (Shape { frames, drift, middle: DVec3::ZERO, rigid: false }, depths)
}

/// An object's shape and path up to scale: rigid in the frames in which it is, upright in the others.
fn shape(object: &Object, cameras: &Cameras, flow: &NeighbourFlow) -> Shape {
    let upright = upright(object);
    let Some(Rigid { run, middle, frames: rigid, drift }) = rigid(object, cameras, flow) else {
        return upright;
    };
    let Shape { mut frames, drift: mut drifts, .. } = upright;
    drifts[run.start..run.end - 1].fill(drift);
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
    Shape { frames, drift: drifts, middle, rigid: rigid_share > 0.8 }
}

/// A structure from motion of an object.
struct Rigid {
    /// The run of the object's frames that it holds for.
    run: std::ops::Range<usize>,
    /// The middle in the object's own frame.
    middle: DVec3,
    frames: Vec<Frame>,
    /// Standard deviation of the change of depth from frame to frame, logarithm.
    drift: f64,
}

fn rigid(object: &Object, cameras: &Cameras, flow: &NeighbourFlow) -> Option<Rigid> {
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
    // Half the size in the picture, pixels.
    let half = |f: usize| {
        let seen = || tracks.iter().filter_map(|track| track.at(f));
        let extent = |k: usize| {
            let ends = [0.05, 0.95].map(|share| quantile(seen().map(|p| p[k]).collect(), share));
            ends[1] - ends[0]
        };
        0.5 * extent(0).max(extent(1))
    };
    let drift = {
        let halves = quantile((0..run.len()).map(half).collect(), 0.5);
        let seen = tracks.iter().map(|track| track.pixels.len()).sum::<usize>() as f64;
        let (life, points) = (seen / tracks.len() as f64, seen / run.len() as f64);
        (TOGETHER * solved.rms / (halves * points.sqrt() * life)).min(UPRIGHT_DRIFT)
    };
    let frames: Vec<Frame> = (0..run.len())
        .map(|f| {
            let centre = solved.poses[f].apply(middle);
            // What is not known lies as deep as the middle, to about half of the object's size.
            let half = half(f) / cameras.intrinsics.fx;
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
    let sound = drift.is_finite() && frames.iter().all(|f| f.depth > 0.0 && f.depth.is_finite());
    sound.then_some(Rigid { run, middle, frames, drift })
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
    let drift = vec![UPRIGHT_DRIFT; frames.saturating_sub(1)];
    let frames = (0..frames)
        .map(|f| Frame {
            depth: depth[f],
            middle: middle[f],
            relative: object.tracks.iter().map(|t| t.at(object.first + f).map(|_| 1.0)).collect(),
            view_from_object: None,
        })
        .collect();
    Shape { frames, drift, middle: DVec3::ZERO, rigid: false }
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
            let k = frame.checked_sub(objects.get(owner)?.first)?;
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
    use super::super::sliding::{self, FRAMES, HEIGHT, STEP, WALL, WIDTH, map, within};
    use super::*;

    #[test]
    fn what_is_not_followed_lies_before_what_is() {
        // A mover whose left half goes down evenly; on the right half flow is different at every
        // pixel, and the way back never leads back.
        let left = |frame: usize, p: DVec2| {
            within(p, (8.0, 3.0 + frame as f64), (32.0, 33.0 + frame as f64))
        };
        let right = |frame: usize, p: DVec2| {
            within(p, (32.0, 3.0 + frame as f64), (56.0, 33.0 + frame as f64))
        };
        let flow = sliding::flow(|frame, p| {
            if left(frame, p) {
                DVec2::new(0.0, 1.0)
            } else if right(frame, p) {
                DVec2::new(3.0 + 2.0 * p.x.sin(), 3.0 * (5.0 * p.y).cos())
            } else {
                sliding::wall()
            }
        });
        let frame = |f: usize| {
            let mut image = Image::new(WIDTH, HEIGHT, 3);
            for (i, pixel) in image.pixels.chunks_exact_mut(3).enumerate() {
                pixel.fill(if right(f, sliding::centre(i)) { 0.8 } else { 0.3 });
            }
            image
        };
        let frames: Vec<Image> = (0..FRAMES).map(frame).collect();
        let mask = |f: usize| map(move |p| f32::from(u8::from(left(f, p) || right(f, p))));
        let masks: Vec<Image> = (0..FRAMES).map(mask).collect();
        let (inverse, confidence) =
            (map(|_| (1.0 / WALL) as f32).pixels, vec![1.0; masks[0].pixels.len()]);
        let behind = vec![Behind { inverse: &inverse, confidence: &confidence }; FRAMES];
        let lifted = lift(&frames, &sliding::cameras(STEP), &flow, &masks, &behind);
        assert_eq!(lifted.movers.len(), 2);
        for f in 0..FRAMES {
            let depth = |half: &dyn Fn(usize, DVec2) -> bool, owner: f32| {
                let own = (0..masks[f].pixels.len()).filter(|i| half(f, sliding::centre(*i)));
                let own: Vec<usize> =
                    own.filter(|i| lifted.owners[f].pixels[*i] == owner).collect();
                assert!(own.len() > 24 * 30 * 9 / 10, "frame {f}, owner {owner}: {}", own.len());
                let inverse = own.iter().map(|i| f64::from(lifted.pixels[f][*i].unwrap().0));
                quantile(inverse.collect(), 0.5)
            };
            let ratio = depth(&right, 2.0) / depth(&left, 1.0);
            assert!((ratio / NEARER - 1.0).abs() < 0.02, "frame {f}: {ratio}");
        }
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
