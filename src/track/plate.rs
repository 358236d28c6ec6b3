//! The background plates: what each frame would show if nothing moved.
//!
//! Cameras and static depth determine where a static point is in every other frame. A frame's plate is the
//! median of the colours that the other frames show there, without movers. A pixel that differs from the
//! plate moves, whether flow can track it or not. A shadow differs from a mover in that it scales the plate
//! and keeps its texture.

use glam::DVec2;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::Stage;
use super::cameras::Cameras;
use super::depth::{Layer, MEASURED};
use super::observer::Work;
use crate::Result;
use crate::types::{Image, Pose};

/// Maximum number of source frames of a plate.
const SOURCES: usize = 20;
/// Number of these that are the nearest frames.
const NEXT: usize = 4;
/// Maximum distance of a source frame, in frames.
const REACH: usize = 60;
/// Pixels within this distance of a mover may show it, pixels.
pub(super) const MARGIN: usize = 3;
/// Two inverse depths are of the same point if they differ by at most the sum of the first number times the
/// inverse depth and the second number (in 1 / unit).
const SAME_POINT: (f64, f64) = (0.06, 0.004);
/// Minimum number of frames that must show a pixel for its plate to be known.
const WITNESSES: u8 = 3;

/// The evidence from the plate of a frame; all lists hold one value per pixel.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct Evidence {
    /// Log odds of motion; NaN where the plate is unknown.
    pub odds: Vec<f32>,
    /// Whether the plate is unknown because the other frames show movers there.
    pub covered: Vec<bool>,
    /// The share of the light that a shadow on the static world removes, if a shadow explains the pixel
    /// better than motion; else 0.
    pub shade: Vec<f32>,
    /// Brightness of the plate, mean over the channels; NaN where it is unknown.
    pub brightness: Vec<f32>,
    /// Inverse depth of the static world from the other frames, also behind movers; 0 where unknown.
    pub hidden: Vec<f32>,
}

/// The background plate of a frame.
struct Plate {
    /// RGB, at the frame's own exposure.
    colour: Vec<[f32; 3]>,
    /// Median absolute deviation of the colours in the source frames, mean over the channels.
    spread: Vec<f32>,
    /// Number of frames that show the static point.
    witnesses: Vec<u8>,
    /// Number of frames that show a mover there.
    covered: Vec<u8>,
}

/// The evidence from the plates of all frames. `masks` show roughly what moves; `layers` are the static
/// world. `part` is the name under which finished frames are saved.
pub(super) fn evidence(
    frames: &[Image],
    cameras: &Cameras,
    layers: &[Layer],
    masks: &[Image],
    work: &mut Work,
    part: &str,
    shares: std::ops::Range<f64>,
) -> Result<Vec<Evidence>> {
    let clip = Clip::new(frames, cameras, layers, masks);
    let made = |range: std::ops::Range<usize>| {
        let of = |frame: usize| {
            let hidden = clip.hidden(frame);
            clip.plate(frame, &hidden).evidence(&frames[frame], hidden)
        };
        range.into_par_iter().map(of).collect()
    };
    work.frames(part, frames.len(), made, Stage::Depth, shares)
}

/// The clip that plates are made from.
struct Clip<'a> {
    frames: &'a [Image],
    cameras: &'a Cameras,
    layers: &'a [Layer],
    masks: &'a [Image],
    /// Pixels on movers or beside them.
    near_movers: Vec<Vec<bool>>,
}

impl<'a> Clip<'a> {
    fn new(
        frames: &'a [Image],
        cameras: &'a Cameras,
        layers: &'a [Layer],
        masks: &'a [Image],
    ) -> Clip<'a> {
        let near_movers = masks.par_iter().map(|mask| mask.near(MARGIN)).collect();
        Clip { frames, cameras, layers, masks, near_movers }
    }

    /// Whether a frame has measured the static depth of a pixel.
    fn knows(&self, frame: usize, i: usize) -> bool {
        let measured = !self.cameras.have_parallax() || self.layers[frame].confidence[i] > MEASURED;
        measured && !self.near_movers[frame][i]
    }

    /// The source frames: the nearest ones, and an even selection of those farther away.
    fn sources(&self, frame: usize) -> Vec<usize> {
        let mut others: Vec<usize> = (0..self.frames.len())
            .filter(|other| (1..=REACH).contains(&other.abs_diff(frame)))
            .collect();
        others.sort_by_key(|other| other.abs_diff(frame));
        let far = others.split_off(NEXT.min(others.len()));
        let room = SOURCES - NEXT;
        let chosen = (0..room.min(far.len())).map(|k| far[k * far.len() / room.min(far.len())]);
        others.extend(chosen);
        others
    }

    /// Inverse depth of the static world in a frame, as measured by the other frames; 0 where none did.
    fn hidden(&self, frame: usize) -> Vec<f32> {
        let k = &self.cameras.intrinsics;
        let (w, h) = (self.masks[frame].width as usize, self.masks[frame].height as usize);
        let mut found: Vec<Vec<f32>> = vec![Vec::new(); w * h];
        let mut nearest = vec![0.0f32; w * h];
        for other in self.sources(frame) {
            nearest.fill(0.0);
            let frame_from_other = self.relative(other, frame);
            for i in (0..w * h).filter(|i| self.knows(other, *i)) {
                let ray = k.ray(centre(i, w));
                let d = f64::from(self.layers[other].inverse[i]);
                let point = frame_from_other.apply(ray / d);
                if point.z < 1e-3 {
                    continue;
                }
                let at = k.project(point) - 0.5;
                let (x, y) = (at.x.floor() as i64, at.y.floor() as i64);
                for (x, y) in [(x, y), (x + 1, y), (x, y + 1), (x + 1, y + 1)] {
                    if (0..w as i64).contains(&x) && (0..h as i64).contains(&y) {
                        let j = y as usize * w + x as usize;
                        nearest[j] = nearest[j].max(point.z.recip() as f32);
                    }
                }
            }
            for (j, d) in nearest.iter().enumerate() {
                if *d > 0.0 {
                    found[j].push(*d);
                }
            }
        }
        found.into_iter().map(|mut all| median(&mut all).unwrap_or(0.0)).collect()
    }

    /// `frame_from_other`.
    fn relative(&self, other: usize, frame: usize) -> Pose {
        self.cameras.poses[frame] * self.cameras.poses[other].inverse()
    }

    /// The plate of a frame. Each pixel has the frame's own depth if other frames confirm it, else the depth
    /// measured by other frames (`hidden`, 0 where unknown).
    fn plate(&self, frame: usize, hidden: &[f32]) -> Plate {
        let k = &self.cameras.intrinsics;
        let w = self.masks[frame].width as usize;
        let views: Vec<(usize, Pose)> = self
            .sources(frame)
            .into_iter()
            .map(|other| (other, self.relative(frame, other)))
            .collect();
        let own = &self.layers[frame].inverse;
        let mut plate = Plate {
            colour: vec![[0.0; 3]; own.len()],
            spread: vec![0.0; own.len()],
            witnesses: vec![0; own.len()],
            covered: vec![0; own.len()],
        };
        let mut seen: [Vec<f32>; 3] = Default::default();
        for i in 0..own.len() {
            let ray = k.ray(centre(i, w));
            let mut covered = 0u8;
            let mut look = |d: f32| {
                seen.iter_mut().for_each(Vec::clear);
                let point = ray / f64::from(d);
                let mut through = 0;
                covered = 0;
                for (other, other_from_frame) in &views {
                    match self.shown(*other, other_from_frame.apply(point)) {
                        Shown::Point(colour) => {
                            seen.iter_mut().zip(colour).for_each(|(all, c)| all.push(c));
                        }
                        Shown::Behind => through += 1,
                        Shown::Mover => covered += 1,
                        Shown::Nothing => {}
                    }
                }
                (seen[0].len(), through)
            };
            let (confirm, deny) = if self.near_movers[frame][i] { (0, 0) } else { look(own[i]) };
            if (confirm < usize::from(WITNESSES) || deny > confirm) && hidden[i] > 0.0 {
                look(hidden[i]);
            } else if confirm == 0 {
                look(own[i]);
            }
            plate.witnesses[i] = seen[0].len() as u8;
            plate.covered[i] = covered;
            for (c, all) in seen.iter_mut().enumerate() {
                let Some(middle) = median(all) else { break };
                plate.colour[i][c] = middle;
                all.iter_mut().for_each(|value| *value = (*value - middle).abs());
                plate.spread[i] += median(all).unwrap_or(0.0) / 3.0;
            }
        }
        plate.expose(&self.frames[frame], &self.near_movers[frame]);
        plate
    }

    /// What a frame shows at the position of a static point, given in its camera's axes.
    fn shown(&self, frame: usize, point: glam::DVec3) -> Shown {
        if point.z < 1e-3 {
            return Shown::Nothing;
        }
        let image = &self.frames[frame];
        let at = self.cameras.intrinsics.project(point);
        let (w, h) = (image.width as usize, image.height as usize);
        let inside = |v: f64, size: usize| v >= 0.5 && v <= size as f64 - 0.5;
        if !inside(at.x, w) || !inside(at.y, h) {
            return Shown::Nothing;
        }
        let i = at.y as usize * w + at.x as usize;
        let (d, expected) = (f64::from(self.layers[frame].inverse[i]), point.z.recip());
        // Filled-in depth is less accurate.
        let share = if self.knows(frame, i) { SAME_POINT.0 } else { 4.0 * SAME_POINT.0 };
        let beyond = d - expected;
        if self.near_movers[frame][i] {
            return Shown::Mover;
        }
        let within = share * expected + SAME_POINT.1;
        if beyond < -within {
            return Shown::Behind;
        }
        if beyond > within {
            return Shown::Nothing;
        }
        let (x, y) = (at.x - 0.5, at.y - 0.5);
        let (x0, y0) = ((x as u32).min(image.width - 2), (y as u32).min(image.height - 2));
        let (fx, fy) = ((x - f64::from(x0)) as f32, (y - f64::from(y0)) as f32);
        let corner = |dx: u32, dy: u32| image.at(x0 + dx, y0 + dy);
        let (a, b, c, d) = (corner(0, 0), corner(1, 0), corner(0, 1), corner(1, 1));
        Shown::Point([0, 1, 2].map(|k| {
            let top = a[k] + (b[k] - a[k]) * fx;
            let bottom = c[k] + (d[k] - c[k]) * fx;
            top + (bottom - top) * fy
        }))
    }
}

/// What a frame shows at the position of a static point.
enum Shown {
    /// The point, with its colour.
    Point([f32; 3]),
    /// Something behind the point.
    Behind,
    /// A mover, or something beside one.
    Mover,
    /// No evidence: something nearer is shown, or the point is outside the image.
    Nothing,
}

impl Plate {
    /// Brings the plate to the exposure of the frame with one gain per channel, measured at pixels that are
    /// certainly static.
    fn expose(&mut self, image: &Image, near_movers: &[bool]) {
        for c in 0..3 {
            let mut ratios: Vec<f32> = (0..self.colour.len())
                .filter(|i| self.witnesses[*i] >= WITNESSES && !near_movers[*i])
                .filter(|i| self.colour[*i][c] > 0.05)
                .map(|i| image.pixels[3 * i + c] / self.colour[i][c])
                .collect();
            let gain = median(&mut ratios).unwrap_or(1.0);
            self.colour.iter_mut().for_each(|colour| colour[c] *= gain);
        }
    }

    /// The evidence about the frame.
    fn evidence(&self, image: &Image, hidden: Vec<f32>) -> Evidence {
        let judged = |i: usize| self.judge(image, i).unwrap_or((f32::NAN, 0.0));
        let (odds, shade) = (0..self.colour.len()).map(judged).unzip();
        let brightness = |(colour, witnesses): (&[f32; 3], &u8)| match *witnesses >= WITNESSES {
            true => colour.iter().sum::<f32>() / 3.0,
            false => f32::NAN,
        };
        let covered =
            |(witnesses, covered): (&u8, &u8)| *witnesses < WITNESSES && *covered >= WITNESSES;
        let covered = self.witnesses.iter().zip(&self.covered).map(covered).collect();
        let brightness = self.colour.iter().zip(&self.witnesses).map(brightness).collect();
        Evidence { odds, covered, shade, brightness, hidden }
    }

    /// Log odds of motion of a pixel, and the share of the light that a shadow removes.
    fn judge(&self, image: &Image, i: usize) -> Option<(f32, f32)> {
        if self.witnesses[i] < WITNESSES {
            return None;
        }
        // Static edges are accurate to a pixel, so the best of nine shifts is used.
        let shifts = (0..9).map(|k| (k % 3 - 1, k / 3 - 1));
        let compared: Vec<Compared> =
            shifts.filter_map(|shift| self.compare(image, i, shift)).collect();
        let least = |value: fn(&Compared) -> f32| {
            compared.iter().copied().min_by(|a, b| value(a).total_cmp(&value(b)))
        };
        let as_it_is = least(|c| c.difference)?;
        let shaded = least(|c| c.shaded)?;
        let even = EVEN + 2.0 * as_it_is.spread;
        let odds =
            |difference: f32| (2.0 * ((difference + 0.01) / even).ln()).clamp(ODDS.0, ODDS.1);
        let moved = odds(as_it_is.difference);
        if moved > 0.0 && (SHADE.0..SHADE.1).contains(&shaded.gain) {
            let shade = odds(shaded.shaded) + SHADE_COST;
            if shade < moved {
                return Some((shade, 1.0 - shaded.gain));
            }
        }
        Some((moved, 0.0))
    }

    /// Compares the patch around a pixel with the plate, shifted by up to a pixel.
    fn compare(&self, image: &Image, i: usize, (sx, sy): (i32, i32)) -> Option<Compared> {
        let (w, h) = (image.width as i32, image.height as i32);
        let (x, y) = (i as i32 % w, i as i32 / w);
        let mut pairs = [([0.0f32; 3], [0.0f32; 3]); 9];
        let (mut count, mut spread) = (0, 0.0);
        for dy in -1..=1 {
            for dx in -1..=1 {
                let (px, py) = (x + dx, y + dy);
                let (qx, qy) = (px + sx, py + sy);
                let inside = |x: i32, y: i32| x >= 0 && y >= 0 && x < w && y < h;
                if !inside(px, py) || !inside(qx, qy) {
                    continue;
                }
                let q = (qy * w + qx) as usize;
                if self.witnesses[q] < WITNESSES {
                    continue;
                }
                let shown = image.at(px as u32, py as u32);
                pairs[count] = ([shown[0], shown[1], shown[2]], self.colour[q]);
                spread += self.spread[q];
                count += 1;
            }
        }
        if count < 4 {
            return None;
        }
        let pairs = &pairs[..count];
        let sums = |f: &dyn Fn(f32, f32) -> f32| -> f32 {
            pairs.iter().flat_map(|(a, b)| a.iter().zip(b)).map(|(a, b)| f(*a, *b)).sum()
        };
        let n = 3.0 * count as f32;
        let gain = sums(&|a, b| a * b) / sums(&|_, b| b * b).max(1e-4);
        Some(Compared {
            difference: sums(&|a, b| (a - b).abs()) / n,
            shaded: sums(&|a, b| (a - gain * b).abs()) / n / gain.max(0.2).sqrt(),
            gain,
            spread: spread / count as f32,
        })
    }
}

/// The comparison of a patch with the plate.
#[derive(Clone, Copy)]
struct Compared {
    /// Mean absolute difference.
    difference: f32,
    /// The same after applying the best gain to the plate, divided by the root of that gain.
    shaded: f32,
    gain: f32,
    spread: f32,
}

/// Difference from the plate at which motion and noise are equally likely.
const EVEN: f32 = 0.04;
/// Range of the log odds.
const ODDS: (f32, f32) = (-3.0, 4.0);
/// Range of the gains of shadows.
const SHADE: (f32, f32) = (0.25, 0.93);
/// Log odds added to those of a shadow compared with an unchanged pixel.
const SHADE_COST: f32 = 0.5;

/// The centre of pixel `i` of an image of width `w`.
pub(super) fn centre(i: usize, w: usize) -> DVec2 {
    DVec2::new((i % w) as f64 + 0.5, (i / w) as f64 + 0.5)
}

/// The median; for an even number of values the lower middle one. Reorders the values.
fn median(values: &mut [f32]) -> Option<f32> {
    let middle = values.len().checked_sub(1)? / 2;
    Some(*values.select_nth_unstable_by(middle, f32::total_cmp).1)
}

#[cfg(test)]
mod tests {
    use super::super::sliding::{self, FRAMES, HEIGHT, STEP, WALL, WIDTH, map, within, working};
    use super::*;

    /// A mover that moves down by its height from frame to frame.
    fn mover(frame: usize, p: DVec2) -> bool {
        within(p, (24.0, 6.0 * frame as f64), (38.0, 6.0 * frame as f64 + 6.0))
    }

    /// A shadow that moves up.
    fn shadow(frame: usize, p: DVec2) -> bool {
        let y = 6.0 * (FRAMES - frame) as f64;
        within(p, (44.0, y - 6.0), (58.0, y))
    }

    /// The wall with its texture, a mover, a shadow; the fourth frame is darker.
    fn frames() -> Vec<Image> {
        let frame = |f: usize| {
            let mut image = Image::new(WIDTH, HEIGHT, 3);
            for (i, c) in image.pixels.chunks_exact_mut(3).enumerate() {
                let p = sliding::centre(i);
                let q = p - sliding::wall() * f as f64;
                let wall = 0.5 + 0.2 * (0.9 * q.x).sin() * (0.7 * q.y).cos();
                let gain = if f == 3 { 0.8 } else { 1.0 };
                let seen = match (mover(f, p), shadow(f, p)) {
                    (true, _) => [0.9, 0.2, 0.1],
                    (_, true) => [0.6 * wall; 3],
                    _ => [wall; 3],
                };
                c.copy_from_slice(&seen.map(|v| (gain * v) as f32));
            }
            image
        };
        (0..FRAMES).map(frame).collect()
    }

    /// The wall; it is not measured at the mover, where it seems nearer.
    fn layers() -> Vec<Layer> {
        let layer = |f: usize| {
            let by = |here: f32, there: f32| map(|p| if mover(f, p) { here } else { there }).pixels;
            let wall = (1.0 / WALL) as f32;
            let pixels = (WIDTH * HEIGHT) as usize;
            Layer {
                estimated: Vec::new(),
                inverse: by(2.0 * wall, wall),
                confidence: by(0.0, 0.9),
                supplied: vec![false; pixels],
            }
        };
        (0..FRAMES).map(layer).collect()
    }

    /// The evidence for given masks.
    fn found(masks: &[Image]) -> Vec<Evidence> {
        let cameras = sliding::cameras(STEP);
        working(|work| {
            evidence(&frames(), &cameras, &layers(), masks, work, "test", 0.0..1.0).unwrap()
        })
    }

    #[test]
    fn movers_differ_from_the_plate_and_shadows_scale_it() {
        // The masks are empty.
        let found = found(&vec![map(|_| 0.0); FRAMES]);
        for (f, evidence) in found.iter().enumerate() {
            // The share of the pixels of a kind whose evidence is correct.
            let share = |kind: &dyn Fn(DVec2) -> bool, right: &dyn Fn(f32, bool) -> bool| {
                let own = (0..evidence.odds.len())
                    .filter(|i| kind(sliding::centre(*i)) && !evidence.odds[*i].is_nan());
                let own: Vec<usize> = own.collect();
                assert!(own.len() > 40, "frame {f}: only {} are known", own.len());
                let right =
                    own.iter().filter(|i| right(evidence.odds[**i], evidence.shade[**i] > 0.0));
                right.count() as f64 / own.len() as f64
            };
            let moves = share(&|p| mover(f, p), &|odds, shade| odds > 1.0 && !shade);
            let shaded = share(&|p| shadow(f, p), &|odds, shade| shade && odds < 0.0);
            let near = |p: DVec2, of: fn(usize, DVec2) -> bool| {
                [-3.0, 0.0, 3.0]
                    .iter()
                    .any(|dx| [-3.0, 0.0, 3.0].iter().any(|dy| of(f, p + DVec2::new(*dx, *dy))))
            };
            let stands = share(&|p| !near(p, mover) && !near(p, shadow), &|odds, _| odds < 0.0);
            // Patches on the boundaries show both.
            assert!(moves > 0.9 && shaded > 0.5 && stands > 0.97, "{f}: {moves} {shaded} {stands}");
        }
    }

    #[test]
    fn what_a_mover_hides_is_told_by_other_frames() {
        let masks: Vec<Image> =
            (0..FRAMES).map(|f| map(|p| f32::from(u8::from(mover(f, p))))).collect();
        for (f, evidence) in found(&masks).iter().enumerate() {
            for (i, hidden) in evidence.hidden.iter().enumerate() {
                // The sides of the image are seen by fewer frames.
                let known = mover(f, sliding::centre(i));
                assert!(!known || (f64::from(*hidden) * WALL - 1.0).abs() < 1e-3, "{f}: {hidden}");
            }
        }
    }

    #[test]
    fn what_movers_cover_in_all_frames_is_known_to_be_covered() {
        // The left quarter, as the last camera sees it, is behind movers in every frame.
        let masks: Vec<Image> = (0..FRAMES)
            .map(|f| {
                let end = 16.0 - sliding::wall().x * (FRAMES - 1 - f) as f64;
                map(|p| f32::from(u8::from(p.x < end)))
            })
            .collect();
        let last = &found(&masks)[FRAMES - 1];
        for i in 0..last.odds.len() {
            let p = sliding::centre(i);
            if within(p, (2.0, 2.0), (12.0, 38.0)) {
                assert!(last.odds[i].is_nan() && last.covered[i], "{p}");
            } else if within(p, (24.0, 2.0), (52.0, 38.0)) {
                assert!(!last.odds[i].is_nan() && !last.covered[i], "{p}");
            } else if p.x > 63.0 {
                // This column has only just entered the image.
                assert!(last.odds[i].is_nan() && !last.covered[i], "{p}");
            }
        }
    }

    #[test]
    fn a_clip_too_short_has_no_plate() {
        let (frames, masks) = (&frames()[..2], vec![map(|_| 0.0); 2]);
        let cameras = sliding::cameras(STEP);
        let found = working(|work| {
            evidence(frames, &cameras, &layers()[..2], &masks, work, "test", 0.0..1.0).unwrap()
        });
        assert!(found.iter().all(|evidence| evidence.odds.iter().all(|odds| odds.is_nan())));
    }
}
