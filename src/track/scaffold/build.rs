//! Places the control points of a scaffold and carries them through the clip.

use glam::{DQuat, DVec2, DVec3};
use rayon::prelude::*;

use super::life;
use super::step::{Bound, Match, Step, followed};
use super::{
    ALWAYS, CONFIDENCE, EDGES, LEAST_MATCHES, Node, PLENTY, REACH, Scaffold, Surfaces, area,
};
use crate::track::{Mover, quantile};
use crate::types::{Image, Pose};

/// Approximate number of control points in the frame that the scaffold begins in.
const NODES: f64 = 128.0;
/// Maximum number of control points.
const MOST_NODES: usize = 256;
/// Once there are `NODES` control points, surface farther than this many spacings from all of them gets a new
/// one.
const UNCOVERED: f64 = 1.5;
/// Weight of an edge relative to the total weight of a control point's surface points.
const RIGIDITY: f64 = 0.05;
/// Quantile of the surface points' errors that an object's motion is judged by.
const JUDGED: f64 = 0.8;
/// Distances in frames from which flow is chained to correct drifting control points, counted back from the
/// last known frame.
const BACK: [usize; 8] = [1, 2, 3, 4, 6, 8, 11, 15];
/// An object counts as rigid if its own motion leaves less than this many times the error that the control
/// points' motions leave.
const STIFF: f64 = 1.5;

/// The frame that the scaffold begins in: of the frames that show at least 70 % of the largest moving area,
/// the one nearest to the middle of the clip, so that motion is carried over the fewest frames.
fn canonical_frame(masks: &[Image]) -> usize {
    let areas: Vec<usize> = masks.iter().map(area).collect();
    let most = areas.iter().copied().max().unwrap_or(0);
    let middle = masks.len() / 2;
    (0..masks.len())
        .filter(|&frame| areas[frame] * 10 >= most * 7)
        .min_by_key(|&frame| frame.abs_diff(middle))
        .unwrap_or(middle)
}

/// A control point whose pose is not known in every frame yet.
struct Growing {
    owner: usize,
    spacing: f64,
    poses: Vec<Option<Pose>>,
}

/// The scaffold while it is being built.
struct Builder<'a> {
    surfaces: &'a Surfaces<'a>,
    /// Spacing of the control points, pixels.
    spacing: f64,
    nodes: Vec<Growing>,
    /// The largest distance so far between each two control points, row by row.
    farthest: Vec<Vec<f64>>,
    /// By frame and object, the motion of the object to the next frame.
    steps: &'a [Vec<Pose>],
    /// By object, whether its control points move as one rigid body.
    rigid: Vec<bool>,
    /// By object, the errors in pixels that its own motion and the control points' motions leave in each
    /// step.
    left: Vec<Vec<[f64; 2]>>,
}

/// Builds the scaffold of a clip.
pub(in crate::track) fn build(surfaces: &Surfaces<'_>) -> Scaffold {
    let frames = surfaces.masks.len();
    let canonical = canonical_frame(surfaces.masks);
    let most = surfaces.masks.iter().map(area).max().unwrap_or(0);
    if most == 0 {
        return Scaffold { canonical, nodes: Vec::new() };
    }
    let spacing = (most as f64 / NODES).sqrt().max(2.0);
    let mut steps: Vec<Vec<Pose>> =
        (0..frames - 1).into_par_iter().map(|frame| surfaces.object_steps(frame)).collect();
    surfaces.movers.iter().enumerate().for_each(|(i, object)| go_on(&mut steps, i + 1, object));
    let objects = surfaces.movers.len() + 1;
    let mut builder = Builder {
        surfaces,
        spacing,
        nodes: Vec::new(),
        farthest: Vec::new(),
        steps: &steps,
        rigid: vec![false; objects],
        left: vec![Vec::new(); objects],
    };
    builder.grow(canonical);
    let rigid: Vec<bool> = builder.left.iter().enumerate().map(is_rigid).collect();
    if rigid.contains(&true) {
        let left = vec![Vec::new(); objects];
        builder = Builder { nodes: Vec::new(), farthest: Vec::new(), rigid, left, ..builder };
        builder.grow(canonical);
    }
    let nodes = builder.nodes.into_iter().filter_map(|node| {
        let world_from_node: Option<Vec<Pose>> = node.poses.into_iter().collect();
        Some(Node {
            owner: node.owner,
            spacing: node.spacing,
            world_from_node: world_from_node?,
            alive: 0..frames,
        })
    });
    let mut nodes: Vec<Node> = nodes.collect();
    life::find(surfaces, &mut nodes);
    Scaffold { canonical, nodes }
}

/// Extrapolates an object's motion: before it is first seen and after it is last seen, it repeats the first
/// and the last step.
fn go_on(steps: &mut [Vec<Pose>], owner: usize, object: &Mover) {
    let (first, end) = (object.first, object.first + object.world_from_object.len());
    if end < first + 2 {
        return;
    }
    let (earliest, last) = (steps[first][owner], steps[end - 2][owner]);
    steps[..first].iter_mut().for_each(|step| step[owner] = earliest);
    steps[end - 1..].iter_mut().for_each(|step| step[owner] = last);
}

/// Whether the error of an object's own motion is hardly larger than that of the control points' motions.
fn is_rigid((owner, left): (usize, &Vec<[f64; 2]>)) -> bool {
    let of = |k: usize| quantile(left.iter().map(|step| step[k]).collect(), 0.5);
    owner > 0 && of(0) < STIFF * of(1)
}

impl Builder<'_> {
    /// Builds all control points, starting in a first frame.
    fn grow(&mut self, first: usize) {
        let frames = self.surfaces.masks.len();
        self.cover(first);
        for frame in first + 1..frames {
            self.carry(frame - 1, frame);
            self.cover(frame);
        }
        for frame in (0..frames - 1).rev() {
            self.carry(frame + 1, frame);
            if frame < first {
                self.cover(frame);
            }
        }
        for frame in 1..frames {
            self.carry(frame - 1, frame);
        }
    }

    /// Adds control points where a frame shows surface without a nearby control point.
    fn cover(&mut self, frame: usize) {
        let surfaces = self.surfaces;
        let every = ((0.5 * self.spacing) as usize).max(1);
        for (pixel, owner) in surfaces.inner_pixels(frame, every) {
            if self.nodes.len() >= MOST_NODES {
                break;
            }
            let point = surfaces.lift(frame, pixel);
            let sight = surfaces.sight(frame, point);
            let spacing = self.spacing * surfaces.pixel_size(frame, point);
            let reach = spacing * if self.nodes.len() < NODES as usize { 1.0 } else { UNCOVERED };
            let near = |node: &Growing| {
                let Some(pose) = node.poses[frame].filter(|_| node.owner == owner) else {
                    return false;
                };
                let offset = pose.translation - point;
                // Depth is inferred, so larger distances along the line of sight are tolerated.
                (offset - 0.5 * sight * sight.dot(offset)).length() < reach
            };
            if self.nodes.iter().any(near) {
                continue;
            }
            let mut poses = vec![None; surfaces.masks.len()];
            poses[frame] = Some(Pose { rotation: DQuat::IDENTITY, translation: point });
            self.nodes.push(Growing { owner, spacing, poses });
        }
        self.measure(frame);
    }

    /// Updates the largest distances with those of a frame.
    fn measure(&mut self, frame: usize) {
        let count = self.nodes.len();
        self.farthest.resize(count, Vec::new());
        self.farthest.iter_mut().for_each(|row| row.resize(count, 0.0));
        let places: Vec<Option<DVec3>> =
            self.nodes.iter().map(|node| node.poses[frame].map(|p| p.translation)).collect();
        let owners: Vec<usize> = self.nodes.iter().map(|node| node.owner).collect();
        self.farthest.par_iter_mut().enumerate().for_each(|(i, row)| {
            for (j, distance) in row.iter_mut().enumerate() {
                if owners[i] != owners[j] {
                    *distance = f64::INFINITY;
                } else if let (Some(a), Some(b)) = (places[i], places[j]) {
                    *distance = distance.max(a.distance(b));
                }
            }
        });
    }

    /// Carries the control points of a frame to a neighbouring frame, except those whose pose there is
    /// already known.
    fn carry(&mut self, from: usize, to: usize) {
        let chosen: Vec<usize> =
            (0..self.nodes.len()).filter(|&i| self.nodes[i].poses[from].is_some()).collect();
        if chosen.iter().all(|&i| self.nodes[i].poses[to].is_some()) {
            return;
        }
        let surfaces = self.surfaces;
        let here: Vec<Pose> = chosen.iter().filter_map(|&i| self.nodes[i].poses[from]).collect();
        let known: Vec<Option<Pose>> = chosen.iter().map(|&i| self.nodes[i].poses[to]).collect();
        let neighbours = self.neighbours(&chosen);
        let matches = surfaces.matches(from, to);
        let bound: Vec<Option<Bound>> = matches
            .par_iter()
            .map(|m| self.bind(m.owner, m.here, from, &chosen, &neighbours))
            .collect();
        let bound = matches.into_iter().zip(bound).filter_map(|(m, b)| Some((m, b?)));
        let (matches, bound): (Vec<Match>, Vec<Bound>) =
            bound.chain(self.long_matches(from, to, &chosen, &neighbours)).unzip();
        let guess: Vec<Pose> = chosen
            .iter()
            .zip(&here)
            .zip(&known)
            .map(|((&i, here), known)| {
                known.unwrap_or_else(|| self.with_object(self.nodes[i].owner, from, to, here))
            })
            .collect();
        let edge_weights = here
            .iter()
            .map(|pose| {
                RIGIDITY * self.spacing.powi(2)
                    / surfaces.pixel_size(from, pose.translation).powi(2)
            })
            .collect();
        let step = Step {
            free: known
                .iter()
                .zip(&chosen)
                .map(|(known, &i)| known.is_none() && !self.rigid[self.nodes[i].owner])
                .collect(),
            here,
            neighbours,
            edge_weights,
            matches,
            bound,
        };
        let there = step.solve(&guess);
        self.record(&step, &there, from, to);
        for (&i, pose) in chosen.iter().zip(&there) {
            self.nodes[i].poses[to] = Some(*pose);
        }
        self.measure(to);
    }

    /// Surface points of frames farther back, beyond `from`, that chained flow maps to `to`. Each match holds
    /// the position to which the control points have carried the point in `from`, which may have drifted, and
    /// the position where it should be in `to`.
    fn long_matches(
        &self,
        from: usize,
        to: usize,
        chosen: &[usize],
        neighbours: &[Vec<usize>],
    ) -> Vec<(Match, Bound)> {
        let frames = self.surfaces.masks.len();
        let of = |back: usize| {
            let source = if to > from { from.checked_sub(back)? } else { from + back };
            (source < frames).then_some(source)
        };
        let sources = BACK.iter().filter_map(|back| of(*back));
        sources.flat_map(|source| self.chained(source, from, to, chosen, neighbours)).collect()
    }

    fn chained(
        &self,
        source: usize,
        from: usize,
        to: usize,
        chosen: &[usize],
        neighbours: &[Vec<usize>],
    ) -> Vec<(Match, Bound)> {
        let surfaces = self.surfaces;
        let every = if area(&surfaces.masks[source]) > PLENTY { 2 } else { 1 };
        let find = |&(pixel, owner): &(DVec2, usize)| {
            let (mut at, mut frame, mut certainty) = (pixel, source, 1.0f32);
            while frame != to {
                let next = surfaces.flow.step(frame, to > from, at)?;
                (at, frame) = (next.pixel, if to > from { frame + 1 } else { frame - 1 });
                certainty = certainty.min(next.confidence);
                if certainty < CONFIDENCE || surfaces.owner(frame, at) != Some(owner) {
                    return None;
                }
            }
            let point = surfaces.lift(source, pixel);
            let bound = self.bind(owner, point, source, chosen, neighbours)?;
            let mut here = DVec3::ZERO;
            for &(j, weight) in &bound {
                let poses = &self.nodes[chosen[j]].poses;
                let (before, now) = (poses[source]?, poses[from]?);
                let turned = now.rotation * before.rotation.conjugate();
                here += weight * (turned * (point - before.translation) + now.translation);
            }
            let certainty = f64::from(certainty) * (every * every) as f64;
            Some((surfaces.matched(owner, here, (to, at), certainty), bound))
        };
        surfaces.inner_pixels(source, every).par_iter().filter_map(find).collect()
    }

    /// The pose in the next frame of something that is fixed to its object.
    fn with_object(&self, owner: usize, from: usize, to: usize, here: &Pose) -> Pose {
        let step = self.steps[from.min(to)][owner];
        let step = if to > from { step } else { step.inverse() };
        Pose::new(step.rotation * here.rotation, step.apply(here.translation))
    }

    /// Records the error of a step in pixels, object by object: the [`JUDGED`] quantile over its points.
    fn record(&mut self, step: &Step, there: &[Pose], from: usize, to: usize) {
        let turns: Vec<DQuat> = there
            .iter()
            .zip(&step.here)
            .map(|(there, here)| there.rotation * here.rotation.conjugate())
            .collect();
        let places: Vec<DVec3> = there.iter().map(|pose| pose.translation).collect();
        let mut off = vec![[Vec::new(), Vec::new()]; self.left.len()];
        for (m, point) in step.matches.iter().enumerate() {
            let here = Pose { rotation: DQuat::IDENTITY, translation: point.here };
            let as_one = self.with_object(point.owner, from, to, &here).translation;
            let [one, many] = &mut off[point.owner];
            one.push(point.off(as_one));
            many.push(point.off(step.moved(m, &turns, &places)));
        }
        for (left, off) in self.left.iter_mut().zip(off) {
            if off[0].len() >= LEAST_MATCHES {
                left.push(off.map(|off| quantile(off, JUDGED)));
            }
        }
    }

    /// The edges of the chosen control points, as indices among these: to those that have been near in all
    /// frames.
    fn neighbours(&self, chosen: &[usize]) -> Vec<Vec<usize>> {
        let of = |&i: &usize| {
            let distance = |j: usize| self.farthest[i][chosen[j]];
            let mut near: Vec<usize> =
                (0..chosen.len()).filter(|&j| chosen[j] != i && distance(j).is_finite()).collect();
            near.sort_by(|&a, &b| distance(a).total_cmp(&distance(b)).then(a.cmp(&b)));
            near.truncate(EDGES);
            let reach = REACH * self.nodes[i].spacing;
            let kept = near.iter().filter(|&&j| distance(j) < reach).count();
            near.truncate(kept.max(ALWAYS));
            near
        };
        chosen.par_iter().map(of).collect()
    }

    /// The control points that a surface point of a frame follows, as indices among the chosen ones: the
    /// nearest one and those of its neighbours whose position in that frame is known.
    fn bind(
        &self,
        owner: usize,
        point: DVec3,
        frame: usize,
        chosen: &[usize],
        neighbours: &[Vec<usize>],
    ) -> Option<Bound> {
        let place = |j: usize| self.nodes[chosen[j]].poses[frame].map(|pose| pose.translation);
        let distance = |j: usize| place(j).map_or(f64::INFINITY, |at| at.distance(point));
        let on_it = (0..chosen.len())
            .filter(|&j| self.nodes[chosen[j]].owner == owner && place(j).is_some());
        let nearest = on_it.min_by(|&a, &b| distance(a).total_cmp(&distance(b)))?;
        let near: Vec<usize> =
            neighbours[nearest].iter().copied().filter(|&j| place(j).is_some()).collect();
        Some(followed(nearest, &near, self.nodes[chosen[nearest]].spacing, distance))
    }
}
