//! A scaffold on what moves: nodes on the movers' surfaces, each of which moves rigidly through the whole
//! clip.
//!
//! Dense flow between neighbouring frames, lifted by the frames' depth, says where surface points go.
//! The nodes' motions from one frame to the next are those that explain it best and keep each node's
//! surroundings as rigid as possible (embedded deformation: Sumner, Schmid, Pauly 2007; rotations and
//! translations alternate as in Sorkine and Alexa 2007). What is hidden, or whose flow is not to be
//! believed, goes along with its surroundings. So no point has to be followed on its own: chained
//! tracks on a body lose half of their points every few frames. Where flow can be chained over several
//! frames it says more: the same points, from frames farther back, keep the nodes from drifting along
//! the surface, since the errors of single steps do not add up in them.
//!
//! The scaffold begins in the frame that shows most of the movers. Where a later frame shows surface
//! that no node is near to, nodes are added, and carried to all other frames afterwards, between nodes
//! whose place there is known already.

mod step;

use glam::{DMat3, DQuat, DVec2, DVec3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use self::step::{Bound, Match, Step, followed, rigid};
use super::Mover;
use crate::geometry::se3::matrix3;
use crate::geometry::sim3::nearest_rotation;
use crate::observe::NeighbourFlow;
use crate::types::{Image, Intrinsics, Pose};

/// Nodes in the frame that the scaffold begins in, about.
const NODES: f64 = 128.0;
/// Nodes in all, at most.
const MOST_NODES: usize = 256;
/// Surface farther from every node than so many spacings gets a node of its own.
const UNCOVERED: f64 = 1.5;
/// Flow with less confidence is not used.
const CONFIDENCE: f32 = 0.3;
/// Where more pixels move, every second one along each axis is enough.
const PLENTY: usize = 8000;
/// Edges of a node.
const EDGES: usize = 8;
/// Nodes farther from each other than so many spacings, in any frame, share no edge, but for the
/// nearest ones.
const REACH: f64 = 4.0;
const ALWAYS: usize = 2;
/// Weight of an edge, by that of all surface points of a node.
const RIGIDITY: f64 = 0.05;
/// An object's own motion is found from so many surface points, at least.
const LEAST_MATCHES: usize = 20;
/// An object that was found as a whole is believed where it leaves at most so much more than what its
/// surface points ask for from frame to frame: it does not drift.
const BELIEVED: f64 = 3.0;
/// Objects are judged by the points that are off by more than this share of all.
const JUDGED: f64 = 0.8;
/// Flow that is chained from so many frames before the last tells where nodes have gone astray.
const BACK: [usize; 8] = [1, 2, 3, 4, 6, 8, 11, 15];
/// Nodes go as one where that leaves at most so much more.
const STIFF: f64 = 1.5;

/// Nodes on what moves.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Scaffold {
    /// The frame that shows most of the movers, near the middle of the clip.
    pub canonical: usize,
    /// The nodes.
    pub nodes: Vec<Node>,
}

/// A place on a mover's surface, with its surroundings.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Node {
    /// The object it is on, as [`super::Track::owners`] numbers them, or the shadow, as
    /// [`super::Track::shadows`] does; 0 where none is known.
    pub owner: usize,
    /// Where it is, frame by frame. Only differences between frames mean something of the rotation.
    pub world_from_node: Vec<Pose>,
    /// The distance to its neighbours, about, in the world's unit.
    pub spacing: f64,
}

/// What is known of the movers' surfaces.
pub(super) struct Surfaces<'a> {
    pub intrinsics: Intrinsics,
    pub view_from_world: &'a [Pose],
    pub flow: &'a NeighbourFlow,
    pub masks: &'a [Image],
    pub depth: &'a [Image],
    pub owners: &'a [Image],
    pub movers: &'a [Mover],
}

/// The frame that shows most of the movers, the one nearest to the middle among the good ones: from
/// there motion has to reach least far.
fn canonical_frame(masks: &[Image]) -> usize {
    let areas: Vec<usize> = masks.iter().map(area).collect();
    let most = areas.iter().copied().max().unwrap_or(0);
    let middle = masks.len() / 2;
    (0..masks.len())
        .filter(|&frame| areas[frame] * 10 >= most * 7)
        .min_by_key(|&frame| frame.abs_diff(middle))
        .unwrap_or(middle)
}

fn area(mask: &Image) -> usize {
    mask.pixels.iter().filter(|m| **m > 0.5).count()
}

/// The value of a one-channel image at the pixel that holds a position.
pub(crate) fn value(image: &Image, pixel: DVec2) -> f32 {
    let x = (pixel.x.max(0.0) as u32).min(image.width - 1);
    let y = (pixel.y.max(0.0) as u32).min(image.height - 1);
    image.at(x, y)[0]
}

impl Surfaces<'_> {
    /// The object that a pixel shows, 0 where none is known; none where nothing moves.
    fn owner(&self, frame: usize, pixel: DVec2) -> Option<usize> {
        let moves = value(&self.masks[frame], pixel) > 0.5;
        moves.then(|| value(&self.owners[frame], pixel) as usize)
    }

    /// The point in the world that a pixel shows.
    pub(super) fn lift(&self, frame: usize, pixel: DVec2) -> DVec3 {
        let z = f64::from(value(&self.depth[frame], pixel));
        self.view_from_world[frame].inverse().apply(self.intrinsics.ray(pixel) * z)
    }

    /// What a pixel measures in the world at a point.
    pub(super) fn pixel_size(&self, frame: usize, point: DVec3) -> f64 {
        self.view_from_world[frame].apply(point).z.max(1e-6) / self.intrinsics.fx
    }

    /// The unit vector from the camera to a point.
    fn sight(&self, frame: usize, point: DVec3) -> DVec3 {
        (point - self.view_from_world[frame].inverse().translation).normalize_or_zero()
    }

    /// Middles of the pixels of a frame whose neighbours are of the same object, every so-manieth.
    fn inner_pixels(&self, frame: usize, every: usize) -> Vec<(DVec2, usize)> {
        let (width, height) = (self.flow.width, self.flow.height);
        let mut found = Vec::new();
        for y in (every / 2..height).step_by(every) {
            for x in (every / 2..width).step_by(every) {
                let pixel = DVec2::new(x as f64 + 0.5, y as f64 + 0.5);
                let Some(owner) = self.owner(frame, pixel) else { continue };
                let same =
                    |x: f64, y: f64| self.owner(frame, pixel + DVec2::new(x, y)) == Some(owner);
                if same(1.0, 0.0) && same(-1.0, 0.0) && same(0.0, 1.0) && same(0.0, -1.0) {
                    found.push((pixel, owner));
                }
            }
        }
        found
    }

    /// How every object goes from a frame to the next, by its number; what is on no object stays.
    fn object_steps(&self, frame: usize) -> Vec<Pose> {
        let mut own: Vec<Vec<Match>> = (0..=self.movers.len()).map(|_| Vec::new()).collect();
        self.matches(frame, frame + 1).into_iter().for_each(|m| own[m.owner].push(m));
        let mut steps = vec![Pose::IDENTITY];
        for (object, matches) in self.movers.iter().zip(&own[1..]) {
            steps.push(self.object_step(object, frame, matches));
        }
        steps
    }

    /// How an object goes from a frame to the next: as it was found as a whole, or, where that does not
    /// agree, as its surface points ask for.
    fn object_step(&self, object: &Mover, frame: usize, matches: &[Match]) -> Pose {
        let next = object.world_from_object(frame + 1) * object.world_from_object(frame).inverse();
        let whole = next.apply_pose(&Pose::IDENTITY);
        if matches.len() < LEAST_MATCHES {
            return whole;
        }
        let own = rigid(matches, whole);
        let left = |pose: &Pose| {
            super::quantile(matches.iter().map(|m| m.off(pose.apply(m.here))).collect(), 0.5)
        };
        if left(&whole) <= BELIEVED * left(&own) { whole } else { own }
    }

    /// Surface points of a frame that flow finds again in its neighbour.
    fn matches(&self, from: usize, to: usize) -> Vec<Match> {
        let every = if area(&self.masks[from]) > PLENTY { 2 } else { 1 };
        let find = |&(pixel, owner): &(DVec2, usize)| {
            let next = self.flow.step(from, to > from, pixel)?;
            if next.confidence < CONFIDENCE || self.owner(to, next.pixel) != Some(owner) {
                return None;
            }
            let there = self.lift(to, next.pixel);
            let certainty = f64::from(next.confidence) * (every * every) as f64;
            Some(Match {
                owner,
                here: self.lift(from, pixel),
                there,
                sight: self.sight(to, there),
                weight: certainty / self.pixel_size(to, there).powi(2),
                certainty,
            })
        };
        self.inner_pixels(from, every).par_iter().filter_map(find).collect()
    }
}

/// A node whose place is not known in every frame yet.
struct Growing {
    owner: usize,
    spacing: f64,
    poses: Vec<Option<Pose>>,
}

/// The scaffold while it is being built.
struct Builder<'a> {
    surfaces: &'a Surfaces<'a>,
    /// Distance of the nodes, pixels.
    spacing: f64,
    nodes: Vec<Growing>,
    /// The largest distance that two nodes have had, row by row.
    farthest: Vec<Vec<f64>>,
    /// By frame and object, how this goes to the next frame.
    steps: &'a [Vec<Pose>],
    /// By object, whether its nodes go as one.
    rigid: Vec<bool>,
    /// By object, what its own motion and what the nodes' motions leave of each step.
    left: Vec<Vec<[f64; 2]>>,
}

/// Builds the scaffold of a clip.
pub(super) fn build(surfaces: &Surfaces<'_>) -> Scaffold {
    let frames = surfaces.masks.len();
    let canonical = canonical_frame(surfaces.masks);
    let most = surfaces.masks.iter().map(area).max().unwrap_or(0);
    if most == 0 {
        return Scaffold { canonical, nodes: Vec::new() };
    }
    let spacing = (most as f64 / NODES).sqrt().max(2.0);
    let steps: Vec<Vec<Pose>> =
        (0..frames - 1).into_par_iter().map(|frame| surfaces.object_steps(frame)).collect();
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
        Some(Node { owner: node.owner, spacing: node.spacing, world_from_node: world_from_node? })
    });
    Scaffold { canonical, nodes: nodes.collect() }
}

/// Whether what an object's own motion leaves of its steps is hardly more than what the nodes' motions
/// leave.
fn is_rigid((owner, left): (usize, &Vec<[f64; 2]>)) -> bool {
    let of = |k: usize| super::quantile(left.iter().map(|step| step[k]).collect(), 0.5);
    owner > 0 && of(0) < STIFF * of(1)
}

impl Builder<'_> {
    /// Builds all from a first frame on.
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

    /// Adds nodes where a frame shows surface that none is near to.
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
                // Depth is inferred: along the line of sight nodes are off by more.
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

    /// Takes the distances of a frame into account.
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

    /// Finds where the nodes of a frame are in its neighbour, those whose place there is not known.
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
        let bound: Vec<Option<Bound>> =
            matches.par_iter().map(|m| self.bind(m, &chosen, &here, &neighbours)).collect();
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

    /// Surface points of frames farther back, beyond `from`, that chained flow leads to `to`: as the nodes
    /// have carried them to `from`, where they may have gone astray a little, and where they should be
    /// in `to`.
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
        let known = |i: usize| self.nodes[i].poses[source];
        let place = |j: usize| known(chosen[j]).map(|pose| pose.translation);
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
            let distance = |j: usize| place(j).map_or(f64::INFINITY, |at| at.distance(point));
            let on_it = (0..chosen.len())
                .filter(|&j| self.nodes[chosen[j]].owner == owner && place(j).is_some());
            let nearest = on_it.min_by(|&a, &b| distance(a).total_cmp(&distance(b)))?;
            let radius = self.nodes[chosen[nearest]].spacing;
            let near: Vec<usize> =
                neighbours[nearest].iter().copied().filter(|&j| place(j).is_some()).collect();
            let bound = followed(nearest, &near, radius, distance);
            let mut here = DVec3::ZERO;
            for &(j, weight) in &bound {
                let poses = &self.nodes[chosen[j]].poses;
                let (before, now) = (poses[source]?, poses[from]?);
                let turned = now.rotation * before.rotation.conjugate();
                here += weight * (turned * (point - before.translation) + now.translation);
            }
            let there = surfaces.lift(to, at);
            let certainty = f64::from(certainty) * (every * every) as f64;
            let found = Match {
                owner,
                here,
                there,
                sight: surfaces.sight(to, there),
                weight: certainty / surfaces.pixel_size(to, there).powi(2),
                certainty,
            };
            Some((found, bound))
        };
        surfaces.inner_pixels(source, every).par_iter().filter_map(find).collect()
    }

    /// A pose in the next frame if it were fixed to its object.
    fn with_object(&self, owner: usize, from: usize, to: usize, here: &Pose) -> Pose {
        let step = self.steps[from.min(to)][owner];
        let step = if to > from { step } else { step.inverse() };
        Pose::new(step.rotation * here.rotation, step.apply(here.translation))
    }

    /// Remembers what a step leaves, pixels, object by object: the share of the points that
    /// [`JUDGED`] tells leaves less.
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
                left.push(off.map(|off| super::quantile(off, JUDGED)));
            }
        }
    }

    /// The edges of the chosen nodes, by their numbers among these: to those that have always been
    /// near.
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

    /// The nodes that a surface point follows: the nearest one, and its neighbours.
    fn bind(
        &self,
        point: &Match,
        chosen: &[usize],
        here: &[Pose],
        neighbours: &[Vec<usize>],
    ) -> Option<Bound> {
        let distance = |j: usize| here[j].translation.distance(point.here);
        let on_it = (0..chosen.len()).filter(|&j| self.nodes[chosen[j]].owner == point.owner);
        let nearest = on_it.min_by(|&a, &b| distance(a).total_cmp(&distance(b)))?;
        let radius = self.nodes[chosen[nearest]].spacing;
        Some(followed(nearest, &neighbours[nearest], radius, distance))
    }
}

impl Scaffold {
    /// Where a surface point of an object that some frame shows is in another, and how it is turned
    /// there: with the nodes that are nearest to it. None without nodes on any object.
    pub fn carry(
        &self,
        owner: usize,
        point: DVec3,
        from: usize,
        to: usize,
    ) -> Option<(DVec3, DQuat)> {
        let place = |j: usize| self.nodes[j].world_from_node[from].translation;
        let nearest = |on: &dyn Fn(usize) -> bool| {
            let on = (0..self.nodes.len()).filter(|&j| on(j));
            on.min_by(|&a, &b| {
                place(a).distance_squared(point).total_cmp(&place(b).distance_squared(point))
            })
        };
        let nearest = nearest(&|j| self.nodes[j].owner == owner).or_else(|| nearest(&|_| true))?;
        let owner = self.nodes[nearest].owner;
        let radius = self.nodes[nearest].spacing;
        // Its neighbours are those that stay near in both frames.
        let apart = |j: usize| {
            let distance = |frame: usize| {
                let at = |j: usize| self.nodes[j].world_from_node[frame].translation;
                at(nearest).distance(at(j))
            };
            distance(from).max(distance(to))
        };
        let mut near: Vec<usize> = (0..self.nodes.len())
            .filter(|&j| j != nearest && self.nodes[j].owner == owner)
            .filter(|&j| apart(j) < REACH * radius)
            .collect();
        near.sort_by(|&a, &b| apart(a).total_cmp(&apart(b)).then(a.cmp(&b)));
        near.truncate(EDGES);
        let followed = followed(nearest, &near, radius, |j| place(j).distance(point));
        let (mut moved, mut turn) = (DVec3::ZERO, DMat3::ZERO);
        for (j, weight) in followed {
            let poses = &self.nodes[j].world_from_node;
            let turned = poses[to].rotation * poses[from].rotation.conjugate();
            moved += weight * (turned * (point - poses[from].translation) + poses[to].translation);
            turn += DMat3::from_quat(turned) * weight;
        }
        Some((moved, nearest_rotation(&matrix3(&turn)).0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::sim3::Sim3;
    use crate::observe::{SuppliedFlow, observe_flow};

    const SIZE: (u32, u32) = (96, 48);
    const FRAMES: usize = 7;
    const FOCAL: f64 = 100.0;

    /// A clip before a camera that stands still, in which everything lies at depth 1. `part` says
    /// which part of the object a pixel shows in the first frame, and `speed` how that part moves,
    /// pixels a frame.
    struct Clip {
        flow: NeighbourFlow,
        masks: Vec<Image>,
        owners: Vec<Image>,
        depth: Vec<Image>,
        movers: Vec<Mover>,
        poses: Vec<Pose>,
    }

    fn clip(
        part: impl Fn(i32, i32) -> Option<usize>,
        speed: impl Fn(usize) -> [i32; 2],
        hidden: impl Fn(usize, i32) -> bool,
    ) -> Clip {
        let image = |channels| Image::new(SIZE.0, SIZE.1, channels);
        let parts = |frame: usize| {
            let mut parts = vec![None; (SIZE.0 * SIZE.1) as usize];
            for y in 0..SIZE.1 as i32 {
                for x in 0..SIZE.0 as i32 {
                    let Some(which) = part(x, y) else { continue };
                    let [u, v] = speed(which).map(|s| s * frame as i32);
                    let (x, y) = (x + u, y + v);
                    if (0..SIZE.0 as i32).contains(&x)
                        && (0..SIZE.1 as i32).contains(&y)
                        && !hidden(frame, x)
                    {
                        parts[(y * SIZE.0 as i32 + x) as usize] = Some(which);
                    }
                }
            }
            parts
        };
        let mask = |frame: usize| {
            let mut mask = image(1);
            for (pixel, part) in mask.pixels.iter_mut().zip(parts(frame)) {
                *pixel = f32::from(u8::from(part.is_some()));
            }
            mask
        };
        let field = |frame: usize, sign: f32| {
            let mut field = image(2);
            for (v, part) in field.pixels.chunks_exact_mut(2).zip(parts(frame)) {
                if let Some(part) = part {
                    v.copy_from_slice(&speed(part).map(|s| sign * s as f32));
                }
            }
            field
        };
        let forward = (0..FRAMES - 1).map(|f| field(f, 1.0)).collect();
        let backward = (1..FRAMES).map(|f| field(f, -1.0)).collect();
        let mut source = SuppliedFlow::new(forward, backward).unwrap();
        let frames = vec![image(3); FRAMES];
        let masks: Vec<Image> = (0..FRAMES).map(mask).collect();
        let mut depth = image(1);
        depth.pixels.fill(1.0);
        Clip {
            flow: observe_flow(&frames, &mut source, &mut |_| Ok(())).unwrap(),
            owners: masks.clone(),
            masks,
            depth: vec![depth; FRAMES],
            // What was found of the object as a whole knows nothing of its motion.
            movers: vec![Mover { first: 0, world_from_object: vec![Sim3::IDENTITY; FRAMES] }],
            poses: vec![Pose::IDENTITY; FRAMES],
        }
    }

    fn scaffold(clip: &Clip) -> Scaffold {
        build(&Surfaces {
            intrinsics: Intrinsics::centred(FOCAL, SIZE.0, SIZE.1),
            view_from_world: &clip.poses,
            flow: &clip.flow,
            masks: &clip.masks,
            depth: &clip.depth,
            owners: &clip.owners,
            movers: &clip.movers,
        })
    }

    /// How a node goes from the first frame to another, pixels.
    fn gone(node: &Node, frame: usize) -> DVec3 {
        let place = |frame: usize| node.world_from_node[frame].translation;
        FOCAL * (place(frame) - place(0))
    }

    /// Where it is in the first frame, pixels.
    fn begins(node: &Node) -> DVec2 {
        let view = node.world_from_node[0].translation;
        Intrinsics::centred(FOCAL, SIZE.0, SIZE.1).project(view)
    }

    fn block(x: i32, y: i32) -> bool {
        (10..50).contains(&x) && (10..34).contains(&y)
    }

    #[test]
    fn what_is_rigid_goes_as_one_even_where_it_is_hidden() {
        // A post stands before the middle of the picture; what is behind it is not seen.
        let clip = clip(|x, y| block(x, y).then_some(0), |_| [5, 1], |_, x| (44..52).contains(&x));
        let found = scaffold(&clip);
        assert!(found.nodes.len() > 60, "{}", found.nodes.len());
        for node in &found.nodes {
            assert_eq!(node.owner, 1);
            for frame in 0..FRAMES {
                let off = gone(node, frame) - DVec3::new(5.0, 1.0, 0.0) * frame as f64;
                assert!(off.length() < 0.05, "{off} px in frame {frame}");
                let turned = node.world_from_node[frame].rotation;
                let turned = turned.angle_between(node.world_from_node[0].rotation);
                assert!(turned < 1e-3, "turned by {turned}");
            }
        }
        assert_eq!(found, scaffold(&clip), "the same input gives the same bits");
    }

    #[test]
    fn parts_that_move_apart_keep_their_nodes() {
        let clip = clip(
            |x, y| block(x, y).then_some(usize::from(y >= 22)),
            |part| [[4, 0], [1, 0]][part],
            |_, _| false,
        );
        let found = scaffold(&clip);
        let mut counts = [0; 2];
        for node in &found.nodes {
            let y = begins(node).y;
            // Nodes at the seam follow both.
            let (part, speed) = if y < 18.0 {
                (0, 4.0)
            } else if y > 26.0 {
                (1, 1.0)
            } else {
                continue;
            };
            counts[part] += 1;
            // Measured: 0.4 px across and 1.5 px along the line of sight.
            let off = gone(node, FRAMES - 1) - DVec3::X * speed * (FRAMES - 1) as f64;
            assert!(off.truncate().length() < 1.0, "{off} px at {}", begins(node));
            assert!(off.z.abs() < 4.0, "{off} px at {}", begins(node));
        }
        assert!(counts.iter().all(|count| *count > 20), "{counts:?}");
    }

    #[test]
    fn surface_is_carried_there_and_back() {
        let clip = clip(|x, y| block(x, y).then_some(0), |_| [4, 0], |_, _| false);
        let found = scaffold(&clip);
        let point = DVec3::new(-0.2, 0.03, 1.0);
        let (there, turned) = found.carry(1, point, 1, 5).unwrap();
        assert!((there - point - DVec3::X * 0.16).length() < 1e-3, "{there}");
        assert!(turned.angle_between(DQuat::IDENTITY) < 1e-3);
        let (back, _) = found.carry(1, there, 5, 1).unwrap();
        assert!((back - point).length() < 1e-3, "{back}");
        // On an object of which no node is known it goes with the others.
        assert!(found.carry(7, point, 1, 5).is_some());
        assert!(Scaffold::default().carry(1, point, 0, 0).is_none());
    }

    #[test]
    fn nothing_that_moves_has_no_nodes() {
        let found = scaffold(&clip(|_, _| None, |_| [0, 0], |_, _| false));
        assert!(found.nodes.is_empty());
    }
}
