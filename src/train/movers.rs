//! The first Gaussians on what moves.

use super::flank::{self, Flank};
use super::lifting::{MOVING, value};
use super::seed::seed_from_points;
use super::sequence::{STRENGTH, Sequence, SequenceSettings, append, thinned};
use super::shadow::seed_shadows;
use super::surface::{lay, normal};
use crate::data::Point;
use crate::track::Track;
use crate::types::{Gaussians, Image};
use glam::{DVec2, DVec3};
use std::collections::HashSet;

/// Distance of the Gaussians that fronts are seeded with, pixels.
const SPACING: f64 = 2.0;
/// Of those that flanks are: they are a guess.
const FLANK_SPACING: f64 = 3.0;
/// Of so many Gaussians one may be seeded on a shadow: shadows are smooth.
const SHADOWS: usize = 40;

/// A Gaussian to be, in the canonical frame.
struct Seed {
    point: Point,
    /// Towards where it was seen.
    ray: DVec3,
    normal: Option<DVec3>,
}

/// Gaussians on the movers, brought back to the canonical frame from several frames, one per cell of
/// a grid: on what the frames show, then on what may lie behind its outlines (`flanks`, for
/// each frame, or none); and on shadows.
pub(super) fn seed_movers(
    sequence: Sequence<'_>,
    flanks: &[Vec<Option<Flank>>],
    settings: &SequenceSettings,
) -> Gaussians {
    let (track, frames) = (sequence.track, sequence.frames);
    let order = seeding_frames(frames.len(), track.scaffold.canonical);
    let pixel_size = depth_of_movers(track) / track.intrinsics.fx;
    let cell = |seed: &Seed, spacing: f64| {
        let position = DVec3::from(seed.point.position.map(f64::from));
        (position / (spacing * pixel_size).max(1e-9)).floor().as_i64vec3()
    };
    let (mut taken, mut taken_by_flanks) = (HashSet::new(), HashSet::new());
    let mut seeds = Vec::new();
    for &frame in &order {
        let fronts = fronts(track, frame, &frames[frame]).into_iter();
        seeds.extend(fronts.filter(|seed| taken.insert(cell(seed, SPACING))));
    }
    for &frame in order.iter().filter(|frame| **frame < flanks.len()) {
        let points = flank::points(track, frame, &flanks[frame], FLANK_SPACING).into_iter();
        let flanks = points.filter_map(|flank| {
            seed(track, frame, flank.pixel, flank.depth, flank.colour, Some(flank.normal))
        });
        seeds.extend(flanks.filter(|seed| {
            !taken.contains(&cell(seed, SPACING))
                && taken_by_flanks.insert(cell(seed, FLANK_SPACING))
        }));
    }
    let seeds = thinned(seeds, settings.max_gaussians / 3);
    let points: Vec<Point> = seeds.iter().map(|seed| seed.point).collect();
    let mut gaussians = seed_from_points(&points, settings.sh_degree);
    for (i, seed) in seeds.iter().enumerate() {
        if let Some(normal) = seed.normal {
            lay(&mut gaussians, i, seed.ray, normal);
        }
    }
    let most = settings.max_gaussians / SHADOWS;
    let shadows = seed_shadows(track, &order, settings.sh_degree, most);
    append(&mut gaussians, &shadows);
    gaussians.motion_logits = vec![STRENGTH; gaussians.len()];
    gaussians
}

/// What a frame shows of the movers.
fn fronts(track: &Track, frame: usize, image: &Image) -> Vec<Seed> {
    let (mask, depth) = (&track.masks[frame], &track.depth[frame]);
    let pixels = (0..mask.height).flat_map(|y| (0..mask.width).map(move |x| (x, y)));
    let moving = pixels.filter(|(x, y)| mask.at(*x, *y)[0] > MOVING);
    let seeds = moving.filter_map(|(x, y)| {
        let pixel = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
        let c = image.at(x, y);
        let normal = normal(depth, &track.intrinsics, pixel);
        seed(track, frame, pixel, f64::from(depth.at(x, y)[0]), [c[0], c[1], c[2]], normal)
    });
    seeds.collect()
}

/// A point of the mover that a pixel shows, at a depth in a frame, where it is in the canonical one. The
/// normal is in the frame's camera.
fn seed(
    track: &Track,
    frame: usize,
    pixel: DVec2,
    depth: f64,
    colour: [f32; 3],
    normal: Option<DVec3>,
) -> Option<Seed> {
    let view_from_world = track.view_from_world[frame];
    let ray = track.intrinsics.ray(pixel);
    let here = view_from_world.inverse().apply(ray * depth);
    let owner = value(&track.owners[frame], pixel) as usize;
    let (position, turned) = track.scaffold.carry(owner, here, frame, track.scaffold.canonical)?;
    position.is_finite().then(|| {
        let canonical_from_view = turned * view_from_world.rotation.conjugate();
        Seed {
            point: Point { position: position.as_vec3().to_array(), colour },
            ray: canonical_from_view * ray,
            normal: normal.map(|normal| canonical_from_view * normal),
        }
    })
}

/// The mean depth of what moves in the canonical frame.
fn depth_of_movers(track: &Track) -> f64 {
    let canonical = track.scaffold.canonical;
    let pixels = track.masks[canonical].pixels.iter().zip(&track.depth[canonical].pixels);
    let depths: Vec<f32> = pixels.filter(|(m, _)| **m > MOVING).map(|(_, z)| *z).collect();
    f64::from(depths.iter().sum::<f32>() / depths.len().max(1) as f32)
}

/// The frames that movers are seeded from: the canonical one, then some evenly.
fn seeding_frames(count: usize, canonical: usize) -> Vec<usize> {
    let every = count.div_ceil(8).max(1);
    std::iter::once(canonical).chain((0..count).step_by(every)).collect()
}
