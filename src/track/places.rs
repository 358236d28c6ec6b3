//! Tracks scene points through every frame: static points by cameras and depth, moving ones by the scaffold.

use glam::{DVec2, DVec3};
use rayon::prelude::*;

use super::Track;
use super::scaffold::{owner, value};
use crate::types::{PointPath, Tracks};

/// Relative difference in depth above which a point is hidden: all pixels around its projection are nearer by
/// more than this.
const NEARER: f64 = 0.04;

impl Track {
    /// Tracks points through the whole clip. Each query is a frame and a pixel in it (pixel centres at +0.5).
    /// The result is the position in every frame, also where the point is hidden or outside the image, and
    /// whether the point is visible there.
    ///
    /// # Panics
    /// If a query's frame does not exist.
    pub fn follow(&self, queries: &[(usize, DVec2)]) -> Tracks {
        let size = (self.intrinsics.width, self.intrinsics.height);
        let points = queries.par_iter().map(|query| self.follow_point(*query)).collect();
        Tracks { size: Some(size), points }
    }

    fn follow_point(&self, query: (usize, DVec2)) -> PointPath {
        let (first, pixel) = query;
        let point = self.lift(first, pixel);
        let owner = self.owner(first, pixel);
        let mut path = PointPath { query, ..PointPath::default() };
        for frame in 0..self.view_from_world.len() {
            let there = match owner {
                None => point,
                Some(owner) => {
                    let carried = self.scaffold.carry(owner, point, first, frame);
                    carried.map_or(point, |(there, _)| there)
                }
            };
            let (pixel, seen) = self.shown(frame, there, owner);
            path.pixels.push(if frame == first { query.1 } else { pixel });
            path.seen.push(seen || frame == first);
        }
        path
    }

    /// The position in the world of the point that a pixel shows.
    pub(crate) fn lift(&self, frame: usize, pixel: DVec2) -> DVec3 {
        let z = f64::from(value(&self.depth[frame], pixel));
        self.view_from_world[frame].inverse().apply(self.intrinsics.ray(pixel) * z)
    }

    /// The object that a pixel shows; see [`owner`].
    fn owner(&self, frame: usize, pixel: DVec2) -> Option<usize> {
        owner(&self.masks[frame], &self.owners[frame], pixel)
    }

    /// The pixel of a point in a frame, and whether it is visible there: within a pixel of it, the frame
    /// shows a surface of the same object that is not nearer. The pixel is NaN behind the camera.
    fn shown(&self, frame: usize, point: DVec3, owner: Option<usize>) -> (DVec2, bool) {
        let local = self.view_from_world[frame].apply(point);
        if local.z <= 0.0 {
            return (DVec2::NAN, false);
        }
        let at = self.intrinsics.project(local);
        let size = DVec2::new(self.intrinsics.width.into(), self.intrinsics.height.into());
        if !(at.cmpge(DVec2::ZERO).all() && at.cmplt(size).all()) {
            return (at, false);
        }
        let shows = |i: i32| {
            let near = at + DVec2::new(f64::from(i % 3 - 1), f64::from(i / 3 - 1));
            self.owner(frame, near) == owner
                && local.z <= f64::from(value(&self.depth[frame], near)) * (1.0 + NEARER)
        };
        (at, (0..9).any(shows))
    }
}
