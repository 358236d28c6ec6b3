//! Gaussians for the shadows that movers cast.
//!
//! A shadow scales the colour of the surface that it falls on, and so does a faint black Gaussian
//! directly before that surface. Therefore neither the renderer nor a file format needs to support
//! shadows. The Gaussian moves with the scaffold's nodes for shadows.

use super::carried::{Seed, gaussians};
use super::sequence::thinned;
use super::windows::Window;
use crate::track::Track;
use crate::types::Gaussians;
use glam::DVec2;
use std::collections::HashSet;

/// Distance of a shadow's Gaussians before the ground, as a share of the ground's distance from the
/// camera.
const BEFORE: f64 = 0.015;
/// Spacing of the Gaussians, pixels.
const SPACING: f64 = 5.0;
/// The weights of Gaussians whose standard deviation equals their spacing on a grid add up to 2π.
const OVERLAP: f32 = std::f32::consts::TAU;

/// Gaussians on the shadows in a window, carried to its canonical frame from some frames, at most
/// `most`.
pub(super) fn seed_shadows(
    track: &Track,
    window: &Window,
    frames: &[usize],
    sh_degree: u32,
    most: usize,
) -> Gaussians {
    let mut taken = HashSet::new();
    let (mut seeds, mut shares) = (Vec::new(), Vec::new());
    for &frame in frames {
        let shadow = &track.shadows[frame];
        let view_from_world = track.view_from_world[frame];
        let centre = view_from_world.inverse().translation;
        for (x, y) in (0..shadow.height).flat_map(|y| (0..shadow.width).map(move |x| (x, y))) {
            let [share, owner] = *shadow.at(x, y) else { continue };
            if share <= 0.0 {
                continue;
            }
            let pixel = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
            let ground = track.lift(frame, pixel);
            let here = ground + BEFORE * (centre - ground);
            let seed = Seed::new(track, window, frame, pixel, owner as usize, here, [0.0; 3]);
            let size = SPACING * view_from_world.apply(here).z / track.intrinsics.fx;
            if let Some(seed) = seed.filter(|seed| taken.insert(seed.cell(size))) {
                seeds.push(seed.on_surface(track));
                shares.push(share);
            }
        }
    }
    let mut gaussians = gaussians(track, &thinned(seeds, most), sh_degree);
    for (logit, share) in gaussians.opacity_logits.iter_mut().zip(thinned(shares, most)) {
        let opacity = opacity(share);
        *logit = (opacity / (1.0 - opacity)).ln();
    }
    gaussians
}

/// The opacity of Gaussians that together absorb a share of the light.
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
                // Their standard deviation equals their spacing, on a grid.
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
