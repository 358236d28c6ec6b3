//! Structures from motion of one object, brought to one coordinate frame and one unit.

use std::ops::Range;

use glam::DVec3;

use super::super::cameras::Cameras;
use super::super::quantile;
use super::Frame;
use crate::geometry::se3::{exp_so3, log_so3};
use crate::geometry::sim3::{Sim3, align_points};
use crate::types::{Intrinsics, Pose};

/// Number of frames whose rotation is extrapolated from one structure to the next.
const TURN: usize = 3;
/// Minimum number of points that two structures share, and maximum median distance of these points after
/// alignment, relative to their spread.
const SHARED: usize = 10;
const FITS: f64 = 0.2;

/// A structure from motion of an object, in some of its frames.
pub(super) struct Piece {
    /// The run of the object's frames in which it holds.
    pub run: Range<usize>,
    /// The middle of the object in its own coordinate frame.
    pub middle: DVec3,
    /// The points of the object's tracks in its own coordinate frame.
    pub points: Vec<Option<DVec3>>,
    pub frames: Vec<Frame>,
    /// Standard deviation of the change of depth from frame to frame, logarithm.
    pub drift: f64,
}

/// Brings all pieces to the coordinate frame and the unit of the piece numbered `from`, each by way of its
/// neighbour. `sizes` are the logarithms of the depths derived from the size in the image.
pub(super) fn joined(
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

    /// Moves the middle to another point of the object.
    pub fn move_middle(&mut self, middle: DVec3, intrinsics: &Intrinsics) {
        self.middle = middle;
        for frame in &mut self.frames {
            let Some(view_from_object) = frame.view_from_object else { continue };
            let at = view_from_object.apply(middle);
            let ratio = frame.depth / at.z;
            (frame.depth, frame.middle) = (at.z, intrinsics.project(at));
            frame.relative.iter_mut().flatten().for_each(|relative| *relative *= ratio);
        }
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

#[cfg(test)]
mod tests {
    use glam::DQuat;

    use super::*;

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
}
