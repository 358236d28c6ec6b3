//! Gaussians seeded on what moves: points that a frame shows, where they are in the canonical frame.

use super::seed::seed_from_points;
use super::surface::{lay, normal};
use super::windows::Window;
use crate::data::Point;
use crate::track::Track;
use crate::types::Gaussians;
use glam::{DQuat, DVec2, DVec3};

/// A Gaussian to be.
pub(super) struct Seed {
    /// At its canonical place.
    point: Point,
    /// Where it was seen.
    frame: usize,
    pixel: DVec2,
    canonical_from_view: DQuat,
    /// The normal of the surface that it lies on, if it is known, in the frame's camera.
    normal: Option<DVec3>,
}

impl Seed {
    /// A point in the world, of the object with number `owner`, that a frame shows in a pixel, in a
    /// window; `None` where nothing carries it to the window's canonical frame.
    pub fn new(
        track: &Track,
        window: &Window,
        frame: usize,
        pixel: DVec2,
        owner: usize,
        point: DVec3,
        colour: [f32; 3],
    ) -> Option<Seed> {
        let (place, turned) = track.scaffold.carry(owner, point, frame, window.canonical)?;
        let position = place + window.offset;
        position.is_finite().then(|| Seed {
            point: Point { position: position.as_vec3().to_array(), colour },
            frame,
            pixel,
            canonical_from_view: turned * track.view_from_world[frame].rotation.conjugate(),
            normal: None,
        })
    }

    /// The same on a surface with this normal in the frame's camera.
    pub fn facing(self, normal: DVec3) -> Seed {
        Seed { normal: Some(normal), ..self }
    }

    /// The same on the surface that the frame's depth shows there.
    pub fn on_surface(self, track: &Track) -> Seed {
        let normal = normal(&track.depth[self.frame], &track.intrinsics, self.pixel);
        Seed { normal, ..self }
    }

    /// Its cell in a grid of this size.
    pub fn cell(&self, size: f64) -> [i64; 3] {
        let position = DVec3::from(self.point.position.map(f64::from));
        (position / size.max(1e-9)).floor().as_i64vec3().to_array()
    }
}

/// Gaussians on the seeds, laid along their surfaces.
pub(super) fn gaussians(track: &Track, seeds: &[Seed], sh_degree: u32) -> Gaussians {
    let points: Vec<Point> = seeds.iter().map(|seed| seed.point).collect();
    let mut gaussians = seed_from_points(&points, sh_degree);
    for (i, seed) in seeds.iter().enumerate() {
        if let Some(normal) = seed.normal {
            let ray = seed.canonical_from_view * track.intrinsics.ray(seed.pixel);
            lay(&mut gaussians, i, ray, seed.canonical_from_view * normal);
        }
    }
    gaussians
}
