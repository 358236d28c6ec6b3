//! Where a point of the scene is in every frame: what still stands by cameras and depth, what moves by the
//! scaffold.

use glam::{DVec2, DVec3};
use rayon::prelude::*;

use super::Track;
use super::scaffold::{owner, value};
use crate::types::{PointPath, Tracks};

/// A point is hidden where all that is shown about its place is nearer by more than this share.
const NEARER: f64 = 0.04;

impl Track {
    /// Follows points through the whole clip, each asked for by a frame and a pixel there (centres at +0.5):
    /// where it is in every frame, behind others or outside of the picture too, and whether it is seen
    /// there.
    ///
    /// # Panics
    /// When there is no such frame.
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

    /// The point in the world that a pixel shows.
    pub(crate) fn lift(&self, frame: usize, pixel: DVec2) -> DVec3 {
        let z = f64::from(value(&self.depth[frame], pixel));
        self.view_from_world[frame].inverse().apply(self.intrinsics.ray(pixel) * z)
    }

    /// The object that a pixel shows, as [`owner`] tells it.
    fn owner(&self, frame: usize, pixel: DVec2) -> Option<usize> {
        owner(&self.masks[frame], &self.owners[frame], pixel)
    }

    /// Where a point is in a frame, and whether it is seen there: something of its own object, not
    /// nearer, is shown within a pixel.
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
