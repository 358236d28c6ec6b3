//! Gaussians for the shadows that movers cast.
//!
//! A shadow scales what it falls on, and so does a faint black Gaussian that lies right before it: no part
//! of the renderer and no file format has to know of shadows. It moves with the scaffold's nodes for
//! shadows.

use super::seed::seed_from_points;
use super::surface::{lay, normal};
use crate::data::Point;
use crate::track::Track;
use crate::types::Gaussians;
use glam::{DVec2, DVec3};
use std::collections::HashSet;

/// A shadow's Gaussians lie before the ground by this share of the ground's distance.
const BEFORE: f64 = 0.015;
/// Distance of the Gaussians, pixels.
const SPACING: f64 = 5.0;
/// The weights of Gaussians that are as wide as far from each other add up to 2π.
const OVERLAP: f32 = std::f32::consts::TAU;

/// Gaussians on the shadows, brought back to the canonical frame from some frames, at most `most`.
pub(super) fn seed_shadows(
    track: &Track,
    frames: &[usize],
    sh_degree: u32,
    most: usize,
) -> Gaussians {
    let canonical = track.scaffold.canonical;
    let mut taken = HashSet::new();
    let mut seeds: Vec<(Point, f32, DVec3, Option<DVec3>)> = Vec::new();
    for &frame in frames {
        let shadow = &track.shadows[frame];
        let world_from_view = track.view_from_world[frame].inverse();
        for (x, y) in (0..shadow.height).flat_map(|y| (0..shadow.width).map(move |x| (x, y))) {
            let [share, owner] = shadow.at(x, y) else { continue };
            if *share <= 0.0 {
                continue;
            }
            let pixel = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
            let ground = track.lift(frame, pixel);
            let here = ground + BEFORE * (world_from_view.translation - ground);
            let there = track.scaffold.carry(*owner as usize, here, frame, canonical);
            let Some((position, turned)) = there else { continue };
            let depth = track.view_from_world[frame].apply(here).z;
            let cell = position * track.intrinsics.fx / (SPACING * depth.max(1e-9));
            if !position.is_finite() || !taken.insert(cell.floor().as_i64vec3()) {
                continue;
            }
            let canonical_from_view = turned * world_from_view.rotation;
            let normal = normal(&track.depth[frame], &track.intrinsics, pixel);
            seeds.push((
                Point { position: position.as_vec3().to_array(), colour: [0.0; 3] },
                *share,
                canonical_from_view * track.intrinsics.ray(pixel),
                normal.map(|normal| canonical_from_view * normal),
            ));
        }
    }
    let keep = seeds.len().div_ceil(most.max(1)).max(1);
    let seeds: Vec<_> = seeds.into_iter().step_by(keep).collect();
    let points: Vec<Point> = seeds.iter().map(|seed| seed.0).collect();
    let mut gaussians = seed_from_points(&points, sh_degree);
    for (i, (_, share, ray, normal)) in seeds.iter().enumerate() {
        let opacity = opacity(*share);
        gaussians.opacity_logits[i] = (opacity / (1.0 - opacity)).ln();
        if let Some(normal) = normal {
            lay(&mut gaussians, i, *ray, *normal);
        }
    }
    gaussians
}

/// The opacity of Gaussians that together take a share of the light away.
fn opacity(share: f32) -> f32 {
    (-(1.0 - share.min(0.95)).ln() / OVERLAP).clamp(0.01, 0.5)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gaussians_together_take_the_share_away() {
        for share in [0.1f32, 0.4, 0.7] {
            for at in [DVec2::new(0.0, 0.0), DVec2::new(0.5, 0.5), DVec2::new(0.3, 0.1)] {
                // As wide as far from each other, on a grid.
                let offsets = (-6..=6).flat_map(|y| (-6..=6).map(move |x| (x, y)));
                let left: f64 = offsets
                    .map(|(x, y)| {
                        let off = DVec2::new(f64::from(x), f64::from(y)) - at;
                        let weight = (-0.5 * off.length_squared()).exp();
                        1.0 - f64::from(opacity(share)) * weight
                    })
                    .product();
                assert!((1.0 - left - f64::from(share)).abs() < 0.05, "{share}: {}", 1.0 - left);
            }
        }
    }
}
