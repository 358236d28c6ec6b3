//! The first Gaussians on the movers.

use super::carried::{self, Seed};
use super::flank::{self, Flank, FlankPoint};
use super::lifting::{MOVING, value};
use super::sequence::{STRENGTH, Sequence, SequenceSettings, append, thinned};
use super::shadow::seed_shadows;
use super::windows::Window;
use crate::track::Track;
use crate::types::{Gaussians, Image};
use glam::DVec2;
use std::collections::HashSet;

/// Spacing of the Gaussians on visible surfaces of movers, pixels.
const SPACING: f64 = 2.0;
/// Spacing of the Gaussians on unseen sides, which are a guess, pixels.
const FLANK_SPACING: f64 = 3.0;
/// The share of Gaussians that may be seeded on shadows is one over this: shadows are smooth.
const SHADOWS: usize = 40;

/// Gaussians on the movers and on their shadows, in each of a clip's windows; `flanks` holds the unseen
/// sides of each frame, or is empty.
pub(super) fn seed_movers(
    sequence: Sequence<'_>,
    windows: &[Window],
    flanks: &[Vec<Option<Flank>>],
    settings: &SequenceSettings,
) -> Gaussians {
    let track = sequence.track;
    // In a window without a node nothing would carry its seeds.
    let is_carried = |window: &&Window| window.nodes(track).next().is_some();
    let windows = || windows.iter().filter(is_carried);
    let of_movers = windows().filter(|window| window.holds_movers());
    let most = settings.max_gaussians / 3 / of_movers.clone().count().max(1);
    let mut gaussians = Gaussians { sh_degree: settings.sh_degree, ..Gaussians::default() };
    for window in of_movers {
        let seeds = thinned(seeds(sequence, window, flanks), most);
        append(&mut gaussians, &carried::gaussians(track, &seeds, settings.sh_degree));
    }
    for window in windows().filter(|window| window.holds_shadows()) {
        let order = seeding_frames(window);
        let most = settings.max_gaussians / SHADOWS;
        let shadows = seed_shadows(track, window, &order, settings.sh_degree, most);
        append(&mut gaussians, &shadows);
    }
    gaussians.motion_logits = vec![STRENGTH; gaussians.len()];
    gaussians
}

/// Seeds on the movers, carried to a window's canonical frame from several of its frames, one per cell
/// of a grid: first on the surfaces that the frames show, then on the unseen sides behind the outlines.
fn seeds(sequence: Sequence<'_>, window: &Window, flanks: &[Vec<Option<Flank>>]) -> Vec<Seed> {
    let (track, frames) = (sequence.track, sequence.frames);
    let order = seeding_frames(window);
    let pixel_size = depth_of_movers(track) / track.intrinsics.fx;
    let cell = |seed: &Seed| seed.cell(SPACING * pixel_size);
    let flank_cell = |seed: &Seed| seed.cell(FLANK_SPACING * pixel_size);
    let (mut taken, mut taken_by_flanks) = (HashSet::new(), HashSet::new());
    let mut seeds = Vec::new();
    for &frame in &order {
        let fronts = fronts(track, window, frame, &frames[frame]);
        let free = fronts.filter(|seed| taken.insert(cell(seed)));
        seeds.extend(free.map(|seed| seed.on_surface(track)));
    }
    for &frame in order.iter().filter(|frame| **frame < flanks.len()) {
        let flanks = flank::points(track, frame, &flanks[frame], FLANK_SPACING).into_iter();
        let flanks = flanks.filter_map(|FlankPoint { pixel, depth, colour, normal }| {
            Some(seed(track, window, frame, pixel, depth, colour)?.facing(normal))
        });
        let free =
            |seed: &Seed| !taken.contains(&cell(seed)) && taken_by_flanks.insert(flank_cell(seed));
        seeds.extend(flanks.filter(free));
    }
    seeds
}

/// Seeds on the surfaces of movers that a frame shows.
fn fronts<'a>(
    track: &'a Track,
    window: &'a Window,
    frame: usize,
    image: &'a Image,
) -> impl Iterator<Item = Seed> + 'a {
    let (mask, depth) = (&track.masks[frame], &track.depth[frame]);
    let pixels = (0..mask.height).flat_map(|y| (0..mask.width).map(move |x| (x, y)));
    let moving = pixels.filter(|(x, y)| mask.at(*x, *y)[0] > MOVING);
    moving.filter_map(move |(x, y)| {
        let pixel = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
        let c = image.at(x, y);
        seed(track, window, frame, pixel, f64::from(depth.at(x, y)[0]), [c[0], c[1], c[2]])
    })
}

/// A seed on the mover that a pixel shows, at a depth.
fn seed(
    track: &Track,
    window: &Window,
    frame: usize,
    pixel: DVec2,
    depth: f64,
    colour: [f32; 3],
) -> Option<Seed> {
    let world_from_view = track.view_from_world[frame].inverse();
    let point = world_from_view.apply(track.intrinsics.ray(pixel) * depth);
    let owner = value(&track.owners[frame], pixel) as usize;
    Seed::new(track, window, frame, pixel, owner, point, colour)
}

/// The mean depth of the movers in the canonical frame.
fn depth_of_movers(track: &Track) -> f64 {
    let canonical = track.scaffold.canonical;
    let pixels = track.masks[canonical].pixels.iter().zip(&track.depth[canonical].pixels);
    let depths: Vec<f32> = pixels.filter(|(m, _)| **m > MOVING).map(|(_, z)| *z).collect();
    f64::from(depths.iter().sum::<f32>() / depths.len().max(1) as f32)
}

/// The frames that a window is seeded from: the canonical one, then some at even intervals.
fn seeding_frames(window: &Window) -> Vec<usize> {
    let every = window.frames.len().div_ceil(8).max(1);
    std::iter::once(window.canonical).chain(window.frames.clone().step_by(every)).collect()
}
