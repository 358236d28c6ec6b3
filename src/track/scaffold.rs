//! The scaffold: control points on the movers' surfaces, each of which moves rigidly through the whole clip.
//!
//! Dense flow between neighbouring frames, lifted to 3D with the frames' depth, gives the motion of surface
//! points. The control points' motions from one frame to the next are those that explain this motion best and
//! keep each control point's neighbourhood as rigid as possible (embedded deformation: Sumner, Schmid, Pauly
//! 2007; rotations and translations alternate as in Sorkine and Alexa 2007). Surface that is hidden, or whose
//! flow is unreliable, moves with its neighbourhood. So no point has to be tracked individually: chained
//! tracks on a body lose half of their points every few frames. If flow can be chained over several frames,
//! it is more informative: the same points, from frames farther back, keep the control points from drifting
//! along the surface, because the errors of single steps do not accumulate in them.
//!
//! The scaffold begins in the frame that shows most of the movers. If a later frame shows surface without a
//! nearby control point, control points are added there. They are then carried to all other frames, guided by
//! the control points whose positions there are already known.

mod build;
mod life;
mod step;

use std::ops::Range;

use glam::{DMat3, DQuat, DVec2, DVec3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

pub(super) use self::build::build;
use self::step::{Match, followed, rigid};
use super::Mover;
use crate::geometry::se3::matrix3;
use crate::geometry::sim3::nearest_rotation;
use crate::observe::NeighbourFlow;
use crate::types::{Image, Intrinsics, Pose};

/// Minimum confidence of flow that is used.
const CONFIDENCE: f32 = 0.3;
/// If more pixels than this move, only every second one along each axis is used.
const PLENTY: usize = 8000;
/// Maximum number of edges per control point.
const EDGES: usize = 8;
/// Two control points share no edge if they are farther apart than `REACH` spacings in any frame. Each
/// control point keeps edges to its `ALWAYS` nearest neighbours regardless of distance.
const REACH: f64 = 4.0;
const ALWAYS: usize = 2;
/// Minimum number of surface points that an object's own motion is estimated from.
const LEAST_MATCHES: usize = 20;
/// The motion of an object as a whole is used if its residual is at most this many times the residual of the
/// motion fitted to the surface points from frame to frame: it does not drift.
const BELIEVED: f64 = 3.0;

/// The control points on the movers.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Scaffold {
    /// The frame that shows most of the movers, near the middle of the clip.
    pub canonical: usize,
    /// The control points.
    pub nodes: Vec<Node>,
}

/// A control point: a position on a mover's surface that moves rigidly with its surroundings.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Node {
    /// The number of the object that the control point is on, as in [`super::Track::owners`], or of the
    /// shadow, as in [`super::Track::shadows`]; 0 if no object is known.
    pub owner: usize,
    /// Transforms from the control point to the world, frame by frame. Only differences of the rotation
    /// between frames are meaningful.
    pub world_from_node: Vec<Pose>,
    /// Approximate distance to neighbouring control points, in the world's unit.
    pub spacing: f64,
    /// The frames in which the control point exists: from the appearance of its object until the object is
    /// gone.
    pub alive: Range<usize>,
}

/// The measured surfaces of the movers.
pub(super) struct Surfaces<'a> {
    pub intrinsics: Intrinsics,
    pub view_from_world: &'a [Pose],
    pub flow: &'a NeighbourFlow,
    pub masks: &'a [Image],
    pub depth: &'a [Image],
    pub owners: &'a [Image],
    pub movers: &'a [Mover],
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

/// The object that a pixel shows, from a frame's mask and [`super::Track::owners`]: 0 if no object is known,
/// `None` at a static pixel.
pub(super) fn owner(mask: &Image, owners: &Image, pixel: DVec2) -> Option<usize> {
    (value(mask, pixel) > 0.5).then(|| value(owners, pixel) as usize)
}

impl Surfaces<'_> {
    fn owner(&self, frame: usize, pixel: DVec2) -> Option<usize> {
        owner(&self.masks[frame], &self.owners[frame], pixel)
    }

    /// The point in the world that a pixel shows.
    pub(super) fn lift(&self, frame: usize, pixel: DVec2) -> DVec3 {
        let z = f64::from(value(&self.depth[frame], pixel));
        self.view_from_world[frame].inverse().apply(self.intrinsics.ray(pixel) * z)
    }

    /// The size of a pixel in the world at the depth of a point.
    pub(super) fn pixel_size(&self, frame: usize, point: DVec3) -> f64 {
        self.view_from_world[frame].apply(point).z.max(1e-6) / self.intrinsics.fx
    }

    /// The unit vector from the camera to a point.
    fn sight(&self, frame: usize, point: DVec3) -> DVec3 {
        (point - self.view_from_world[frame].inverse().translation).normalize_or_zero()
    }

    /// Centres of the pixels of a frame whose four neighbours show the same object, with that object, on a
    /// grid with spacing `every`.
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

    /// The motion of every object from a frame to the next, by object number; number 0, surface without an
    /// object, does not move.
    fn object_steps(&self, frame: usize) -> Vec<Pose> {
        let mut own: Vec<Vec<Match>> = (0..=self.movers.len()).map(|_| Vec::new()).collect();
        self.matches(frame, frame + 1).into_iter().for_each(|m| own[m.owner].push(m));
        let mut steps = vec![Pose::IDENTITY];
        for (object, matches) in self.movers.iter().zip(&own[1..]) {
            steps.push(self.object_step(object, frame, matches));
        }
        steps
    }

    /// The motion of an object from a frame to the next: the motion found for the whole object, or, if that
    /// does not agree with the surface points, the motion fitted to them.
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

    /// Surface points of a frame that flow maps to the neighbouring frame, on the same object.
    fn matches(&self, from: usize, to: usize) -> Vec<Match> {
        let every = if area(&self.masks[from]) > PLENTY { 2 } else { 1 };
        let find = |&(pixel, owner): &(DVec2, usize)| {
            let next = self.flow.step(from, to > from, pixel)?;
            if next.confidence < CONFIDENCE || self.owner(to, next.pixel) != Some(owner) {
                return None;
            }
            let certainty = f64::from(next.confidence) * (every * every) as f64;
            Some(self.matched(owner, self.lift(from, pixel), (to, next.pixel), certainty))
        };
        self.inner_pixels(from, every).par_iter().filter_map(find).collect()
    }

    /// The match of a surface point with the pixel of a frame that shows it.
    fn matched(
        &self,
        owner: usize,
        here: DVec3,
        (to, pixel): (usize, DVec2),
        certainty: f64,
    ) -> Match {
        let there = self.lift(to, pixel);
        Match {
            owner,
            here,
            there,
            sight: self.sight(to, there),
            weight: certainty / self.pixel_size(to, there).powi(2),
            certainty,
        }
    }
}

impl Scaffold {
    /// Carries a surface point of an object from one frame to another with its nearest control points.
    /// Returns its position there and its rotation from one frame to the other. `None` if there are no
    /// control points at all.
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
        // Neighbours are the control points that are near in both frames.
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

    /// A clip of a fixed camera, in which everything is at depth 1. `part` gives the part of the object that
    /// a pixel shows in the first frame, and `speed` the speed of that part in pixels per frame.
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
            // The motion of the object as a whole is wrong: the object does not move in it.
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

    /// The displacement of a control point from the first frame to another, in pixels.
    fn gone(node: &Node, frame: usize) -> DVec3 {
        let place = |frame: usize| node.world_from_node[frame].translation;
        FOCAL * (place(frame) - place(0))
    }

    /// The position of the control point in the first frame, pixels.
    fn begins(node: &Node) -> DVec2 {
        let view = node.world_from_node[0].translation;
        Intrinsics::centred(FOCAL, SIZE.0, SIZE.1).project(view)
    }

    fn block(x: i32, y: i32) -> bool {
        (10..50).contains(&x) && (10..34).contains(&y)
    }

    #[test]
    fn what_is_rigid_goes_as_one_even_where_it_is_hidden() {
        // A post stands in front of the middle of the image; what is behind it is not seen.
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
            // Control points at the seam follow both parts.
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
        // A point on an object without control points moves with the others.
        assert!(found.carry(7, point, 1, 5).is_some());
        assert!(Scaffold::default().carry(1, point, 0, 0).is_none());
    }

    #[test]
    fn what_comes_and_goes_is_there_only_in_between() {
        // The object appears in the third frame, is hidden in the fourth, and is last seen in the fifth.
        let came = clip(|x, y| block(x, y).then_some(0), |_| [3, 0], |f, _| ![2, 4].contains(&f));
        let found = scaffold(&came);
        assert!(found.nodes.len() > 60, "{}", found.nodes.len());
        for node in &found.nodes {
            assert_eq!(node.alive, 2..5);
        }
        // The object leaves through the image border: it may still exist outside the image.
        let mut left = clip(|x, y| block(x, y).then_some(0), |_| [22, 0], |_, _| false);
        let seen = (0..FRAMES).rev().find(|f| left.masks[*f].pixels.iter().any(|m| *m > 0.5));
        let end = seen.unwrap() + 1;
        assert!(end < FRAMES, "it leaves before the end");
        left.movers[0].world_from_object.truncate(end);
        for node in scaffold(&left).nodes {
            assert!(node.alive.start == 0 && node.alive.end > end, "{:?}", node.alive);
        }
    }

    #[test]
    fn nothing_that_moves_has_no_nodes() {
        let found = scaffold(&clip(|_, _| None, |_| [0, 0], |_, _| false));
        assert!(found.nodes.is_empty());
    }
}
