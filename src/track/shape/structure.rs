//! Structure from motion of an object: in which frames it holds, and of which kind it is.

use std::ops::Range;

use glam::{DQuat, DVec3};

use super::super::cameras::{self, Cameras, Focal, Posing, Strictness};
use super::super::objects::Object;
use super::super::observer::{Progress, Work};
use super::super::{Stage, quantile};
use super::believed::believed;
use super::joined::Piece;
use crate::geometry::se3::log_so3;
use crate::observe::PointTrack;

/// Minimum numbers of frames and tracks of a structure from motion.
const LEAST_RUN: usize = 5;
const LEAST_TRACKS: usize = 30;
/// Minimum number of tracks in each frame of the structure from motion of an object that does not rotate.
const LEAST_SEEN: usize = 12;
/// Maximum reprojection error with the rotation kept, relative to that with the rotation free, of an object
/// that does not rotate.
const WORSE: f64 = 1.1;
/// Number of starts of the structure from motion of an object that rotates, each with other random samples.
const STARTS: u64 = 6;
/// Change of the angular velocity from one step between frames to the next that is abrupt, radians.
const ABRUPT: f64 = 0.2;
/// Maximum difference between a step of the depth and the step that the change of size gives, as a logarithm.
const JUMP: f64 = 0.12;
/// Apparent depth, relative to the narrower side, from which the structure from motion is rejected in that
/// frame: errors of a solution lie along the line of sight.
const DEEPEST: f64 = 3.5;

/// The structures from motion of an object, in the order of its frames. `sizes` are the logarithms of the
/// depths derived from its size in the image.
pub(super) fn pieces(object: &Object, sizes: &[f64], cameras: &Cameras) -> Vec<Piece> {
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
        let focal = Focal::known(self.cameras.intrinsics);
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

    /// The structure from motion of an object that rotates: of all starts with about the least reprojection
    /// error, the one whose rotation is steadiest.
    fn rotating(
        &self,
        within: Range<usize>,
        focal: &Focal,
        inside: &[PointTrack],
    ) -> Option<Piece> {
        let mut nothing = |_: Stage, _: f64| Ok(());
        let mut progress = Progress(&mut nothing);
        let mut work = Work::new(&mut progress);
        let mut posed = |tracks: &[PointTrack], frames: usize| -> Vec<Posing> {
            let weights = vec![1.0; tracks.len()];
            let usual = Strictness::Usual;
            let mut pose = |seed| {
                cameras::pose(tracks, &weights, focal, frames, seed, usual, &mut work, "object")
            };
            (0..STARTS).filter_map(|seed| pose(seed).ok()).collect()
        };
        let first = posed(inside, within.len());
        let part = first.iter().map(Posing::longest_run).max_by_key(Range::len)?;
        let run = within.start + part.start..within.start + part.end;
        let mut whole = (run == within).then_some(first);
        self.trimmed(run, |run, tracks| {
            let weights = vec![1.0; tracks.len()];
            let posings = whole.take().unwrap_or_else(|| posed(tracks, run.len()));
            let adjusted = |posing: Posing| posing.adjusted(tracks, &weights, focal).ok();
            let solved: Vec<Cameras> = posings.into_iter().filter_map(adjusted).collect();
            let least = solved.iter().map(|cameras| cameras.rms).min_by(f64::total_cmp)?;
            let alike = solved.into_iter().filter(|cameras| cameras.rms <= WORSE * least);
            let unsteady = |cameras: &Cameras| -> f64 {
                let changes = self.changes(cameras, run).into_iter();
                changes.map(|change| (change / ABRUPT).powi(2).ln_1p()).sum()
            };
            let judged = alike.map(|cameras| (unsteady(&cameras), cameras));
            Some(judged.min_by(|a, b| a.0.total_cmp(&b.0))?.1)
        })
    }

    /// The changes of the object's angular velocity in the world from each step between frames to the next,
    /// radians per frame.
    fn changes(&self, cameras: &Cameras, run: &Range<usize>) -> Vec<f64> {
        let rotations: Vec<DQuat> = (self.rotations[run.clone()].iter().zip(&cameras.poses))
            .map(|(view, pose)| view.conjugate() * pose.rotation)
            .collect();
        let steps: Vec<DVec3> =
            rotations.windows(2).map(|pair| log_so3(pair[1] * pair[0].conjugate())).collect();
        steps.windows(2).map(|pair| pair[1].distance(pair[0])).collect()
    }

    /// The accepted structure from motion in the longest part of a run in which its depths agree with the
    /// sizes in the image and its rotation has no abrupt step. `solve` gives the cameras relative to the object
    /// from a run and the tracks in it.
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
            let abrupt = abrupt(&self.changes(&solved, &run));
            let goes_on = |k: usize| (off[k] - usual).abs() < JUMP && !abrupt[k];
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

/// Whether each step between frames is abrupt, from the `changes` of the angular velocity from step to step. At
/// an abrupt step a structure takes near for far or another side for the one it has seen. Both changes beside
/// it are large.
fn abrupt(changes: &[f64]) -> Vec<bool> {
    let large = |k: Option<usize>| k.and_then(|k| changes.get(k)).map(|change| *change > ABRUPT);
    let step = |k: usize| match (large(k.checked_sub(1)), large(Some(k))) {
        (Some(before), Some(after)) => before && after,
        // At an end there is only one change; it may be due to the step beside.
        (None, Some(after)) => after && large(Some(k + 1)) != Some(true),
        (Some(before), None) => before && large(k.checked_sub(2)) != Some(true),
        (None, None) => false,
    };
    (0..=changes.len()).map(step).collect()
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_changes_beside_an_abrupt_step_are_large() {
        let steps = |changes: &[f64]| -> Vec<usize> {
            let abrupt = abrupt(changes);
            (0..abrupt.len()).filter(|k| abrupt[*k]).collect()
        };
        assert_eq!(steps(&[0.02, 0.6, 0.5, 0.03]), [2]);
        // A rotation that changes once, as at a bounce, has no abrupt step.
        assert_eq!(steps(&[0.02, 0.6, 0.03, 0.02]), [] as [usize; 0]);
        assert_eq!(steps(&[0.6, 0.02, 0.02]), [0]);
        assert_eq!(steps(&[0.6, 0.5, 0.02]), [1]);
        assert_eq!(steps(&[0.02, 0.02, 0.6]), [3]);
        assert_eq!(steps(&[]), [] as [usize; 0]);
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
    }
}
