//! The shape and the path of an object, up to one scale.
//!
//! If an object moves rigidly, its points are like a static world relative to the camera, and structure from
//! motion solves for both. An object that does not rotate, such as a car on a straight road, has a solution
//! without the ambiguities of one that does, and it is preferred if it explains the tracks as well. Otherwise the object is modelled as a flat upright object facing the camera, and
//! the change of its size in the image gives the change of its distance.

use std::ops::Range;

use glam::{DQuat, DVec2, DVec3};

use super::cameras::{self, Cameras, Focal, Strictness};
use super::objects::Object;
use super::observer::{Progress, Work};
use super::{FocalSource, Stage, quantile};
use crate::geometry::se3::{exp_so3, log_so3};
use crate::geometry::sim3::{Sim3, align_points};
use crate::observe::PointTrack;
use crate::types::Pose;

/// Thresholds for accepting a structure from motion of an object: minimum share of inliers, maximum
/// reprojection error (pixels at a width of 320) and minimum parallax (degrees).
const RIGID: (f64, f64, f64) = (0.6, 0.8, 4.0);
/// A point whose residual is more than this many times the median does not move with its object.
const ODD: f64 = 3.0;
/// Maximum distance of a point from the object's middle along the line of sight, relative to the depth.
const MOST_BEYOND: f64 = 0.7;

/// Minimum numbers of frames and tracks of a structure from motion.
const LEAST_RUN: usize = 5;
const LEAST_TRACKS: usize = 30;
/// Minimum number of tracks in each frame of the structure from motion of an object that does not rotate.
const LEAST_SEEN: usize = 12;
/// Maximum reprojection error with the rotation kept, relative to that with the rotation free, of an object
/// that does not rotate.
const WORSE: f64 = 1.1;
/// Maximum difference between a step of the depth and the step that the change of size gives, as a logarithm.
const JUMP: f64 = 0.12;
/// Number of frames whose rotation is extrapolated from one structure to the next.
const TURN: usize = 3;
/// Minimum number of points that two structures share, and maximum median distance of these points after
/// alignment, relative to their spread.
const SHARED: usize = 10;
const FITS: f64 = 0.2;
/// Maximum depth of an object along the line of sight, relative to its narrower side in the image. If the
/// structure is deeper in some frame, its depths are compressed: a swinging limb shifts against the body as
/// if it were nearer or farther.
const DEEP: f64 = 1.2;
/// Quantile over the frames that gives the object's narrower side: in some frames an object is seen narrower
/// than it is.
const WHOLE: f64 = 0.9;
/// Apparent depth, relative to the narrower side, from which the structure from motion is rejected in that
/// frame: errors of a solution lie along the line of sight.
const DEEPEST: f64 = 3.5;

/// Visible surfaces bulge towards the camera. A structure is rejected as mirrored or wrong if the mean over
/// its frames of the signed share of depth variance that a bulge explains (negative for a hollow) is not
/// above this value.
const HOLLOW: f64 = -0.03;

/// Standard deviation of the change of an object's depth from frame to frame, as a logarithm, if it is
/// derived from the object's size in the image.
pub(super) const UPRIGHT_DRIFT: f64 = 0.06;
/// Factor by which a structure from motion drifts faster than independent errors of its tracks would give:
/// the errors of neighbouring tracks are correlated.
const TOGETHER: f64 = 40.0;

/// The state of an object in one frame.
pub(super) struct Frame {
    /// Depth (z) of its middle, in a unit that all frames share.
    pub depth: f64,
    /// Pixel of its middle.
    pub middle: DVec2,
    /// Depth of each track's point relative to the depth of the middle, if the track exists in this frame.
    pub relative: Vec<Option<f64>>,
    /// The object's pose in the camera frame; set in frames where the structure from motion holds.
    pub view_from_object: Option<Pose>,
}

/// The shape and the path of an object up to scale.
pub(super) struct Shape {
    /// The object's state in each frame, starting with its first.
    pub frames: Vec<Frame>,
    /// Standard deviation of the change of depth from each frame to the next, logarithm.
    pub drift: Vec<f64>,
    /// The middle of the object in its own coordinate frame.
    pub middle: DVec3,
    /// Whether its structure from motion holds in nearly all frames.
    pub rigid: bool,
}

/// Estimates an object's shape and path up to scale: from structure from motion in the frames where it holds,
/// from its size in the others.
pub(super) fn shape(object: &Object, cameras: &Cameras) -> Shape {
    let upright = upright(object);
    let sizes: Vec<f64> = upright.frames.iter().map(|frame| frame.depth.ln()).collect();
    let pieces = pieces(object, &sizes, cameras);
    let Some(longest) = (0..pieces.len()).max_by_key(|i| pieces[*i].run.len()) else {
        return upright;
    };
    let Shape { mut frames, drift: mut drifts, .. } = upright;
    let middle = pieces[longest].middle;
    let pieces = joined(pieces, longest, &sizes, cameras, object.first);
    for (i, piece) in pieces.iter().enumerate() {
        drifts[piece.run.start..piece.run.end - 1].fill(piece.drift);
        // Between this piece and the next, and before the first, the depth continues from the edge's depth by
        // size.
        let end = pieces.get(i + 1).map_or(frames.len(), |next| next.run.start);
        let before = if i == 0 { 0..piece.run.start } else { 0..0 };
        for (edge, rest) in [(piece.run.start, before), (piece.run.end - 1, piece.run.end..end)] {
            let known = &piece.frames[edge - piece.run.start];
            let ratio = known.depth / frames[edge].depth;
            let shift = known.middle - frames[edge].middle;
            for frame in &mut frames[rest] {
                frame.depth *= ratio;
                frame.middle += shift;
            }
        }
    }
    let structured: usize = pieces.iter().map(|piece| piece.run.len()).sum();
    let rigid = structured as f64 / frames.len() as f64 > 0.8;
    for piece in pieces {
        frames.iter_mut().skip(piece.run.start).zip(piece.frames).for_each(|(to, from)| *to = from);
    }
    Shape { frames, drift: drifts, middle, rigid }
}

/// A structure from motion of an object, in some of its frames.
struct Piece {
    /// The run of the object's frames in which it holds.
    run: Range<usize>,
    /// The middle of the object in its own coordinate frame.
    middle: DVec3,
    /// The points of the object's tracks in its own coordinate frame.
    points: Vec<Option<DVec3>>,
    frames: Vec<Frame>,
    /// Standard deviation of the change of depth from frame to frame, logarithm.
    drift: f64,
}

/// Brings all pieces to the coordinate frame and the unit of the piece numbered `from`, each by way of its
/// neighbour. `sizes` are the logarithms of the depths derived from the size in the image.
fn joined(
    pieces: Vec<Piece>,
    from: usize,
    sizes: &[f64],
    cameras: &Cameras,
    first: usize,
) -> Vec<Piece> {
    let middle = pieces[from].middle;
    let mut earlier = pieces;
    let later = earlier.split_off(from + 1);
    let mut out: Vec<Piece> = earlier.pop().into_iter().collect();
    for piece in later {
        let known_from_piece = match out.last() {
            Some(known) => known.from(&piece, middle, sizes, cameras, first),
            None => Sim3::IDENTITY,
        };
        out.push(piece.moved(known_from_piece, middle, cameras));
    }
    for piece in earlier.into_iter().rev() {
        let known_from_piece = match out.first() {
            Some(known) => known.from(&piece, middle, sizes, cameras, first),
            None => Sim3::IDENTITY,
        };
        out.insert(0, piece.moved(known_from_piece, middle, cameras));
    }
    out
}

impl Piece {
    /// Depth of the middle and the object's pose in a frame.
    fn at(&self, frame: usize) -> (f64, Pose) {
        let frame = &self.frames[frame - self.run.start];
        (frame.depth, frame.view_from_object.unwrap_or(Pose::IDENTITY))
    }

    /// `self_from_other`, from the points that both pieces contain. If these are not enough, the object's
    /// rotation is extrapolated and the depths are joined by its size in the image.
    fn from(
        &self,
        other: &Piece,
        middle: DVec3,
        sizes: &[f64],
        cameras: &Cameras,
        first: usize,
    ) -> Sim3 {
        if let Some(self_from_other) = shared(&other.points, &self.points) {
            return self_from_other;
        }
        let (own, others) = if self.run.start < other.run.start {
            (self.run.end - 1, other.run.start)
        } else {
            (self.run.start, other.run.end - 1)
        };
        let ((own_depth, own_view), (other_depth, other_view)) = (self.at(own), other.at(others));
        let in_world =
            |f: usize, view: Pose| cameras.poses[first + f].rotation.conjugate() * view.rotation;
        let world_from_self = in_world(own, own_view);
        // The rotation from some frames before the edge to the edge.
        let steps = TURN.min(self.run.len() - 1);
        let inner = if own < others { own - steps } else { own + steps };
        let turn = world_from_self * in_world(inner, self.at(inner).1).conjugate();
        let gap = own.abs_diff(others) as f64 / steps as f64;
        let turned = exp_so3(gap * log_so3(turn)) * world_from_self;
        let rotation = turned.conjugate() * in_world(others, other_view);
        let scale = own_depth * (sizes[others] - sizes[own]).exp() / other_depth;
        Sim3 { scale, rotation, translation: middle - scale * (rotation * other.middle) }
    }

    /// Transforms the piece to another coordinate frame and unit, in which the object's middle is `middle`.
    fn moved(self, new_from_own: Sim3, middle: DVec3, cameras: &Cameras) -> Piece {
        let own_from_new = new_from_own.inverse();
        let moved = |frame: Frame| {
            let view_from_own = frame.view_from_object?;
            let view_from_new = Pose::new(
                view_from_own.rotation * own_from_new.rotation,
                new_from_own.scale * view_from_own.apply(own_from_new.translation),
            );
            let centre = view_from_new.apply(middle);
            let ratio = new_from_own.scale * frame.depth / centre.z;
            Some(Frame {
                depth: centre.z,
                middle: cameras.intrinsics.project(centre),
                relative: frame.relative.iter().map(|r| Some((*r)? * ratio)).collect(),
                view_from_object: Some(view_from_new),
            })
        };
        let points = self.points.iter().map(|p| Some(new_from_own.apply((*p)?))).collect();
        let frames = self.frames.into_iter().filter_map(moved).collect();
        Piece { middle, points, frames, ..self }
    }
}

/// The similarity that maps points in one coordinate frame to the same points in another, `other_from_own`;
/// `None` if too few are known in both, or if they do not fit.
fn shared(own: &[Option<DVec3>], other: &[Option<DVec3>]) -> Option<Sim3> {
    let both = own.iter().zip(other).filter_map(|(a, b)| (*a).zip(*b));
    let (own, other): (Vec<DVec3>, Vec<DVec3>) = both.unzip();
    if own.len() < SHARED {
        return None;
    }
    let middle = other.iter().sum::<DVec3>() / other.len() as f64;
    let spread = quantile(other.iter().map(|p| p.distance(middle)).collect(), 0.5);
    let mut weights = vec![1.0; own.len()];
    let mut found = None;
    for _ in 0..10 {
        let fit = align_points(&own, &other, Some(&weights), true).ok()?.reference_from_estimate;
        let pairs = own.iter().zip(&other);
        let off: Vec<f64> = pairs.map(|(a, b)| fit.apply(*a).distance(*b)).collect();
        let usual = quantile(off.clone(), 0.5);
        let weight = |off: &f64| (1.0 + (off / usual.max(1e-12)).powi(2)).powi(-2);
        weights = off.iter().map(weight).collect();
        found = (usual < FITS * spread).then_some(fit);
    }
    found
}

/// The structures from motion of an object, in the order of its frames. `sizes` are the logarithms of the
/// depths derived from its size in the image.
fn pieces(object: &Object, sizes: &[f64], cameras: &Cameras) -> Vec<Piece> {
    let mut tracks = object.tracks.clone();
    tracks.iter_mut().flat_map(|t| &mut t.frames).for_each(|frame| *frame -= object.first);
    let poses = &cameras.poses[object.first..object.end];
    let clip =
        Clip { tracks, sizes, cameras, rotations: poses.iter().map(|p| p.rotation).collect() };
    let mut open = Vec::new();
    open.push(0..object.end - object.first);
    let mut found = Vec::new();
    while let Some(within) = open.pop() {
        if let Some(piece) = clip.piece(within.clone()) {
            open.extend([within.start..piece.run.start, piece.run.end..within.end]);
            found.push(piece);
        }
    }
    found.sort_by_key(|piece: &Piece| piece.run.start);
    found
}

/// What is known of an object before its structure. Frames are counted from the object's first.
struct Clip<'a> {
    tracks: Vec<PointTrack>,
    /// Logarithms of the depths derived from the size in the image.
    sizes: &'a [f64],
    cameras: &'a Cameras,
    /// The cameras' rotations, `view_from_world`.
    rotations: Vec<DQuat>,
}

impl Clip<'_> {
    /// The longest structure from motion within a run of frames: of an object that does not rotate, if that
    /// explains its tracks, otherwise of one that does.
    fn piece(&self, within: Range<usize>) -> Option<Piece> {
        let (_, inside) = self.parts(&within);
        if within.len() < LEAST_RUN || inside.len() < LEAST_TRACKS {
            return None;
        }
        let focal = Focal {
            intrinsics: self.cameras.intrinsics,
            source: FocalSource::Given,
            deviation: 0.0,
            held: true,
            prior: None,
        };
        self.translating(&within, &focal).or_else(|| self.rotating(within, &focal, &inside))
    }

    /// The structure from motion of an object that does not rotate.
    fn translating(&self, within: &Range<usize>, focal: &Focal) -> Option<Piece> {
        let seen = |f: usize| self.tracks.iter().filter(|track| track.at(f).is_some()).count();
        let covered = longest(within.len(), |k| seen(within.start + k) >= LEAST_SEEN, |_| true);
        let run = within.start + covered.start..within.start + covered.end;
        self.trimmed(run, |run, tracks| {
            let solved = cameras::translating(tracks, focal, &self.rotations[run.clone()]).ok()?;
            let freed = solved.freed(tracks, focal).ok()?;
            (solved.rms <= WORSE * freed.rms).then_some(solved)
        })
    }

    /// The structure from motion of an object that rotates.
    fn rotating(
        &self,
        within: Range<usize>,
        focal: &Focal,
        inside: &[PointTrack],
    ) -> Option<Piece> {
        let mut nothing = |_: Stage, _: f64| Ok(());
        let mut progress = Progress(&mut nothing);
        let mut work = Work::new(&mut progress);
        let weights = vec![1.0; inside.len()];
        let posing = cameras::pose(
            inside,
            &weights,
            focal,
            within.len(),
            0,
            Strictness::Usual,
            &mut work,
            "object",
        )
        .ok()?;
        let posed = posing.longest_run();
        let run = within.start + posed.start..within.start + posed.end;
        let mut whole = (run == within).then_some(posing);
        self.trimmed(run, |run, tracks| {
            let weights = vec![1.0; tracks.len()];
            let solved = match whole.take() {
                // All tracks lie within the run.
                Some(posing) => posing.adjusted(tracks, &weights, focal),
                None => cameras::reconstruct(
                    tracks,
                    &weights,
                    focal,
                    run.len(),
                    0,
                    Strictness::Usual,
                    &mut work,
                    "object",
                ),
            };
            solved.ok()
        })
    }

    /// The accepted structure from motion in the longest part of a run in which its depths agree with the
    /// sizes in the image. `solve` gives the cameras relative to the object from a run and the tracks in it.
    fn trimmed(
        &self,
        mut run: Range<usize>,
        mut solve: impl FnMut(&Range<usize>, &[PointTrack]) -> Option<Cameras>,
    ) -> Option<Piece> {
        while run.len() >= LEAST_RUN {
            let (places, parts) = self.parts(&run);
            let solved = solve(&run, &parts)?;
            let (piece, deepness) =
                believed(&solved, &parts, &places, self.tracks.len(), run.clone(), self.cameras)?;
            // A change of depth without a change of size is an error of the solution.
            let off = |k: usize| {
                let change = (piece.frames[k + 1].depth / piece.frames[k].depth).ln();
                change - (self.sizes[run.start + k + 1] - self.sizes[run.start + k])
            };
            let off: Vec<f64> = (0..run.len() - 1).map(off).collect();
            let usual = quantile(off.clone(), 0.5);
            let good = |k: usize| deepness[k] < DEEPEST;
            let goes_on = |k: usize| (off[k] - usual).abs() < JUMP;
            let solid = longest(run.len(), good, goes_on);
            if solid.len() == run.len() {
                return Some(piece);
            }
            run = run.start + solid.start..run.start + solid.end;
        }
        None
    }

    /// The parts of the tracks within a run, and the tracks' indices.
    fn parts(&self, run: &Range<usize>) -> (Vec<usize>, Vec<PointTrack>) {
        let tracks = self.tracks.iter().enumerate();
        tracks.filter_map(|(i, track)| Some((i, clipped(track, run)?))).unzip()
    }
}

/// Checks a structure from motion of an object's `tracks`, and converts it to a piece if it is accepted. Also
/// returns the object's apparent depth in each frame relative to its narrower side. `places` are the tracks'
/// indices among the object's `all` tracks.
fn believed(
    solved: &Cameras,
    tracks: &[PointTrack],
    places: &[usize],
    all: usize,
    run: Range<usize>,
    cameras: &Cameras,
) -> Option<(Piece, Vec<f64>)> {
    let weights = vec![1.0; tracks.len()];
    let size = (f64::from(cameras.intrinsics.width) / 320.0).max(1.0);
    let parallax = solved.parallax(tracks, &weights).to_degrees();
    if solved.inlier_share < RIGID.0 || solved.rms > RIGID.1 * size || parallax < RIGID.2 {
        return None;
    }
    let points: Vec<Option<DVec3>> = (0..tracks.len()).map(|i| solved.point(tracks, i)).collect();
    let certainty: Vec<_> = (0..tracks.len()).map(|i| solved.certainty(tracks, i)).collect();
    let usual = quantile(certainty.iter().flatten().map(|c| c.residual).collect(), 0.5);
    // Variance of a point's depth relative to the depth; `None` for points that do not move with the object.
    let variance = |i: usize| {
        let known = certainty[i].filter(|c| c.residual <= ODD * usual)?;
        Some((usual.max(1.0) * known.deviation).powi(2))
    };
    let coordinate = |k: usize| quantile(points.iter().flatten().map(|p| p[k]).collect(), 0.5);
    let middle = DVec3::new(coordinate(0), coordinate(1), coordinate(2));
    // Half of the size in the image, pixels.
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
            // The prior puts each point at the depth of the middle, with a standard deviation of half of the
            // object's size.
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
    // Half of the narrower side. It appears smaller in frames that show the object only in part.
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
    // Under weak perspective near and far are ambiguous: the mirrored solution rotates in the opposite
    // direction.
    let bulge = |(f, frame): (usize, &Frame)| {
        let seen = places.iter().enumerate();
        bulge(seen.filter_map(|(i, place)| Some((tracks[i].at(f)?, frame.relative[*place]?))))
    };
    let explained = |bulge: f64| bulge * bulge.abs();
    let bulge = frames.iter().enumerate().map(bulge).map(explained).sum::<f64>() / run.len() as f64;
    let mut known = vec![None; all];
    places.iter().zip(&points).for_each(|(place, point)| known[*place] = *point);
    (bulge > HOLLOW).then_some((Piece { run, middle, points: known, frames, drift }, deepness))
}

/// Half of the range of the values between their 5 % and 95 % quantiles.
fn half_width(values: impl Iterator<Item = f64>) -> f64 {
    let values: Vec<f64> = values.collect();
    0.5 * (quantile(values.clone(), 0.95) - quantile(values, 0.05))
}

/// Half of the range of the points, between the 5 % and 95 % quantiles, across the direction of their largest
/// spread.
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

/// How far an object bulges towards the camera, from the pixels and depths of its points: the correlation of
/// the depth with the squared distance from the middle, in units of the spread in each direction. A positive
/// value is a bulge towards the camera.
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

/// The longest run of frames that are all `good`, with `goes_on` true for each step between them.
fn longest(
    count: usize,
    good: impl Fn(usize) -> bool,
    goes_on: impl Fn(usize) -> bool,
) -> Range<usize> {
    let (mut best, mut start) = (0..0, 0);
    for k in 0..count {
        if !good(k) {
            start = k + 1;
            continue;
        }
        if k > start && !goes_on(k - 1) {
            start = k;
        }
        if k + 1 - start > best.len() {
            best = start..k + 1;
        }
    }
    best
}

/// The part of a track within a run of frames, with frames counted from the start of the run.
fn clipped(track: &PointTrack, run: &Range<usize>) -> Option<PointTrack> {
    let [start, end] = [run.start, run.end].map(|at| track.frames.partition_point(|f| *f < at));
    (end >= start + 2).then(|| {
        let mut part = track.places(start..end);
        part.frames.iter_mut().for_each(|frame| *frame -= run.start);
        part
    })
}

/// The model of a flat upright object: its distance follows from its size.
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
            // The partners are a fixed stride away, which gives pairs at all distances, the same ones each
            // time.
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
    use glam::DQuat;

    use super::*;
    use crate::types::Intrinsics;

    #[test]
    fn what_grows_comes_nearer() {
        // Twelve points that spread by 2 % per frame and move to the right.
        let track = |i: usize| {
            let at = DVec2::new(10.0 * (i % 4) as f64, 10.0 * (i / 4) as f64);
            let pixels = (0..6).map(|k| at * 1.02f64.powi(k) + DVec2::new(f64::from(k), 0.0));
            PointTrack::followed(3, pixels.collect(), vec![0.1; 6])
        };
        let object = Object { tracks: (0..12).map(track).collect(), first: 3, end: 9 };
        let shape = upright(&object);
        let ratio = shape.frames[0].depth / shape.frames[5].depth;
        assert!((ratio / 1.02f64.powi(5) - 1.0).abs() < 1e-6, "{ratio}");
    }

    #[test]
    fn a_limb_that_swings_is_not_far_out() {
        // A body that rotates as it passes by; its lower third sways against it, as if it were at another
        // depth.
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
            PointTrack::followed(0, (0..12).map(at).collect(), vec![0.1; 12])
        };
        let shape_of = |sways: bool| {
            let tracks = (0..105).map(|i| track(i, sways)).collect();
            let object = Object { tracks, first: 0, end: 12 };
            shape(&object, &cameras)
        };
        // The largest distance of a point from the middle along the line of sight, relative to the depth.
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
    fn two_structures_without_a_shared_point_are_one_object_that_turns_on() {
        // A ball that rotates uniformly; after twelve frames all its points are lost, and others are found.
        let intrinsics = Intrinsics::centred(300.0, 320, 180);
        let poses = vec![Pose::new(DQuat::IDENTITY, DVec3::ZERO); 24];
        let cameras = Cameras::known(intrinsics, poses);
        let track = |i: usize, first: usize| {
            let (x, y) = ((i % 10) as f64 / 9.0 - 0.5, (i / 10) as f64 / 9.0 - 0.5);
            let (x, y) = (x + 0.03 * (first + i) as f64 % 0.05, y);
            let point = DVec3::new(x, y, -(0.6 - x * x - y * y).sqrt()) * 0.8;
            let at = |k: usize| {
                let turned = DQuat::from_rotation_y(0.04 * (first + k) as f64 - 0.46) * point;
                intrinsics.project(DVec3::new(0.02 * (first + k) as f64 - 0.2, 0.0, 2.5) + turned)
            };
            PointTrack::followed(first, (0..12).map(at).collect(), vec![0.1; 12])
        };
        let tracks = (0..100).flat_map(|i| [track(i, 0), track(i, 12)]).collect();
        let found = shape(&Object { tracks, first: 0, end: 24 }, &cameras);
        assert!(found.rigid && found.frames.iter().all(|f| f.view_from_object.is_some()));
        let view = |k: usize| found.frames[k].view_from_object.unwrap();
        for k in 0..23 {
            let turn = (view(k + 1).rotation * view(k).rotation.conjugate()).to_scaled_axis();
            assert!(turn.distance(DVec3::new(0.0, 0.04, 0.0)) < 0.01, "{k}: {turn}");
            let ratio = found.frames[k + 1].depth / found.frames[k].depth;
            assert!((ratio - 1.0).abs() < 0.04, "{k}: {ratio}");
        }
        assert_eq!(found.drift[11], UPRIGHT_DRIFT);
    }

    #[test]
    fn points_that_two_structures_share_join_them() {
        let own: Vec<Option<DVec3>> = (0..30)
            .map(|i| {
                let i = f64::from(i);
                (i != 3.0).then(|| DVec3::new((1.3 * i).sin(), (2.1 * i).cos(), (0.7 * i).sin()))
            })
            .collect();
        let other_from_own = Sim3 {
            scale: 1.7,
            rotation: DQuat::from_rotation_x(0.4),
            translation: DVec3::new(0.3, -2.0, 1.0),
        };
        let mut other: Vec<Option<DVec3>> =
            own.iter().map(|p| Some(other_from_own.apply((*p)?))).collect();
        // Some points are wrong.
        (5..9).for_each(|i| other[i] = other[i].map(|p| p + DVec3::new(2.0, 1.0, 0.0)));
        let found = shared(&own, &other).unwrap();
        assert!((found.scale / 1.7 - 1.0).abs() < 1e-3, "{found:?}");
        assert!(found.rotation.angle_between(other_from_own.rotation) < 1e-3, "{found:?}");
        assert!(shared(&own[..10], &other[..10]).is_none());
        let unrelated: Vec<_> = other.iter().rev().copied().collect();
        assert!(shared(&own, &unrelated).is_none());
    }

    #[test]
    fn a_ball_bulges_towards_the_camera_and_its_mirrored_solution_away() {
        // Points on the visible half of an ellipsoid, rotated about the line of sight.
        let half = |i: usize| {
            let (a, b) = ((i % 20) as f64 / 9.5 - 1.0, (i / 20) as f64 / 9.5 - 1.0);
            let height = (1.0 - a * a - b * b).sqrt();
            let pixel = DVec2::from_angle(0.5).rotate(DVec2::new(40.0 * a, 15.0 * b));
            (height > 0.1).then_some((DVec2::new(120.0, 80.0) + pixel, height))
        };
        let solved = |sign: f64| bulge((0..400).filter_map(half).map(|(p, h)| (p, 3.0 + sign * h)));
        assert!(solved(-0.1) > 0.9 && solved(0.1) < -0.9, "{} {}", solved(-0.1), solved(0.1));
        assert_eq!(solved(0.0), 0.0);
        // A slanted plane has neither a bulge nor a hollow.
        let plane = (0..400).filter_map(half).map(|(p, _)| (p, 0.01 * p.x));
        assert!(bulge(plane).abs() < 0.05);
    }

    #[test]
    fn the_longest_run_of_what_is_as_it_should_be() {
        let run = |values: &[f64], stops: &[usize]| {
            longest(values.len(), |k| values[k] < 1.0, |k| !stops.contains(&k))
        };
        assert_eq!(run(&[0.5, 2.0, 0.1, 0.2, 3.0, 0.3], &[]), 2..4);
        assert_eq!(run(&[0.5, 0.1], &[]), 0..2);
        assert_eq!(run(&[2.0, 2.0], &[]), 0..0);
        // A bad step ends one run and begins another.
        assert_eq!(run(&[0.5; 6], &[1]), 2..6);
        assert_eq!(run(&[0.5; 6], &[0, 4]), 1..5);
        // Points on a slanted strip, 10 by 2.
        let along = DVec2::from_angle(0.7);
        let strip = (0..400).map(|i| {
            let (a, b) = (f64::from(i % 20) - 9.5, f64::from(i / 20) - 9.5);
            along * (0.5 * a) + along.perp() * (0.1 * b)
        });
        assert!((narrow_half(strip) - 0.9).abs() < 0.06);
    }
}
