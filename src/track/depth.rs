//! Depth of all pixels.
//!
//! Static pixels are triangulated. Gaps are filled in by diffusion of inverse depth that stops at colour
//! edges. The same equation smooths noisy measurements, each according to its deviation. Movers are lifted as
//! objects ([`super::movers`]). Moving pixels that belong to no object, because hardly a point can be tracked
//! on them, get one depth per region and frame, smoothed along the flow: the depth of the ground where the
//! region's lower end meets it, and nearer than what the region hides.

use glam::{DVec2, DVec3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::cameras::Cameras;
use super::distance::Behind;
use super::estimated::{Estimate, aligned};
use super::masks::regions;
use super::movers::{self, BOUND, KNOWN, Lifted, NEARER, nearest_pixel};
use super::observer::Work;
use super::plate::Evidence;
use super::quantile;
use super::residual::Seen;
use super::{Mover, Options, Stage};
use crate::Result;
use crate::observe::NeighbourFlow;
use crate::types::{Image, Pose};

/// Maximum depth, in units of the median depth.
const FARTHEST: f32 = 40.0;
/// Minimum depth, in units of the median depth.
const NEAREST: f32 = 0.02;
/// A triangulated inverse depth is rejected if its standard deviation exceeds the first number times the
/// inverse depth plus the second number (in 1 / unit).
const DOUBT: (f32, f32) = (0.35, 0.02);
/// Maximum residual of a measured static pixel, in standard deviations.
const UNEXPLAINED: f32 = 4.0;
/// Maximum relative deviation of a triangulated inverse depth that other depth is compared with.
const CERTAIN: f32 = 0.1;
/// A network's depth replaces the triangulated one if its deviation is smaller by this factor.
const CLEARLY: f32 = 2.0;
/// Confidence of depth that was filled in.
const FILLED: f32 = 0.3;
/// Confidence above which depth was measured.
pub(super) const MEASURED: f32 = 0.5;
/// Weight of the depth behind a mover that other frames measured.
const HIDDEN_WEIGHT: f32 = 1.0;

/// The depth and the movers as in [`super::Track`].
pub(super) struct Dense {
    pub depth: Vec<Image>,
    pub confidence: Vec<Image>,
    pub movers: Vec<Mover>,
    pub owners: Vec<Image>,
}

/// The static world in all frames, including the parts behind movers. Hidden parts are taken from the plates
/// if these know them, else filled in. `part` is the name under which finished frames are saved.
pub(super) fn layers(
    frames: &[Image],
    cameras: &Cameras,
    masks: &[Image],
    seen: &[Seen],
    plates: Option<&[Evidence]>,
    options: &Options,
    work: &mut Work,
    (part, shares): (&str, std::ops::Range<f64>),
) -> Result<Vec<Layer>> {
    let supplied = options.depth.as_deref();
    let estimated = options.estimated_depth.as_ref().map(|told| aligned(told, seen, masks));
    let scale = supplied.map(|maps| scale_of(maps, seen, masks));
    let background = cameras.background();
    let made = |range: std::ops::Range<usize>| {
        let layer = |f: usize| {
            let known = supplied.zip(scale).map(|(maps, scale)| (&maps[f], scale));
            let hidden = plates.map(|plates| plates[f].hidden.as_slice());
            let told = Told { exact: known, estimated: estimated.as_ref().map(|all| &all[f]) };
            static_layer(&frames[f], &masks[f], &seen[f], hidden, background.as_deref(), told)
        };
        range.into_par_iter().map(layer).collect()
    };
    work.frames(part, frames.len(), made, Stage::Depth, shares)
}

/// Depth and its confidence per frame, as in [`super::Track`]. Without parallax and without supplied depth
/// everything static lies on [`Cameras::background`], with movers in front of it.
pub(super) fn dense(
    frames: &[Image],
    cameras: &Cameras,
    flow: &NeighbourFlow,
    masks: &[Image],
    mut layers: Vec<Layer>,
    plates: &[Evidence],
    options: &Options,
    work: &mut Work,
) -> Result<Dense> {
    // Other frames know the ground under movers better than this one, in which a shadow may lie on it.
    let ground: Vec<(Vec<f32>, Vec<f32>)> = layers
        .par_iter()
        .zip(plates)
        .map(|(layer, plate)| {
            let own = layer.inverse.iter().zip(&layer.confidence);
            let told = own.zip(&plate.hidden);
            told.map(|((d, c), hidden)| if *hidden > 0.0 { (*hidden, 1.0) } else { (*d, *c) })
                .unzip()
        })
        .collect();
    let in_image = |pose: &Pose| {
        let k = &cameras.intrinsics;
        let down = cameras.ground.and_then(|ground| ground.from(pose))?;
        let (x, y) = (down.x / k.fx, down.y / k.fy);
        Some(DVec3::new(x, y, down.z - x * k.cx - y * k.cy))
    };
    let behind: Vec<Behind<'_>> = ground
        .iter()
        .zip(&cameras.poses)
        .map(|((inverse, confidence), pose)| Behind { inverse, confidence, ground: in_image(pose) })
        .collect();
    let lifted = match options.lift {
        true => movers::lift(frames, cameras, flow, masks, &layers, &behind),
        false => Lifted::nothing(masks),
    };
    work.progress(Stage::Depth, 0.95)?;
    // Pixels without an object get one depth per region and frame.
    let rest: Vec<Vec<Option<(f32, f32)>>> =
        layers.par_iter().zip(masks).map(|(layer, mask)| by_region(layer, mask)).collect();
    for (f, layer) in layers.iter_mut().enumerate() {
        for i in 0..layer.inverse.len() {
            let Some((_, confidence)) = rest[f][i] else { continue };
            if layer.supplied[i] {
                continue;
            }
            let unknown = || match layer.estimated.get(i) {
                Some(told) if *told > 0.0 => (*told, confidence),
                _ => (smoothed(flow, &rest, f, i), confidence),
            };
            (layer.inverse[i], layer.confidence[i]) = lifted.pixels[f][i].unwrap_or_else(unknown);
        }
    }
    let (width, height) = super::intrinsics_size(flow);
    let image = |pixels| Image { width, height, channels: 1, pixels };
    let (depth, confidence) = layers
        .into_iter()
        .map(|layer| {
            let depth = layer.inverse.iter().map(|d| d.recip().clamp(NEAREST, FARTHEST)).collect();
            (image(depth), image(layer.confidence))
        })
        .unzip();
    Ok(Dense { depth, confidence, movers: lifted.movers, owners: lifted.owners })
}

/// Whether a pixel is static and was triangulated well enough to compare other depth with it.
pub(super) fn is_certain(seen: &Seen, mask: &Image, i: usize) -> bool {
    seen.deviation[i] < CERTAIN * seen.inverse_depth[i]
        && seen.score[i] < UNEXPLAINED
        && mask.pixels[i] <= 0.5
}

/// One factor for all supplied maps: the median ratio of the triangulated to the supplied depth.
fn scale_of(maps: &[Image], seen: &[Seen], masks: &[Image]) -> f32 {
    let mut ratios = Vec::new();
    for ((map, seen), mask) in maps.iter().zip(seen).zip(masks) {
        for i in (0..map.pixels.len()).step_by(7) {
            let (z, d) = (map.pixels[i], seen.inverse_depth[i]);
            if is_certain(seen, mask, i) && z.is_finite() && z > 0.0 {
                ratios.push(f64::from(1.0 / (d * z)));
            }
        }
    }
    if !ratios.is_empty() {
        return quantile(ratios, 0.5) as f32;
    }
    // Without parallax there is nothing to compare with, and the unit is the median depth itself.
    let all = maps.iter().flat_map(|m| &m.pixels).filter(|z| z.is_finite() && **z > 0.0);
    let median = quantile(all.step_by(7).map(|z| f64::from(*z)).collect(), 0.5);
    if median > 0.0 { (1.0 / median) as f32 } else { 1.0 }
}

/// The static world from the camera of one frame, including the parts that movers hide.
#[derive(Serialize, Deserialize)]
pub(super) struct Layer {
    pub inverse: Vec<f32>,
    pub confidence: Vec<f32>,
    pub supplied: Vec<bool>,
    /// Inverse depth that a network estimated, including movers; 0 where unknown, empty without a network.
    pub estimated: Vec<f32>,
}

impl Layer {
    /// The supplied or estimated inverse depth of a pixel, which may be a mover's.
    pub fn told(&self, i: usize) -> Option<f64> {
        let told = if self.supplied[i] { Some(&self.inverse[i]) } else { self.estimated.get(i) };
        told.map(|d| f64::from(*d)).filter(|d| *d > 0.0)
    }
}

/// Inverse depth of a pixel and its standard deviation.
#[derive(Clone, Copy)]
struct Known {
    inverse: f32,
    deviation: f32,
}

impl Known {
    /// An estimate of a network. If its deviation is unknown or large, it still has the weight of a neighbour
    /// of the same colour.
    fn estimated(inverse: f32, relative_deviation: f32) -> Known {
        let deviation = (relative_deviation * inverse).min(Known::jump(inverse));
        Known { inverse, deviation }
    }

    /// Typical difference of inverse depth between neighbouring pixels: a tenth.
    fn jump(inverse: f32) -> f32 {
        0.1 * (inverse + 0.1)
    }

    /// The weight relative to a neighbour of the same colour.
    fn weight(self) -> f32 {
        (Known::jump(self.inverse) / self.deviation).powi(2).min(1e3)
    }

    /// Selects the triangulated value, or a network's estimate if that is clearly more precise. The two are
    /// not averaged: a network's errors are correlated within a neighbourhood, and those of a triangulation
    /// have been smoothed over it, so that its deviation is overstated.
    fn or(self, estimate: Known) -> Known {
        if CLEARLY * estimate.deviation < self.deviation { estimate } else { self }
    }
}

/// Depth of a frame that is given beforehand.
#[derive(Clone, Copy, Default)]
struct Told<'a> {
    /// Depth that is kept, and the factor that it is multiplied by.
    exact: Option<(&'a Image, f32)>,
    /// Inverse depth that a network estimated.
    estimated: Option<&'a Estimate>,
}

fn static_layer(
    image: &Image,
    mask: &Image,
    seen: &Seen,
    hidden: Option<&[f32]>,
    background: Option<&[f32]>,
    told: Told,
) -> Layer {
    let w = image.width as usize;
    let n = mask.pixels.len();
    let (mut value, mut weight) = (vec![0.0f32; n], vec![0.0f32; n]);
    let Told { exact: known, estimated } = told;
    let mut layer = Layer {
        inverse: vec![1.0; n],
        confidence: vec![FILLED; n],
        supplied: vec![false; n],
        estimated: estimated.map_or_else(Vec::new, |estimate| estimate.inverse.clone()),
    };
    let is_estimated = |estimate: &Estimate| estimate.inverse.iter().any(|d| *d > 0.0);
    let is_told = known.is_some() || estimated.is_some_and(is_estimated);
    if let Some(background) = background.filter(|_| !is_told) {
        return Layer { inverse: background.to_vec(), ..layer };
    }
    for i in 0..n {
        if let Some((map, scale)) = known {
            let z = map.pixels[i] * scale;
            if z.is_finite() && z > 0.0 {
                value[i] = z.recip();
                weight[i] = 1e4;
                layer.confidence[i] = 1.0;
                layer.supplied[i] = true;
                continue;
            }
        }
        let moves = mask.pixels[i] > 0.5;
        if let Some(&behind) = hidden.map(|hidden| &hidden[i]).filter(|d| moves && **d > 0.0) {
            (value[i], weight[i]) = (behind, HIDDEN_WEIGHT);
            continue;
        }
        if moves {
            continue;
        }
        let measures =
            background.is_none() && seen.support[i] >= 0.5 && seen.score[i] <= UNEXPLAINED;
        let (d, deviation) = (seen.inverse_depth[i], seen.deviation[i]);
        let doubt = deviation / (DOUBT.0 * d + DOUBT.1);
        let measured = (measures && doubt < 1.0).then_some(Known { inverse: d, deviation });
        if measured.is_some() {
            layer.confidence[i] = 0.5 + 0.5 * (1.0 - doubt);
        }
        let estimate = estimated.and_then(|estimate| {
            let d = estimate.inverse[i];
            (d > 0.0).then(|| Known::estimated(d, estimate.deviation(i)))
        });
        let known = match (measured, estimate) {
            (Some(measured), Some(estimate)) => measured.or(estimate),
            (Some(one), None) | (None, Some(one)) => one,
            (None, None) => continue,
        };
        value[i] = known.inverse.clamp(FARTHEST.recip(), NEAREST.recip());
        weight[i] = known.weight();
    }
    if weight.iter().all(|w| *w == 0.0) {
        return layer;
    }
    layer.inverse = diffuse(image, &value, &weight, w);
    for i in 0..n {
        if layer.supplied[i] {
            layer.inverse[i] = value[i];
        }
    }
    layer
}

/// Minimises Σ weight (x − value)² + Σ g (x_i − x_j)² with g small across colour edges, from coarse to fine,
/// with Gauss-Seidel sweeps at each level.
fn diffuse(image: &Image, value: &[f32], weight: &[f32], w: usize) -> Vec<f32> {
    struct Level {
        w: usize,
        h: usize,
        colour: Vec<[f32; 3]>,
        value: Vec<f32>,
        weight: Vec<f32>,
    }
    let colour = image.pixels.chunks_exact(3).map(|c| [c[0], c[1], c[2]]).collect();
    let mut levels = vec![Level {
        w,
        h: value.len() / w,
        colour,
        value: value.to_vec(),
        weight: weight.to_vec(),
    }];
    while let Some(fine) = levels.last().filter(|l| l.w.min(l.h) > 2) {
        let (cw, ch) = (fine.w.div_ceil(2), fine.h.div_ceil(2));
        let mut coarse = Level {
            w: cw,
            h: ch,
            colour: vec![[0.0; 3]; cw * ch],
            value: vec![0.0; cw * ch],
            weight: vec![0.0; cw * ch],
        };
        for i in 0..cw * ch {
            let (mut count, mut sum, mut total) = (0.0, 0.0, 0.0);
            for (dx, dy) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
                let (x, y) = (2 * (i % cw) + dx, 2 * (i / cw) + dy);
                if x < fine.w && y < fine.h {
                    let j = y * fine.w + x;
                    for c in 0..3 {
                        coarse.colour[i][c] += fine.colour[j][c];
                    }
                    count += 1.0;
                    sum += fine.weight[j] * fine.value[j];
                    total += fine.weight[j];
                }
            }
            coarse.colour[i] = coarse.colour[i].map(|c| c / count);
            coarse.value[i] = if total > 0.0 { sum / total } else { 0.0 };
            coarse.weight[i] = total;
        }
        levels.push(coarse);
    }
    let mut x: Vec<f32> = Vec::new();
    for place in (0..levels.len()).rev() {
        let level = &levels[place];
        let Level { w, h, .. } = *level;
        let mut here = if place + 1 == levels.len() {
            let total: f32 = level.weight.iter().sum();
            let sum: f32 = level.weight.iter().zip(&level.value).map(|(a, b)| a * b).sum();
            vec![sum / total.max(1e-12); w * h]
        } else {
            let coarse = levels[place + 1].w;
            (0..w * h).map(|i| x[i / w / 2 * coarse + i % w / 2]).collect()
        };
        let link = |i: usize, j: usize| {
            let (a, b) = (level.colour[i], level.colour[j]);
            let difference: f32 = a.iter().zip(&b).map(|(p, q)| (p - q).abs()).sum();
            (-difference / 0.12).exp() + 1e-3
        };
        let links: Vec<[f32; 2]> = (0..w * h)
            .map(|i| {
                [
                    if i % w + 1 < w { link(i, i + 1) } else { 0.0 },
                    if i + w < w * h { link(i, i + w) } else { 0.0 },
                ]
            })
            .collect();
        for sweep in 0..24 {
            for step in 0..w * h {
                let i = if sweep % 2 == 0 { step } else { w * h - 1 - step };
                let (mut sum, mut total) = (level.weight[i] * level.value[i], level.weight[i]);
                let mut pull = |g: f32, j: usize| {
                    sum += g * here[j];
                    total += g;
                };
                if i % w > 0 {
                    pull(links[i - 1][0], i - 1);
                }
                if links[i][0] > 0.0 {
                    pull(links[i][0], i + 1);
                }
                if i >= w {
                    pull(links[i - w][1], i - w);
                }
                if links[i][1] > 0.0 {
                    pull(links[i][1], i + w);
                }
                if total > 0.0 {
                    here[i] = sum / total;
                }
            }
        }
        x = here;
    }
    x.iter().map(|d| d.clamp(FARTHEST.recip(), NEAREST.recip())).collect()
}

/// Inverse depth and confidence of the pixels of movers, by region of the mask.
fn by_region(layer: &Layer, mask: &Image) -> Vec<Option<(f32, f32)>> {
    let (w, h) = (mask.width as usize, mask.height as usize);
    let u = &mask.pixels;
    let mut out = vec![None; u.len()];
    for (region, _) in regions(u, w, true) {
        let top = region.iter().map(|i| i / w).min().unwrap_or(0);
        let bottom = region.iter().map(|i| i / w).max().unwrap_or(0);
        let feet = bottom - (bottom - top) / 4;
        let (mut ground, mut behind) = (Vec::new(), Vec::new());
        for &i in &region {
            let (x, y) = (i % w, i / w);
            // The mask may overhang by a pixel or two, so the depth is read farther outside.
            let beyond = |x: isize, y: isize| {
                let inside = x >= 0 && y >= 0 && (x as usize) < w && (y as usize) < h;
                inside
                    .then(|| y as usize * w + x as usize)
                    .filter(|j| u[*j] <= 0.5)
                    .map(|j| f64::from(layer.inverse[j]))
            };
            let (x, y) = (x as isize, y as isize);
            let edge =
                |dx: isize, dy: isize| beyond(x + dx, y + dy).and(beyond(x + 3 * dx, y + 3 * dy));
            if y as usize >= feet {
                ground.extend(edge(0, 1));
            } else {
                behind.extend([edge(-1, 0), edge(1, 0), edge(0, -1)].into_iter().flatten());
            }
        }
        let cut = bottom + 1 == h;
        let hidden = quantile(behind.clone(), 0.6);
        let (inverse, confidence) = if ground.len() >= 3 && !cut {
            (quantile(ground, 0.6).max(hidden), KNOWN)
        } else {
            let near = if ground.is_empty() { 0.0 } else { quantile(ground, 0.8) };
            let bound = near.max(NEARER * quantile(behind, 0.8));
            (if bound > 0.0 { bound } else { 1.2 }, BOUND)
        };
        for i in region {
            out[i] = Some((inverse as f32, confidence));
        }
    }
    out
}

/// A mover's inverse depth, averaged (as a logarithm) along the flow over the frames around.
fn smoothed(
    flow: &NeighbourFlow,
    movers: &[Vec<Option<(f32, f32)>>],
    frame: usize,
    i: usize,
) -> f32 {
    let pixel = DVec2::new((i % flow.width) as f64 + 0.5, (i / flow.width) as f64 + 0.5);
    let (mut sum, mut total) = (0.0, 0.0);
    let mut add = |value: Option<(f32, f32)>, weight: f32| {
        if let Some((inverse, confidence)) = value {
            sum += weight * confidence * inverse.ln();
            total += weight * confidence;
        }
    };
    add(movers[frame][i], 1.0);
    flow.follow(frame, pixel, 4, |other, chain| {
        let there = nearest_pixel(chain.pixel, flow.width, movers[other].len());
        add(movers[other][there], chain.confidence);
    });
    if total > 0.0 { (sum / total).exp() } else { 1.0 }
}

#[cfg(test)]
mod tests {
    use super::super::sliding::*;
    use super::*;

    /// An image with an edge in the middle: black to the left, white to the right.
    fn halves() -> Image {
        let mut image = Image::new(WIDTH, HEIGHT, 3);
        for (i, c) in image.pixels.chunks_exact_mut(3).enumerate() {
            c.fill(if centre(i).x < 32.0 { 0.0 } else { 1.0 });
        }
        image
    }

    /// The measurement of static pixels with a known inverse depth; pixels outside `measured` were not seen.
    fn seen(inverse: impl Fn(DVec2) -> f32, measured: impl Fn(DVec2) -> bool) -> Seen {
        let measured = map(|p| f32::from(u8::from(measured(p))));
        Seen {
            inverse_depth: map(&inverse).pixels,
            deviation: map(|p| 0.02 * inverse(p)).pixels,
            score: vec![0.5; measured.pixels.len()],
            support: measured.pixels.iter().map(|m| 4.0 * m).collect(),
        }
    }

    #[test]
    fn gaps_are_filled_up_to_edges_of_colour() {
        // One row in eight is measured: 1/2 to the left, 1/8 to the right.
        let truth = |p: DVec2| if p.x < 32.0 { 0.5 } else { 0.125 };
        let seen = seen(truth, |p| (p.y as u32).is_multiple_of(8));
        let nothing = map(|_| 0.0);
        let layer = static_layer(&halves(), &nothing, &seen, None, None, Told::default());
        for (i, d) in layer.inverse.iter().enumerate() {
            let p = centre(i);
            assert!((d / truth(p) - 1.0).abs() < 0.1, "{p}: {d}");
            let measured = (p.y as u32).is_multiple_of(8);
            assert_eq!(layer.confidence[i] > 0.5, measured, "{p}");
        }
        // A fixed camera has measured nothing: a wall at depth 1.
        let wall = vec![1.0; nothing.pixels.len()];
        let layer = static_layer(&halves(), &nothing, &seen, None, Some(&wall), Told::default());
        assert!(layer.inverse.iter().all(|d| *d == 1.0));
        assert!(layer.confidence.iter().all(|c| *c == FILLED));
    }

    #[test]
    fn what_is_not_to_be_believed_is_left_out() {
        let mut seen = seen(|_| 0.25, |_| true);
        let moved = (20 * WIDTH + 20) as usize;
        let vague = (20 * WIDTH + 40) as usize;
        (seen.inverse_depth[moved], seen.score[moved]) = (2.0, 2.0 * UNEXPLAINED);
        (seen.inverse_depth[vague], seen.deviation[vague]) = (2.0, 1.0);
        let layer = static_layer(&halves(), &map(|_| 0.0), &seen, None, None, Told::default());
        for i in [moved, vague] {
            assert!((layer.inverse[i] - 0.25).abs() < 0.01, "{}", layer.inverse[i]);
            assert_eq!(layer.confidence[i], FILLED);
        }
    }

    #[test]
    fn known_depth_is_kept_up_to_one_scale() {
        // The depth is in metres while the unit is 2.5 m, and unknown in a corner.
        let depth = map(|p| if within(p, (0.0, 0.0), (8.0, 8.0)) { 0.0 } else { 10.0 });
        let seen = seen(|_| 0.25, |_| true);
        let mask = map(|_| 0.0);
        let (depth, mask) = ([depth], [mask]);
        let scale = scale_of(&depth, std::slice::from_ref(&seen), &mask);
        assert!((scale - 0.4).abs() < 1e-5, "{scale}");
        let layer = static_layer(
            &halves(),
            &mask[0],
            &seen,
            None,
            None,
            Told { exact: Some((&depth[0], scale)), estimated: None },
        );
        let known = (20 * WIDTH + 20) as usize;
        assert!(layer.supplied[known] && !layer.supplied[0]);
        assert_eq!((layer.inverse[known], layer.confidence[known]), (1.0 / (10.0 * scale), 1.0));
        // Without parallax the unit is the maps' own median.
        let blind = self::seen(|_| 0.25, |_| true);
        let blind = Seen { deviation: vec![f32::INFINITY; blind.score.len()], ..blind };
        let scale = scale_of(&depth, &[blind], &mask);
        assert!((scale - 0.1).abs() < 1e-6, "{scale}");
    }

    #[test]
    fn a_mover_is_as_far_as_the_ground_below_it_and_nearer_than_what_it_hides() {
        // Ground that gets nearer towards the lower border, and a far wall above row 16.
        let world = |p: DVec2| if p.y < 16.0 { 0.1 } else { 0.1 + 0.02 * (p.y as f32 - 16.0) };
        let layer = Layer {
            inverse: map(world).pixels,
            confidence: vec![1.0; (WIDTH * HEIGHT) as usize],
            supplied: vec![false; (WIDTH * HEIGHT) as usize],
            estimated: Vec::new(),
        };
        let standing = map(|p| f32::from(u8::from(within(p, (20.0, 8.0), (30.0, 28.0)))));
        let found = by_region(&layer, &standing);
        let (d, confidence) = found[(15 * WIDTH + 25) as usize].unwrap();
        // The object stands on row 28; the mask may overhang, so the ground is read two rows below.
        assert!((d - world(DVec2::new(25.0, 30.5))).abs() < 1e-3, "{d}");
        assert_eq!(confidence, KNOWN);
        assert!(found[0].is_none());
        // The object is in the air in front of the wall: only a bound on its depth is known.
        let flying = map(|p| f32::from(u8::from(within(p, (20.0, 2.0), (30.0, 10.0)))));
        let (d, _) = by_region(&layer, &flying)[(5 * WIDTH + 25) as usize].unwrap();
        assert!(d >= 0.1, "{d}");
        // The object is cut off by the lower border: its feet are not visible.
        let cut = map(|p| f32::from(u8::from(within(p, (20.0, 20.0), (30.0, 40.0)))));
        let (d, confidence) = by_region(&layer, &cut)[(30 * WIDTH + 25) as usize].unwrap();
        assert!(confidence == BOUND && d > 0.3, "{d}, {confidence}");
    }
}
