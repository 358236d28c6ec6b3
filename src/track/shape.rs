//! An object's shape and its path, up to one scale.
//!
//! Where an object moves rigidly, its points are to the camera what a static world is, and the same
//! structure from motion solves them. Otherwise the object stands upright before the camera, and its
//! size in the picture tells how its distance changes.

use std::ops::Range;

use glam::{DVec2, DVec3};

use super::cameras::{self, Cameras, Focal};
use super::objects::Object;
use super::observer::{Progress, Work};
use super::{FocalSource, Stage, quantile};
use crate::observe::PointTrack;
use crate::types::Pose;

/// A structure from motion of an object is believed with this share of inliers, this reprojection
/// error (pixels at 320 wide) and this parallax (degrees).
const RIGID: (f64, f64, f64) = (0.6, 0.8, 4.0);
/// A point whose residuals are so many times the usual does not go with its object.
const ODD: f64 = 3.0;
/// No point of an object is farther before or behind its middle than this share of the depth.
const MOST_BEYOND: f64 = 0.7;

/// Frames of a structure from motion, at least.
const LEAST_RUN: usize = 5;
/// An object that in some frame looks deeper than this, relative to its narrower side in the picture, is
/// less deep: a limb that swings is seen to shift against the body, as if it were nearer or farther.
const DEEP: f64 = 1.2;
/// In this share of its frames an object is seen narrower than it is.
const WHOLE: f64 = 0.9;
/// In a frame in which it looks so deep the structure from motion is not believed at all: what a
/// solution is wrong by lies along the line of sight.
const DEEPEST: f64 = 3.5;

/// What is seen of things bulges towards the camera. A solution of which a hollow explains more than this
/// share of the depths' variance, less what a bulge explains in other frames, is the mirrored one, or none.
const HOLLOW: f64 = -0.03;

/// Standard deviation of the change of an object's depth from frame to frame that its size in the
/// picture tells, logarithm.
pub(super) const UPRIGHT_DRIFT: f64 = 0.06;
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
    pub middle: DVec3,
    /// Whether its structure from motion holds in nearly all frames.
    pub rigid: bool,
}

/// An object's shape and path up to scale: rigid in the frames in which it is, upright in the others.
pub(super) fn shape(object: &Object, cameras: &Cameras) -> Shape {
    let upright = upright(object);
    let Some(Rigid { run, middle, frames: rigid, drift }) = rigid(object, cameras) else {
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
    run: Range<usize>,
    /// The middle in the object's own frame.
    middle: DVec3,
    frames: Vec<Frame>,
    /// Standard deviation of the change of depth from frame to frame, logarithm.
    drift: f64,
}

fn rigid(object: &Object, cameras: &Cameras) -> Option<Rigid> {
    let frames = object.end - object.first;
    if frames < LEAST_RUN || object.tracks.len() < 30 {
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
    let mut run = posing.longest_run();
    let mut whole = (run.len() == frames).then_some(posing);
    while run.len() >= LEAST_RUN {
        // The tracks within the run.
        let parts: Vec<Option<PointTrack>> =
            tracks.iter().map(|track| clipped(track, &run)).collect();
        let places: Vec<usize> = (0..parts.len()).filter(|i| parts[*i].is_some()).collect();
        let parts: Vec<PointTrack> = parts.into_iter().flatten().collect();
        let weights = vec![1.0; parts.len()];
        let solved = match whole.take() {
            // Every track lies within.
            Some(posing) => posing.adjusted(&parts, &weights, &focal),
            None => {
                cameras::reconstruct(&parts, &weights, &focal, run.len(), 0, &mut work, "object")
            }
        };
        let (rigid, deepness) =
            believed(&solved.ok()?, &parts, &places, tracks.len(), run.clone(), cameras)?;
        let solid = longest(&deepness, |deepness| deepness < DEEPEST);
        if solid.len() == run.len() {
            return Some(rigid);
        }
        run = run.start + solid.start..run.start + solid.end;
    }
    None
}

/// What a structure from motion of an object's `tracks` tells, if it can be believed, and how deep the
/// object looks in each frame relative to its narrower side. `places` are the tracks' numbers among the
/// object's `all`.
fn believed(
    solved: &Cameras,
    tracks: &[PointTrack],
    places: &[usize],
    all: usize,
    run: Range<usize>,
    cameras: &Cameras,
) -> Option<(Rigid, Vec<f64>)> {
    let weights = vec![1.0; tracks.len()];
    let size = (f64::from(cameras.intrinsics.width) / 320.0).max(1.0);
    let parallax = solved.parallax(tracks, &weights).to_degrees();
    if solved.inlier_share < RIGID.0 || solved.rms > RIGID.1 * size || parallax < RIGID.2 {
        return None;
    }
    let points: Vec<Option<DVec3>> = (0..tracks.len()).map(|i| solved.point(tracks, i)).collect();
    let certainty: Vec<_> = (0..tracks.len()).map(|i| solved.certainty(tracks, i)).collect();
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
        half_width(seen().map(|p| p.x)).max(half_width(seen().map(|p| p.y)))
    };
    let drift = {
        let halves = quantile((0..run.len()).map(half).collect(), 0.5);
        let seen = tracks.iter().map(|track| track.pixels.len()).sum::<usize>() as f64;
        let (life, points) = (seen / tracks.len() as f64, seen / run.len() as f64);
        (TOGETHER * solved.rms / (halves * points.sqrt() * life)).min(UPRIGHT_DRIFT)
    };
    let mut frames: Vec<Frame> = (0..run.len())
        .map(|f| {
            let centre = solved.poses[f].apply(middle);
            // What is not known lies as deep as the middle, to about half of the object's size.
            let half = half(f) / cameras.intrinsics.fx;
            let mut relative = vec![None; all];
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
    // Half of its narrower side. Of what is cut off, by the picture's border say, less is seen.
    let narrow = |(f, frame): (usize, &Frame)| {
        let pixels = narrow_half(tracks.iter().filter_map(|track| track.at(f)));
        frame.depth * pixels / cameras.intrinsics.fx
    };
    let narrow = quantile(frames.iter().enumerate().map(narrow).collect(), WHOLE);
    if !(sound && narrow > 0.0) {
        return None;
    }
    let deepness =
        |frame: &Frame| half_width(frame.relative.iter().flatten().copied()) * frame.depth / narrow;
    let deepness: Vec<f64> = frames.iter().map(deepness).collect();
    for (frame, deepness) in frames.iter_mut().zip(&deepness) {
        let share = (DEEP / deepness).powi(2).min(1.0);
        let most = DEEP * narrow / frame.depth;
        for relative in frame.relative.iter_mut().flatten() {
            *relative = 1.0 + (share * (*relative - 1.0)).clamp(-most, most);
        }
    }
    // Near and far can be mistaken for each other where perspective is weak: the mirrored solution turns
    // the other way.
    let bulge = |(f, frame): (usize, &Frame)| {
        let seen = places.iter().enumerate();
        bulge(seen.filter_map(|(i, place)| Some((tracks[i].at(f)?, frame.relative[*place]?))))
    };
    let explained = |bulge: f64| bulge * bulge.abs();
    let bulge = frames.iter().enumerate().map(bulge).map(explained).sum::<f64>() / run.len() as f64;
    (bulge > HOLLOW).then_some((Rigid { run, middle, frames, drift }, deepness))
}

/// Half of the range that most of the values lie in.
fn half_width(values: impl Iterator<Item = f64>) -> f64 {
    let values: Vec<f64> = values.collect();
    0.5 * (quantile(values.clone(), 0.95) - quantile(values, 0.05))
}

/// Half of the range of most points across the direction in which they spread most.
fn narrow_half(points: impl Iterator<Item = DVec2>) -> f64 {
    let points: Vec<DVec2> = points.collect();
    let mean = points.iter().sum::<DVec2>() / points.len() as f64;
    let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
    for off in points.iter().map(|p| *p - mean) {
        (xx, xy, yy) = (xx + off.x * off.x, xy + off.x * off.y, yy + off.y * off.y);
    }
    let along = 0.5 * f64::atan2(2.0 * xy, xx - yy);
    half_width(points.iter().map(|p| p.dot(DVec2::from_angle(along).perp())))
}

/// How far a thing bulges towards the camera, from pixels of its points and their depths: the correlation
/// of the depth with the squared distance from the middle, in units of the spread in each direction.
fn bulge(points: impl Iterator<Item = (DVec2, f64)>) -> f64 {
    let points: Vec<(DVec2, f64)> = points.collect();
    let count = points.len() as f64;
    let middle = points.iter().map(|(p, _)| *p).sum::<DVec2>() / count;
    let off: Vec<DVec2> = points.iter().map(|(p, _)| *p - middle).collect();
    let spread = |of: fn(&DVec2) -> f64| off.iter().map(of).sum::<f64>() / count;
    let (xx, xy, yy) = (spread(|o| o.x * o.x), spread(|o| o.x * o.y), spread(|o| o.y * o.y));
    let far = |o: &DVec2| yy * o.x * o.x - 2.0 * xy * o.x * o.y + xx * o.y * o.y;
    let far: Vec<f64> = off.iter().map(far).collect();
    let (mean_far, mean_depth) =
        (far.iter().sum::<f64>() / count, points.iter().map(|(_, z)| z).sum::<f64>() / count);
    let (mut ff, mut fz, mut zz) = (0.0, 0.0, 0.0);
    for (far, (_, depth)) in far.iter().zip(&points) {
        let (f, z) = (far - mean_far, depth - mean_depth);
        (ff, fz, zz) = (ff + f * f, fz + f * z, zz + z * z);
    }
    let scale = (ff * zz).sqrt();
    if scale > 0.0 { fz / scale } else { 0.0 }
}

/// The longest run of values that are as they should be.
fn longest(values: &[f64], good: impl Fn(f64) -> bool) -> Range<usize> {
    let (mut best, mut start) = (0..0, 0);
    for (k, value) in values.iter().enumerate() {
        if !good(*value) {
            start = k + 1;
        } else if k + 1 - start > best.len() {
            best = start..k + 1;
        }
    }
    best
}

/// A track's part within a run of frames, which becomes the whole clip.
fn clipped(track: &PointTrack, run: &Range<usize>) -> Option<PointTrack> {
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::types::Intrinsics;
    use glam::DQuat;

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

    #[test]
    fn a_limb_that_swings_is_not_far_out() {
        // A body that turns as it goes by; its lower third sways against it, as if it were elsewhere.
        let intrinsics = Intrinsics::centred(300.0, 320, 180);
        let poses = vec![Pose::new(DQuat::IDENTITY, DVec3::ZERO); 12];
        let cameras = Cameras::known(intrinsics, poses);
        let track = |i: usize, sways: bool| {
            let (x, y) = ((i % 7) as f64 / 6.0 - 0.5, (i / 7) as f64 / 14.0 - 0.5);
            let relief = 0.2 * (1.9 * i as f64).sin();
            let at = |k: usize| {
                let turned =
                    DQuat::from_rotation_y(0.05 * k as f64) * DVec3::new(0.6 * x, 1.6 * y, relief);
                let sway = if sways && y > 0.17 { 0.018 * k as f64 } else { 0.0 };
                let middle = DVec3::new(0.05 * k as f64 - 0.3 + sway, 0.0, 2.5);
                intrinsics.project(middle + turned)
            };
            PointTrack { first: 0, pixels: (0..12).map(at).collect(), deviation: vec![0.1; 12] }
        };
        let shape_of = |sways: bool| {
            let tracks = (0..105).map(|i| track(i, sways)).collect();
            let object = Object { tracks, first: 0, end: 12 };
            shape(&object, &cameras)
        };
        // How far a point lies before or behind the middle at most, relative to the depth.
        let range = |shape: &Shape| {
            let all = shape.frames.iter().flat_map(|frame| frame.relative.iter().flatten());
            all.fold(0.0, |far: f64, relative| far.max((relative - 1.0).abs()))
        };
        let (still, swaying) = (shape_of(false), shape_of(true));
        assert!(still.rigid && (0.1..0.16).contains(&range(&still)), "{}", range(&still));
        // Without the limit it is 0.39.
        assert!(range(&swaying) < 0.2, "{}", range(&swaying));
    }

    #[test]
    fn a_ball_bulges_towards_the_camera_and_its_mirrored_solution_away() {
        // Points on the half of an ellipsoid that is seen, turned about the line of sight.
        let half = |i: usize| {
            let (a, b) = ((i % 20) as f64 / 9.5 - 1.0, (i / 20) as f64 / 9.5 - 1.0);
            let height = (1.0 - a * a - b * b).sqrt();
            let pixel = DVec2::from_angle(0.5).rotate(DVec2::new(40.0 * a, 15.0 * b));
            (height > 0.1).then_some((DVec2::new(120.0, 80.0) + pixel, height))
        };
        let solved = |sign: f64| bulge((0..400).filter_map(half).map(|(p, h)| (p, 3.0 + sign * h)));
        assert!(solved(-0.1) > 0.9 && solved(0.1) < -0.9, "{} {}", solved(-0.1), solved(0.1));
        assert_eq!(solved(0.0), 0.0);
        // A slanted plane is neither.
        let plane = (0..400).filter_map(half).map(|(p, _)| (p, 0.01 * p.x));
        assert!(bulge(plane).abs() < 0.05);
    }

    #[test]
    fn the_longest_run_of_what_is_as_it_should_be() {
        let good = |value: f64| value < 1.0;
        assert_eq!(longest(&[0.5, 2.0, 0.1, 0.2, 3.0, 0.3], good), 2..4);
        assert_eq!(longest(&[0.5, 0.1], good), 0..2);
        assert_eq!(longest(&[2.0, 2.0], good), 0..0);
        // Points on a slanted strip, 10 by 2.
        let along = DVec2::from_angle(0.7);
        let strip = (0..400).map(|i| {
            let (a, b) = (f64::from(i % 20) - 9.5, f64::from(i / 20) - 9.5);
            along * (0.5 * a) + along.perp() * (0.1 * b)
        });
        assert!((narrow_half(strip) - 0.9).abs() < 0.06);
    }
}
