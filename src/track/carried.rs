//! Masks carried along the movers' own motion.
//!
//! Where a mover has the colour of what it hides, neither the plate nor the flow shows that it moves: the image
//! equals the plate, and the flow of pixels without texture is that of their surroundings. In the
//! neighbouring frames the mover hides something else, and they show its shape and its colours. A pixel that
//! shows what a neighbouring frame's mover would show there, carried along the motion of the pixels around it,
//! is therefore decided by these frames and not by the plate. Where the colours differ, nothing changes.

use glam::DVec2;
use rayon::prelude::*;

use super::masks::{Judged, regions};
use super::observer::Work;
use super::plate::{Evidence, centre};
use crate::Result;
use crate::observe::NeighbourFlow;
use crate::types::Image;

/// Number of times that masks are carried; each time from the masks of the time before.
const ROUNDS: usize = 2;
/// Number of frames to each side from which masks are carried, and the weight of a frame relative to that of
/// the frame before it.
const MEMORY: usize = 3;
const FADING: f32 = 0.8;
/// Log odds of motion of a pixel that all these frames' movers would show.
const CARRIED: f32 = 1.0;
/// Radius of the window in which motion is measured: in units of the square root of a mover's area, at least
/// this many pixels at a width of [`WIDTH`], and at most this share of the width.
const WINDOW: f64 = 0.3;
const LEAST_RADIUS: f64 = 4.0;
const MOST_RADIUS: f64 = 0.05;
/// Minimum number of a mask's pixels in a window, and the minimum confidence of their flow.
const LEAST: usize = 12;
const CONFIDENT: f32 = 0.3;
/// Spacing of the positions at which motion is measured, pixels at a width of [`WIDTH`].
const SPACING: usize = 4;
/// Mean absolute difference of colours at which a carried pixel half agrees.
const EVEN: f32 = 0.04;
/// Maximum shift of a carried patch, pixels at a width of [`WIDTH`]: movers turn and bend.
const SHIFT: i32 = 2;
/// Image width that numbers of pixels are for; wider images are sampled more coarsely.
const WIDTH: usize = 320;

/// The masks with what neighbouring frames add to them. `masks` are those that `judged` gives by itself.
pub(super) fn revised(
    judged: &Judged<'_>,
    plates: &[Evidence],
    mut masks: Vec<Image>,
    work: &mut Work,
    part: &str,
    shares: std::ops::Range<f64>,
) -> Result<Vec<Image>> {
    for round in 0..ROUNDS {
        let carrier = Carrier::new(judged.observed.frames, judged.observed.flow, &masks);
        let added =
            |(frame, own): (usize, &Vec<f32>)| carrier.added(frame, own, &plates[frame].shade);
        let added: Vec<Vec<f32>> = judged.gathered.par_iter().enumerate().map(added).collect();
        let part = format!("{part}/carried-{round}");
        masks = judged.segment(Some(&added), work, &part, shares.clone())?;
    }
    Ok(masks)
}

/// Carries masks between frames.
struct Carrier<'a> {
    frames: &'a [Image],
    masks: &'a [Image],
    /// By frame: the motion to the previous frame and to the next one.
    motions: Vec<[Option<Motion>; 2]>,
}

impl<'a> Carrier<'a> {
    fn new(frames: &'a [Image], flow: &NeighbourFlow, masks: &'a [Image]) -> Carrier<'a> {
        let motions = |frame: usize| {
            let to = |forward: bool| Motion::measured(flow, &masks[frame], frame, forward);
            [(frame > 0).then(|| to(false)), (frame + 1 < frames.len()).then(|| to(true))]
        };
        let motions = (0..frames.len()).into_par_iter().map(motions).collect();
        Carrier { frames, masks, motions }
    }

    /// By pixel of a frame: the log odds that are added to its `own`. A possible shadow (`shade` above 0) moves
    /// with its mover and is left alone.
    fn added(&self, frame: usize, own: &[f32], shade: &[f32]) -> Vec<f32> {
        let added = |i: usize| match own[i] < CARRIED && shade[i] == 0.0 {
            true => self.agreement(frame, i) * (CARRIED - own[i]),
            false => 0.0,
        };
        (0..own.len()).map(added).collect()
    }

    /// The share of the neighbouring frames whose movers would show a pixel's colours, in [0, 1].
    fn agreement(&self, frame: usize, i: usize) -> f32 {
        let (width, height) = (self.frames[frame].width, self.frames[frame].height);
        let (mut sum, mut total) = (0.0, 0.0);
        for forward in [false, true] {
            let (mut p, mut here, mut weight) = (centre(i, width as usize), frame, 1.0);
            for _ in 0..MEMORY {
                let motion = self.motions[here][usize::from(forward)].as_ref();
                let Some(step) = motion.and_then(|motion| motion.at(p)) else { break };
                p += step;
                here = if forward { here + 1 } else { here - 1 };
                let inside = |v: f64, size: u32| v >= 0.0 && v < f64::from(size);
                if !inside(p.x, width) || !inside(p.y, height) {
                    break;
                }
                weight *= FADING;
                total += weight;
                let difference = self.difference((frame, i), here, p) / EVEN;
                sum += weight / (1.0 + difference * difference);
            }
        }
        if total > 0.0 { sum / total } else { 0.0 }
    }

    /// The mean absolute difference between the patch around a pixel and the most similar patch of another
    /// frame's movers near a position; infinite where that frame shows no mover at the position.
    fn difference(&self, (frame, i): (usize, usize), other: usize, at: DVec2) -> f32 {
        let (a, b, mask) = (&self.frames[frame], &self.frames[other], &self.masks[other]);
        let (w, h) = (a.width as i32, a.height as i32);
        let moves = |x: i32, y: i32| {
            x >= 0 && y >= 0 && x < w && y < h && mask.at(x as u32, y as u32)[0] > 0.5
        };
        let (x, y) = (at.x as i32, at.y as i32);
        if !moves(x, y) {
            return f32::INFINITY;
        }
        let unit = unit(a.width as usize) as i32;
        let shifts = (-SHIFT..=SHIFT).flat_map(|dy| (-SHIFT..=SHIFT).map(move |dx| (dx, dy)));
        let places = shifts.map(|(dx, dy)| (x + unit * dx, y + unit * dy));
        let patches = places.filter(|(x, y)| moves(*x, *y));
        let pixel = (i as i32 % w, i as i32 / w);
        patches.map(|place| patch_difference(a, pixel, b, place)).fold(f32::INFINITY, f32::min)
    }
}

/// The mean absolute difference between the patches of 3 × 3 pixels around two pixels.
fn patch_difference(a: &Image, (ax, ay): (i32, i32), b: &Image, (bx, by): (i32, i32)) -> f32 {
    let (w, h) = (a.width as i32, a.height as i32);
    let inside = |x: i32, y: i32| x >= 0 && y >= 0 && x < w && y < h;
    let (mut sum, mut count) = (0.0, 0.0);
    for dy in -1..=1 {
        for dx in -1..=1 {
            let ((px, py), (qx, qy)) = ((ax + dx, ay + dy), (bx + dx, by + dy));
            if inside(px, py) && inside(qx, qy) {
                let (p, q) = (a.at(px as u32, py as u32), b.at(qx as u32, qy as u32));
                sum += p.iter().zip(q).map(|(p, q)| (p - q).abs()).sum::<f32>();
                count += p.len() as f32;
            }
        }
    }
    sum / count
}

/// The motion of the movers around each pixel, from a frame to a neighbouring one, on a grid.
struct Motion {
    spacing: usize,
    across: usize,
    /// By grid position: displacement, pixels; `None` far from movers.
    steps: Vec<Option<DVec2>>,
}

impl Motion {
    /// The median of the flow of a mask's pixels in a window around each grid position: single pixels that
    /// follow the static world are outvoted.
    fn measured(flow: &NeighbourFlow, mask: &Image, frame: usize, forward: bool) -> Motion {
        let (w, h) = (flow.width, flow.height);
        let unit = unit(w);
        let spacing = SPACING * unit;
        let most = (MOST_RADIUS * w as f64).max(LEAST_RADIUS);
        let mut radius = vec![0.0; w * h];
        for (region, _) in regions(&mask.pixels, w, true) {
            let own = (WINDOW * (region.len() as f64).sqrt()).clamp(LEAST_RADIUS, most);
            region.into_iter().for_each(|i| radius[i] = own);
        }
        let (across, down) = (w.div_ceil(spacing) + 1, h.div_ceil(spacing) + 1);
        let reach = most.ceil() as usize;
        let step = |place: usize| {
            let (cx, cy) = (place % across * spacing, place / across * spacing);
            let mut all: [Vec<f32>; 2] = Default::default();
            for y in (cy.saturating_sub(reach)..(cy + reach).min(h)).step_by(unit) {
                for x in (cx.saturating_sub(reach)..(cx + reach).min(w)).step_by(unit) {
                    let i = y * w + x;
                    let squared = (x.abs_diff(cx).pow(2) + y.abs_diff(cy).pow(2)) as f64;
                    // The radius is 0 outside of the mask.
                    if radius[i] > 0.0 && squared <= radius[i] * radius[i] {
                        let [u, v, confidence] = flow.at(frame, forward, i);
                        if confidence >= CONFIDENT {
                            all[0].push(u);
                            all[1].push(v);
                        }
                    }
                }
            }
            (all[0].len() >= LEAST).then(|| {
                let [u, v] = all.map(|mut values| {
                    let middle = values.len() / 2;
                    f64::from(*values.select_nth_unstable_by(middle, f32::total_cmp).1)
                });
                DVec2::new(u, v)
            })
        };
        Motion { spacing, across, steps: (0..across * down).map(step).collect() }
    }

    /// The motion at a pixel inside the image, from the grid positions around it.
    fn at(&self, p: DVec2) -> Option<DVec2> {
        let at = p / self.spacing as f64;
        let (low, part) = (at.floor(), at.fract());
        let (mut sum, mut total) = (DVec2::ZERO, 0.0);
        for (dx, dy) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
            let place = (low.y as usize + dy) * self.across + low.x as usize + dx;
            let weight = |share: f64, far: usize| if far == 1 { share } else { 1.0 - share };
            if let Some(step) = self.steps[place] {
                let weight = weight(part.x, dx) * weight(part.y, dy);
                (sum, total) = (sum + weight * step, total + weight);
            }
        }
        (total > 0.0).then(|| sum / total)
    }
}

/// Number of pixels that are one at a width of [`WIDTH`].
fn unit(width: usize) -> usize {
    (width / WIDTH).max(1)
}

#[cfg(test)]
mod tests {
    use super::super::sliding::{self, FRAMES, HEIGHT, WIDTH, flow, map, wall, within};
    use super::*;

    /// The upper edge of a mover of 20 × 18 pixels that moves down in front of a grey wall.
    fn top(frame: usize) -> f64 {
        4.0 + 2.0 * frame as f64
    }

    fn mover(frame: usize, p: DVec2) -> bool {
        within(p, (20.0, top(frame)), (40.0, top(frame) + 18.0))
    }

    /// The part of the mover that is as grey as the wall.
    fn stripe(frame: usize, p: DVec2) -> bool {
        within(p, (20.0, top(frame) + 6.0), (40.0, top(frame) + 11.0))
    }

    /// A green post in front of the mover.
    fn post(p: DVec2) -> bool {
        within(p, (32.0, 0.0), (35.0, 40.0))
    }

    #[test]
    fn a_stripe_with_the_colour_of_the_wall_is_carried_from_other_frames_and_a_post_is_not() {
        let frames: Vec<Image> = (0..FRAMES)
            .map(|frame| {
                let mut image = Image::new(WIDTH, HEIGHT, 3);
                for (i, c) in image.pixels.chunks_exact_mut(3).enumerate() {
                    let p = sliding::centre(i);
                    let painted = mover(frame, p) && !stripe(frame, p);
                    let shown = if painted { [0.9, 0.2, 0.2] } else { [0.5; 3] };
                    c.copy_from_slice(&if frame == 2 && post(p) { [0.1, 0.7, 0.1] } else { shown });
                }
                image
            })
            .collect();
        // In two frames the stripe is taken for the wall, by the flow as well as by the masks.
        let lost = |frame: usize, p: DVec2| (2..4).contains(&frame) && stripe(frame, p);
        let hidden = |frame: usize, p: DVec2| frame == 2 && post(p);
        let down = DVec2::new(0.0, 2.0);
        let flow = flow(|frame, p| match mover(frame, p) && !lost(frame, p) {
            true => down,
            false => wall(),
        });
        let found = |f: usize, p: DVec2| mover(f, p) && !lost(f, p) && !hidden(f, p);
        let masks: Vec<Image> =
            (0..FRAMES).map(|f| map(|p| f32::from(u8::from(found(f, p))))).collect();
        let carrier = Carrier::new(&frames, &flow, &masks);
        for frame in 2..4 {
            let own = map(|p| if found(frame, p) { 3.0 } else { -3.0 }).pixels;
            let added = carrier.added(frame, &own, &vec![0.0; own.len()]);
            for (i, (own, added)) in own.iter().zip(&added).enumerate() {
                let p = sliding::centre(i);
                let (odds, x) = (own + added, p.x);
                if hidden(frame, p) {
                    assert!(odds < -2.0, "frame {frame}, {p}: the post is not the mover: {odds}");
                } else if lost(frame, p) && (22.0..30.0).contains(&x) {
                    assert!(odds > -0.5, "frame {frame}, {p}: the stripe is the mover's: {odds}");
                } else if !within(p, (17.0, top(frame) - 3.0), (43.0, top(frame) + 21.0)) {
                    assert!(odds < -1.0, "frame {frame}, {p}: the wall is not the mover: {odds}");
                }
            }
            let shaded = carrier.added(frame, &own, &vec![0.2; own.len()]);
            assert!(shaded.iter().all(|added| *added == 0.0), "a shadow stays what it is");
        }
    }
}
