//! Dense motion masks from what a static world leaves unexplained.
//!
//! Each pixel's score becomes log odds of motion. These are gathered along the flow over time, because a
//! point of a mover belongs to it in all frames. Then a labelling is sought that follows the odds with a
//! short boundary, where boundary is cheap along edges of colour and flow. The relaxed problem (weighted
//! total variation, Nikolova, Esedoglu and Chan 2006) is convex, so its thresholded solution is the best
//! labelling. It is solved by the primal-dual method of Chambolle and Pock (2011).

use glam::DVec2;
use rayon::prelude::*;

use super::Stage;
use super::cameras::Cameras;
use super::observer::Work;
use super::photometric::judge;
use super::plate::Evidence;
use super::residual::Seen;
use super::still::{border_prior, trusted};
use crate::Result;
use crate::observe::{NeighbourFlow, PointTrack};
use crate::types::Image;

/// Score at which motion and noise are equally likely, standard deviations.
const EVEN: f32 = 4.0;
/// Range of the log odds, so that no single pixel is certain.
const ODDS: (f32, f32) = (-2.0, 4.0);
/// Number of frames to each side that evidence is gathered over.
const MEMORY: usize = 4;
/// Cost of a pixel of boundary where neither colour nor flow has an edge.
const BOUNDARY: f32 = 2.5;
/// Colour difference (sum over channels) at which boundary costs 1/e.
const COLOUR_EDGE: f32 = 0.18;
/// Support at which a pixel's odds have full weight.
const CERTAIN: f32 = 2.0;
/// Weight of the evidence gathered along the flow where a plate is known.
const BESIDE_PLATE: f32 = 0.3;
/// Log odds of motion where the other frames show movers and flow does not track the pixel: a static point is
/// seldom visible in one frame only.
const UNFOLLOWED: f32 = 0.6;
/// Iterations of the primal-dual method.
const ITERATIONS: usize = 120;
/// Minimum area of a region or hole, as a share of the image; smaller ones are removed.
const SPECK: f64 = 0.0015;

/// The weight of each track as static: 1 minus the mask along it, at its 90 % quantile. A track that no
/// trusted frame sees has the prior weight of its image position.
pub(super) fn static_weights(tracks: &[PointTrack], masks: &[Image]) -> Vec<f64> {
    let trusted = trusted(masks);
    tracks
        .par_iter()
        .map(|track| {
            let mut moving: Vec<f64> = (track.frames.iter().zip(&track.pixels))
                .filter(|(frame, _)| trusted[**frame])
                .map(|(frame, pixel)| {
                    let mask = &masks[*frame];
                    let x = (pixel.x as u32).min(mask.width - 1);
                    let y = (pixel.y as u32).min(mask.height - 1);
                    f64::from(mask.at(x, y)[0])
                })
                .collect();
            if moving.is_empty() {
                let size = (masks[0].width as usize, masks[0].height as usize);
                return border_prior(track, size);
            }
            moving.sort_by(f64::total_cmp);
            // The quantile ignores single slips of a mask; a mover is masked in more frames.
            let most = moving[(moving.len() * 9 / 10).min(moving.len() - 1)];
            (1.0 - most).clamp(0.0, 1.0)
        })
        .collect()
}

/// The observations that motion is judged from.
#[derive(Clone, Copy)]
pub(super) struct Observed<'a> {
    pub frames: &'a [Image],
    pub cameras: &'a Cameras,
    pub flow: &'a NeighbourFlow,
    /// The fit of each frame to a static world.
    pub seen: &'a [Seen],
}

/// Computes a motion mask per frame, one channel in [0, 1], from the flow and, if given, the plates.
pub(super) fn segment(
    observed: Observed<'_>,
    plates: Option<&[Evidence]>,
    work: &mut Work,
    part: &str,
    shares: std::ops::Range<f64>,
) -> Result<Vec<Image>> {
    let middle = 0.5 * (shares.start + shares.end);
    let judged = Judged::new(observed, plates, work, part, shares.start..middle)?;
    judged.segment(None, work, part, middle..shares.end)
}

/// The evidence of motion of each pixel, gathered from its own frame and the neighbouring ones.
pub(super) struct Judged<'a> {
    pub observed: Observed<'a>,
    /// By frame: log odds.
    pub gathered: Vec<Vec<f32>>,
    stage: Stage,
}

impl<'a> Judged<'a> {
    /// Computes the evidence of all pixels.
    pub fn new(
        observed: Observed<'a>,
        plates: Option<&[Evidence]>,
        work: &mut Work,
        part: &str,
        shares: std::ops::Range<f64>,
    ) -> Result<Judged<'a>> {
        // Plates exist only once depth is known.
        let stage = if plates.is_some() { Stage::Depth } else { Stage::Masks };
        let mut odds = all_odds(observed, work, part, stage, shares)?;
        let mut support = observed.support();
        for (frame, plate) in plates.unwrap_or_default().iter().enumerate() {
            for (i, said) in plate.odds.iter().enumerate().filter(|(_, said)| !said.is_nan()) {
                odds[frame][i] += said;
                support[frame][i] = CERTAIN;
            }
        }
        let gathered = |frame: usize| {
            let mut gathered = gather(observed.flow, &odds, &support, frame);
            if let Some(plate) = plates.and_then(|plates| plates.get(frame)) {
                beside_plate(&mut gathered, plate, &observed.seen[frame].support);
            }
            gathered
        };
        let gathered = (0..odds.len()).into_par_iter().map(gathered).collect();
        Ok(Judged { observed, gathered, stage })
    }

    /// Adds log odds from another source to each frame's.
    pub fn add(&mut self, more: &[Vec<f32>]) {
        for (odds, more) in self.gathered.iter_mut().flatten().zip(more.iter().flatten()) {
            *odds += more;
        }
    }

    /// Computes a motion mask per frame, one channel in [0, 1]. `more` are log odds that are added to each
    /// frame's for these masks.
    pub fn segment(
        &self,
        more: Option<&[Vec<f32>]>,
        work: &mut Work,
        part: &str,
        shares: std::ops::Range<f64>,
    ) -> Result<Vec<Image>> {
        let Observed { frames, flow, .. } = self.observed;
        let (width, height) = super::intrinsics_size(flow);
        let segmented = |range: std::ops::Range<usize>| {
            let segment = |frame: usize| {
                let mut odds = self.gathered[frame].clone();
                if let Some(more) = more {
                    odds.iter_mut().zip(&more[frame]).for_each(|(odds, more)| *odds += more);
                }
                let mut u = relax(&odds, &edges(&frames[frame], flow, frame), flow.width);
                clean(&mut u, flow.width);
                Image { width, height, channels: 1, pixels: u }
            };
            range.into_par_iter().map(segment).collect()
        };
        let part = format!("{part}/masks");
        work.frames(&part, frames.len(), segmented, self.stage, shares)
    }
}

impl Observed<'_> {
    /// The support of each pixel of each frame.
    pub(super) fn support(&self) -> Vec<Vec<f32>> {
        self.seen.iter().map(|seen| seen.support.clone()).collect()
    }
}

/// Log odds of motion of each pixel of each frame, from that frame's fit and the photometric check.
pub(super) fn all_odds(
    observed: Observed<'_>,
    work: &mut Work,
    part: &str,
    stage: Stage,
    shares: std::ops::Range<f64>,
) -> Result<Vec<Vec<f32>>> {
    let Observed { frames, cameras, flow, seen } = observed;
    let judged = |range: std::ops::Range<usize>| {
        let judge = |f: usize| judge(frames, cameras, flow, &seen[f], f, &odds(&seen[f]));
        range.into_par_iter().map(judge).collect()
    };
    work.frames(&format!("{part}/odds"), frames.len(), judged, stage, shares)
}

/// Log odds of motion of each pixel, from its score and support.
fn odds(seen: &Seen) -> Vec<f32> {
    seen.score
        .iter()
        .zip(&seen.support)
        .map(|(score, support)| {
            let z = (1.0 + score * score) / (1.0 + EVEN * EVEN);
            let odds = (1.5 * z.ln()).clamp(ODDS.0, ODDS.1);
            odds * (support / CERTAIN).min(1.0)
        })
        .collect()
}

/// Log odds combined with those of the same points in neighbouring frames.
pub(super) fn gather(
    flow: &NeighbourFlow,
    odds: &[Vec<f32>],
    support: &[Vec<f32>],
    frame: usize,
) -> Vec<f32> {
    (0..flow.width * flow.height)
        .map(|i| {
            let pixel = DVec2::new((i % flow.width) as f64 + 0.5, (i / flow.width) as f64 + 0.5);
            let own = (support[frame][i] / CERTAIN).min(1.0);
            let (mut sum, mut total) = (odds[frame][i], own);
            flow.follow(frame, pixel, MEMORY, |other, chain| {
                let x = (chain.pixel.x as usize).min(flow.width - 1);
                let y = (chain.pixel.y as usize).min(flow.height - 1);
                let j = y * flow.width + x;
                let weight = chain.confidence * 0.8f32.powi(other.abs_diff(frame) as i32);
                // Motion in another frame is evidence of motion; rest in another frame is weaker evidence.
                let said = odds[other][j];
                let weight = if said > 0.0 { weight } else { 0.5 * weight };
                sum += weight * said;
                total += weight * (support[other][j] / CERTAIN).min(1.0);
            });
            if total > 0.0 { sum / total.max(0.5) } else { 0.0 }
        })
        .collect()
}

/// Corrects gathered odds by the evidence of the frame's plate.
fn beside_plate(gathered: &mut [f32], plate: &Evidence, support: &[f32]) {
    // A possible shadow is decided by the gathered odds of all neighbouring frames: on a plain surface it
    // looks like a dark mover.
    for (i, odds) in gathered.iter_mut().enumerate().filter(|(i, _)| plate.shade[*i] == 0.0) {
        if !plate.odds[i].is_nan() {
            *odds = plate.odds[i] + BESIDE_PLATE * *odds;
        } else if plate.covered[i] {
            *odds += UNFOLLOWED * (1.0 - (support[i] / CERTAIN).min(1.0));
        }
    }
}

/// The cost of a boundary to the right of, and below, each pixel.
pub(super) fn edges(image: &Image, flow: &NeighbourFlow, frame: usize) -> Vec<[f32; 2]> {
    let (w, h) = (flow.width, flow.height);
    let forward = frame + 1 < flow.frames;
    let cost = |i: usize, j: usize| {
        let (a, b) = (&image.pixels[3 * i..3 * i + 3], &image.pixels[3 * j..3 * j + 3]);
        let colour: f32 = a.iter().zip(b).map(|(x, y)| (x - y).abs()).sum();
        let (f, g) = (flow.at(frame, forward, i), flow.at(frame, forward, j));
        let jump = (f[0] - g[0]).hypot(f[1] - g[1]);
        BOUNDARY * ((-colour / COLOUR_EDGE).exp() * (-jump).exp()).max(0.05)
    };
    (0..w * h)
        .map(|i| {
            [
                if i % w + 1 < w { cost(i, i + 1) } else { 0.0 },
                if i + w < w * h { cost(i, i + w) } else { 0.0 },
            ]
        })
        .collect()
}

/// Minimises −Σ odds·u + Σ cost·|∇u| over u in [0, 1].
pub(super) fn relax(odds: &[f32], cost: &[[f32; 2]], w: usize) -> Vec<f32> {
    let n = odds.len();
    let mut u: Vec<f32> = odds.iter().map(|o| if *o > 0.0 { 1.0 } else { 0.0 }).collect();
    let mut lead = u.clone();
    let mut dual = vec![[0.0f32; 2]; n];
    // Step lengths with σ τ ‖∇‖² ≤ 1, ‖∇‖² ≤ 8.
    let (sigma, tau) = (0.7, 0.17);
    for _ in 0..ITERATIONS {
        for i in 0..n {
            let right = if cost[i][0] > 0.0 { lead[i + 1] - lead[i] } else { 0.0 };
            let below = if cost[i][1] > 0.0 { lead[i + w] - lead[i] } else { 0.0 };
            dual[i][0] = (dual[i][0] + sigma * right).clamp(-cost[i][0], cost[i][0]);
            dual[i][1] = (dual[i][1] + sigma * below).clamp(-cost[i][1], cost[i][1]);
        }
        for i in 0..n {
            let mut divergence = dual[i][0] + dual[i][1];
            if i % w > 0 {
                divergence -= dual[i - 1][0];
            }
            if i >= w {
                divergence -= dual[i - w][1];
            }
            let next = (u[i] + tau * (divergence + odds[i])).clamp(0.0, 1.0);
            lead[i] = 2.0 * next - u[i];
            u[i] = next;
        }
    }
    u
}

/// Removes small regions and fills small holes.
pub(super) fn clean(u: &mut [f32], w: usize) {
    let least = (SPECK * u.len() as f64).max(4.0) as usize;
    for inside in [true, false] {
        for (region, border) in regions(u, w, inside) {
            // A hole at the image border is not filled: it is the static world beside a mover.
            if region.len() < least && (inside || !border) {
                let value = if inside { 0.0 } else { 1.0 };
                region.into_iter().for_each(|i| u[i] = value);
            }
        }
    }
}

/// Connected regions (four neighbours) of pixels above one half, or of the others, each with whether it
/// touches the image border.
pub(super) fn regions(u: &[f32], w: usize, inside: bool) -> Vec<(Vec<usize>, bool)> {
    let mut done = vec![false; u.len()];
    let mut out = Vec::new();
    for start in 0..u.len() {
        if done[start] || (u[start] > 0.5) != inside {
            continue;
        }
        let (mut region, mut border) = (vec![start], false);
        done[start] = true;
        let mut next = 0;
        while next < region.len() {
            let i = region[next];
            next += 1;
            let x = i % w;
            border |= x == 0 || x + 1 == w || i < w || i + w >= u.len();
            let neighbours = [
                (x > 0).then(|| i - 1),
                (x + 1 < w).then_some(i + 1),
                i.checked_sub(w),
                (i + w < u.len()).then_some(i + w),
            ];
            for j in neighbours.into_iter().flatten() {
                if !done[j] && (u[j] > 0.5) == inside {
                    done[j] = true;
                    region.push(j);
                }
            }
        }
        out.push((region, border));
    }
    out
}

#[cfg(test)]
mod tests {
    use super::super::residual::triangulate_frames;
    use super::super::sliding::*;
    use super::*;

    #[test]
    fn regions_are_connected_by_edges() {
        // Two squares that touch at a corner; one has a hole.
        let u = [
            1.0, 1.0, 0.0, 0.0, 0.0, //
            1.0, 1.0, 0.0, 0.0, 0.0, //
            0.0, 0.0, 1.0, 1.0, 1.0, //
            0.0, 0.0, 1.0, 0.0, 1.0, //
            0.0, 0.0, 1.0, 1.0, 1.0,
        ];
        let sizes = |inside: bool| -> Vec<(usize, bool)> {
            regions(&u, 5, inside).iter().map(|(region, border)| (region.len(), *border)).collect()
        };
        assert_eq!(sizes(true), [(4, true), (8, true)]);
        assert_eq!(sizes(false), [(6, true), (6, true), (1, false)]);
    }

    #[test]
    fn specks_go_and_holes_are_filled() {
        let mut mask = map(|p| {
            let hole = within(p, (20.0, 20.0), (21.0, 22.0));
            let speck = within(p, (50.0, 5.0), (51.0, 7.0));
            f32::from(u8::from((within(p, (10.0, 10.0), (30.0, 30.0)) && !hole) || speck))
        });
        clean(&mut mask.pixels, WIDTH as usize);
        let whole = map(|p| f32::from(u8::from(within(p, (10.0, 10.0), (30.0, 30.0)))));
        assert_eq!(mask, whole);
    }

    #[test]
    fn what_nobody_sees_and_flow_does_not_follow_moves_rather_than_not() {
        // By pixel: known plate with motion; shade; unknown; covered with full, half and no support.
        let plate = Evidence {
            odds: [vec![1.0, 1.0], vec![f32::NAN; 4]].concat(),
            covered: vec![false, false, false, true, true, true],
            shade: vec![0.0, 0.3, 0.0, 0.0, 0.0, 0.0],
            brightness: vec![0.5; 6],
            hidden: vec![0.0; 6],
        };
        let mut odds = vec![-1.0; 6];
        beside_plate(&mut odds, &plate, &[0.0, 0.0, 0.0, CERTAIN, 0.5 * CERTAIN, 0.0]);
        let half = -1.0 + 0.5 * UNFOLLOWED;
        let expected = [1.0 - BESIDE_PLATE, -1.0, -1.0, -1.0, half, -1.0 + UNFOLLOWED];
        assert_eq!(odds, expected);
    }

    #[test]
    fn the_labelling_outvotes_single_pixels_and_keeps_to_edges() {
        // The odds favour motion within a square, except at one pixel, and rest outside it, except at one
        // pixel.
        let inside = |p: DVec2| within(p, (20.0, 10.0), (40.0, 30.0));
        let odds = map(|p| match (inside(p), p.x as u32, p.y as u32) {
            (true, 30, 20) => -1.0,
            (true, ..) => 1.5,
            (false, 5, 5) => 1.5,
            (false, ..) => -1.0,
        });
        let cost = vec![[0.5; 2]; odds.pixels.len()];
        let cost: Vec<[f32; 2]> = cost
            .iter()
            .enumerate()
            .map(|(i, c)| {
                let (x, y) = (i % WIDTH as usize, i / WIDTH as usize);
                [
                    if x + 1 < WIDTH as usize { c[0] } else { 0.0 },
                    if y + 1 < HEIGHT as usize { c[1] } else { 0.0 },
                ]
            })
            .collect();
        let u = relax(&odds.pixels, &cost, WIDTH as usize);
        for (i, u) in u.iter().enumerate() {
            let p = centre(i);
            let corner = [20.5, 39.5].contains(&p.x) && [10.5, 29.5].contains(&p.y);
            assert!(corner || (*u > 0.5) == inside(p), "{p}: {u}");
        }
    }

    #[test]
    fn a_track_is_weighted_by_the_upper_decile_of_its_motion() {
        let masks: Vec<Image> = (0..FRAMES)
            .map(|_| map(|p| if within(p, (30.0, 10.0), (50.0, 30.0)) { 0.9 } else { 0.0 }))
            .collect();
        let track = |x: [f64; 3]| {
            let pixels = x.iter().map(|x| DVec2::new(*x, 20.0)).collect();
            PointTrack::followed(1, pixels, vec![0.1; 3])
        };
        let tracks = [track([5.0, 6.0, 7.0]), track([28.0, 29.0, 31.0]), track([35.0, 36.0, 37.0])];
        let weights = static_weights(&tracks, &masks);
        assert_eq!(weights[0], 1.0);
        assert!((weights[1] - 0.1).abs() < 1e-6 && (weights[2] - 0.1).abs() < 1e-6, "{weights:?}");
    }

    /// A square that moves down in front of a wall that slides by, with images and flow.
    #[test]
    fn a_mover_is_segmented() {
        let square = |frame: usize, p: DVec2| {
            let (x, y) = (26.0 - 2.0 * frame as f64, 8.0 + 1.5 * frame as f64);
            within(p, (x, y), (x + 14.0, y + 14.0))
        };
        let down = DVec2::new(0.0, 1.5);
        let flow = flow(|frame, p| if square(frame, p) { wall() + down } else { wall() });
        let frames: Vec<Image> = (0..FRAMES)
            .map(|frame| {
                let mut image = Image::new(WIDTH, HEIGHT, 3);
                for (i, c) in image.pixels.chunks_exact_mut(3).enumerate() {
                    let p = centre(i);
                    let moved = if square(frame, p) { wall() + down } else { wall() };
                    let q = p - moved * frame as f64;
                    let v = 0.5 + 0.2 * (0.9 * q.x).sin() * (0.7 * q.y).cos();
                    let tint = if square(frame, p) { 0.3 } else { 0.0 };
                    c.copy_from_slice(&[v as f32 + tint, v as f32, v as f32 - tint]);
                }
                image
            })
            .collect();
        let masks = working(|work| {
            let seen = triangulate_frames(&cameras(STEP), &flow, work, "test", 0.0..0.5).unwrap();
            let cameras = &cameras(STEP);
            let observed = Observed { frames: &frames, cameras, flow: &flow, seen: &seen };
            segment(observed, None, work, "test", 0.5..1.0).unwrap()
        });
        for frame in 1..FRAMES - 1 {
            let (mut both, mut either) = (0, 0);
            for (i, u) in masks[frame].pixels.iter().enumerate() {
                let (found, truth) = (*u > 0.5, square(frame, centre(i)));
                both += usize::from(found && truth);
                either += usize::from(found || truth);
            }
            assert!(both as f64 > 0.7 * either as f64, "frame {frame}: {both} of {either}");
        }
    }
}
