//! Tests on exact pairs of a synthetic world, with noise, outliers and gaps.

use glam::{DQuat, DVec2, DVec3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::{Aligned, align};
use crate::Result;
use crate::geometry::se3::{angle_between, exp_so3};
use crate::geometry::sim3::align_cameras;
use crate::observe::pointmaps::{PairMaps, Placement, PointmapSource, Pointmaps};
use crate::types::{Image, Pose};

/// Centre and radius of a sphere that is seen from inside.
const CENTRE: DVec3 = DVec3::new(0.6, -0.4, 1.0);
const RADIUS: f64 = 5.0;

/// A synthetic world with exact maps, and the errors that are added to them.
struct World {
    placement: Placement,
    focal: f64,
    /// World to camera.
    poses: Vec<Pose>,
    random: ChaCha8Rng,
    /// Relative standard deviation of the depth noise.
    noise: f64,
    /// Share of the points that are displaced along their ray, with the same confidence as the others.
    outliers: f64,
    /// Share of the points that are displaced, with low confidence.
    doubtful: f64,
    confidence: f32,
    /// First frame that may still be requested.
    forgotten: usize,
}

impl World {
    fn new(placement: Placement, focal: f64, poses: Vec<Pose>) -> World {
        World {
            placement,
            focal,
            poses,
            random: ChaCha8Rng::seed_from_u64(7),
            noise: 0.0,
            outliers: 0.0,
            doubtful: 0.0,
            confidence: 10.0,
            forgotten: 0,
        }
    }

    /// A camera path with rotations.
    fn walk(width: u32, height: u32, frames: usize) -> World {
        let pose = |i: usize| {
            let t = i as f64 / 12.0;
            let at = DVec3::new(0.9 * t.sin(), 0.3 * (1.7 * t).sin(), 0.5 * (0.8 * t).cos());
            let turn = exp_so3(DVec3::new(0.15 * (0.9 * t).sin(), 0.4 * t.cos() - 0.4, 0.1 * t));
            Pose::new(turn, -(turn * at))
        };
        let focal = 0.8 * f64::from(width.max(height));
        World::new(Placement::whole(width, height), focal, (0..frames).map(pose).collect())
    }

    /// Depth of the sphere at a position of a frame.
    fn point(&self, frame: usize, pixel: DVec2) -> DVec3 {
        let ray = ((pixel - self.placement.middle()) / self.focal).extend(1.0);
        let centre = self.poses[frame].apply(CENTRE);
        let (a, b) = (ray.length_squared(), ray.dot(centre));
        let c = centre.length_squared() - RADIUS * RADIUS;
        ray * ((b + (b * b - a * c).sqrt()) / a)
    }

    fn gather(&mut self) -> Pointmaps {
        let frames = self.poses.len();
        let mut shares = Vec::new();
        let gathered = Pointmaps::gather(self, frames, &mut |share| {
            shares.push(share);
            Ok(())
        });
        assert_eq!(shares.last(), Some(&1.0));
        gathered.unwrap()
    }
}

impl PointmapSource for World {
    fn placement(&self) -> Placement {
        self.placement
    }

    fn pair(&mut self, first: usize, second: usize) -> Result<PairMaps> {
        assert!(first.min(second) >= self.forgotten, "{first} {second}");
        let (width, height) = self.placement.picture;
        let unit = self.random.random_range(0.2..5.0);
        let mut maps = PairMaps {
            points: [(); 2].map(|()| Image::new(width, height, 3)),
            confidence: [(); 2].map(|()| Image::new(width, height, 1)),
        };
        for (k, frame) in [first, second].into_iter().enumerate() {
            let pair_from_frame = self.poses[first] * self.poses[frame].inverse();
            for (x, y) in (0..height).flat_map(|y| (0..width).map(move |x| (x, y))) {
                let at = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
                let mut point = self.point(frame, self.placement.frame_from_picture(at));
                let normal: f64 = (0..12).map(|_| self.random.random_range(-0.5..0.5)).sum();
                point *= 1.0 + self.noise * normal;
                let chance = self.random.random_range(0.0..1.0);
                if chance < self.outliers + self.doubtful {
                    point *= self.random.random_range(0.3..3.0);
                }
                let point = unit * pair_from_frame.apply(point);
                maps.points[k].at_mut(x, y).copy_from_slice(&point.as_vec3().to_array());
                let known = chance < self.doubtful;
                maps.confidence[k].at_mut(x, y)[0] = if known { 1.05 } else { self.confidence };
            }
        }
        Ok(maps)
    }

    fn forget(&mut self, before: usize) {
        self.forgotten = before;
    }
}

/// Error of a result: rotation in degrees, position as a share of the path's extent, relative error of the
/// focal length, and relative depth error of the median pixel.
struct Error {
    turn: f64,
    place: f64,
    focal: f64,
    depth: f64,
}

fn error(world: &World, maps: Pointmaps, found: &Aligned) -> Error {
    let centres = |poses: &[Pose]| poses.iter().map(Pose::inverse).collect::<Vec<_>>();
    let (estimate, truth) = (centres(&found.view_from_world), centres(&world.poses));
    let similarity = align_cameras(&estimate, &truth, true).unwrap().reference_from_estimate;
    let mean = truth.iter().map(|pose| pose.translation).sum::<DVec3>() / truth.len() as f64;
    let (mut turn, mut off, mut spread) = (0.0f64, 0.0, 0.0);
    for (e, t) in estimate.iter().zip(&truth) {
        let mapped = similarity.apply_pose(e);
        turn = turn.max(angle_between(mapped.rotation, t.rotation).to_degrees());
        off += mapped.translation.distance_squared(t.translation);
        spread += t.translation.distance_squared(mean);
    }
    let depth = maps.into_depth(&found.depth_factors);
    let mut ratios = Vec::new();
    for (frame, map) in depth.maps.iter().enumerate() {
        for (x, y) in (0..map.height).flat_map(|y| (0..map.width).map(move |x| (x, y))) {
            let at = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
            let told = f64::from(map.at(x, y)[0]) * similarity.scale;
            if told.is_finite() {
                ratios.push((told / world.point(frame, at).z).ln().abs());
            }
        }
    }
    Error {
        turn,
        place: (off / spread.max(1e-12)).sqrt(),
        focal: (found.focal / world.focal).ln().abs(),
        depth: super::quantile(ratios, 0.5),
    }
}

/// Aligns a world, and asserts that all errors are within `most`.
fn within(mut world: World, most: Error) -> Aligned {
    let maps = world.gather();
    let found = align(&maps, None).unwrap();
    let Error { turn, place, focal, depth } = error(&world, maps, &found);
    println!(
        "turn {turn:.2e} place {place:.2e} focal {focal:.2e} depth {depth:.2e} off {:.2e}",
        found.off
    );
    assert!(turn <= most.turn && place <= most.place, "turn {turn} place {place}");
    assert!(focal <= most.focal && depth <= most.depth, "focal {focal} depth {depth}");
    found
}

/// Error bounds that the precision of f32 maps allows.
const EXACT: Error = Error { turn: 1e-4, place: 1e-5, focal: 1e-6, depth: 1e-5 };

#[test]
fn exact_maps_of_any_size_give_exact_cameras() {
    for (width, height, frames) in
        [(56, 32, 14), (30, 52, 9), (33, 33, 5), (41, 23, 3), (32, 24, 2)]
    {
        let found = within(World::walk(width, height, frames), EXACT);
        assert_eq!(found.view_from_world[0], Pose::IDENTITY);
        assert!(found.off < 1e-5 && found.focal_deviation < 1e-5, "{}", found.off);
    }
}

#[test]
fn a_picture_that_is_cut_and_scaled_is_the_frames() {
    let mut world = World::walk(96, 70, 6);
    world.placement = Placement {
        frame: (96, 70),
        picture: (48, 32),
        scale: DVec2::splat(2.0),
        corner: DVec2::new(0.0, 3.0),
    };
    let maps = world.gather();
    let found = align(&maps, None).unwrap();
    let row = |y: u32| maps.depth[1].at(40, y)[0];
    assert!(row(2).is_nan() && row(67).is_nan() && row(3).is_finite() && row(66).is_finite());
    assert!((found.focal / world.focal - 1.0).abs() < 1e-5, "{} {}", found.focal, world.focal);
}

#[test]
fn noise_outliers_and_what_is_known_to_be_wrong_are_averaged_out() {
    let mut world = World::walk(56, 32, 20);
    world.noise = 0.02;
    // The largest uncertainty is that of a short path's scale relative to the scene.
    within(world, Error { turn: 0.3, place: 0.03, focal: 1e-3, depth: 0.025 });
    let mut world = World::walk(56, 32, 20);
    world.outliers = 0.25;
    within(world, Error { turn: 0.1, place: 0.01, focal: 1e-3, depth: 0.1 });
    // Most of the frame is wrong, with low confidence.
    let mut world = World::walk(56, 32, 20);
    world.doubtful = 0.45;
    within(world, EXACT);
    let mut world = World::walk(32, 56, 20);
    (world.noise, world.outliers, world.doubtful) = (0.02, 0.15, 0.2);
    within(world, Error { turn: 1.0, place: 0.08, focal: 5e-3, depth: 0.15 });
}

#[test]
fn a_long_clip_does_not_drift() {
    let mut world = World::walk(32, 18, 150);
    world.noise = 0.02;
    within(world, Error { turn: 1.0, place: 0.05, focal: 1e-3, depth: 0.02 });
}

#[test]
fn a_known_focal_length_is_kept() {
    let mut world = World::walk(40, 24, 5);
    let maps = world.gather();
    let found = align(&maps, Some(1.1 * world.focal)).unwrap();
    assert_eq!((found.focal, found.focal_deviation), (1.1 * world.focal, 0.0));
}

#[test]
fn a_camera_that_stays_or_only_turns_is_found_to() {
    for turn in [0.0, 0.02] {
        let pose = |i: usize| Pose::new(DQuat::from_rotation_y(turn * i as f64), DVec3::ZERO);
        let poses: Vec<Pose> = (0..6).map(pose).collect();
        let mut world = World::new(Placement::whole(40, 24), 40.0, poses.clone());
        let found = align(&world.gather(), None).unwrap();
        for (found, truth) in found.view_from_world.iter().zip(&poses) {
            assert!(found.translation.length() < 1e-5, "{}", found.translation);
            assert!(angle_between(found.rotation, truth.rotation) < 1e-6);
        }
    }
}

#[test]
fn maps_that_nobody_believes_are_refused() {
    let mut world = World::walk(40, 24, 5);
    world.confidence = 1.0;
    let refused = align(&world.gather(), None).unwrap_err().to_string();
    assert!(refused.contains("not believed by their own network"), "{refused}");
    let alone = Pointmaps::gather(&mut world, 1, &mut |_| Ok(())).unwrap_err().to_string();
    assert!(alone.contains("two frames"), "{alone}");
}

#[test]
fn the_same_maps_give_the_same_bits() {
    let found = || {
        let mut world = World::walk(40, 24, 8);
        (world.noise, world.outliers) = (0.02, 0.1);
        let found = align(&world.gather(), None).unwrap();
        (found.view_from_world, found.focal.to_bits())
    };
    assert_eq!(found(), found());
}
