//! Seeds on movers: points that a frame shows, carried to the canonical frame.

use super::seed::seed_from_points;
use super::surface::{lay, normal};
use super::windows::Window;
use crate::data::Point;
use crate::track::Track;
use crate::types::Gaussians;
use glam::{DQuat, DVec2, DVec3};

/// A seed of a Gaussian.
pub(super) struct Seed {
    /// The point at its canonical position, with its colour.
    point: Point,
    /// The frame that shows it.
    frame: usize,
    pixel: DVec2,
    canonical_from_view: DQuat,
    /// The normal of its surface in the frame's camera, if known.
    normal: Option<DVec3>,
}

impl Seed {
    /// A seed from a point in the world that belongs to the object with number `owner` and that a frame
    /// shows at a pixel, for a window. `None` where no node carries it to the window's canonical frame.
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

    /// The same seed on a surface with this normal in the frame's camera.
    pub fn facing(self, normal: DVec3) -> Seed {
        Seed { normal: Some(normal), ..self }
    }

    /// The same seed on the surface that the frame's depth shows at its pixel.
    pub fn on_surface(self, track: &Track) -> Seed {
        let normal = normal(&track.depth[self.frame], &track.intrinsics, self.pixel);
        Seed { normal, ..self }
    }

    /// Its cell in a grid with cells of this size, world units.
    pub fn cell(&self, size: f64) -> [i64; 3] {
        let position = DVec3::from(self.point.position.map(f64::from));
        (position / size.max(1e-9)).floor().as_i64vec3().to_array()
    }
}

/// Gaussians at the seeds, aligned with their surfaces.
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
