//! Motion masks with the help of a source that draws whatever it is pointed at.
//!
//! What moves is told by the residuals; where exactly it ends, and what of its inside leaves no residual, a
//! network knows better. Each region of the masks is asked for by points: on it where motion is
//! plainest, beside it where the static world explains the picture best. Of what the source draws, the
//! mask is taken that fits the region best, if it moves more than what stands still and does not cross
//! what plainly stands. Its log odds, bounded, are added to those of motion: they do not overrule
//! strong evidence.

use glam::DVec2;
use serde::{Deserialize, Serialize};

use super::Stage;
use super::masks::{Judged, regions};
use super::observer::{Work, numbered};
use crate::observe::{FoundMask, MaskQuery, MaskSource, NeighbourFlow, Prompt};
use crate::types::Image;
use crate::{Error, Result};

/// Points of each kind for a region, at most.
const POINTS: usize = 8;
/// They are so far apart, as a share of the picture's width.
const APART: f64 = 0.05;
/// A point is judged by the mean over so much about it, as a share of the width.
const ABOUT: f64 = 0.01;
/// Points beside a region are within so much of its bounds, as a share of the width.
const BESIDE: f64 = 0.15;
/// Pixels so near to a region are beside it, as a share of the width: there its mask has a say.
const MARGIN: f64 = 0.03;
/// Log odds of motion of points beside, at most.
const STANDS: f32 = -0.5;
/// Regions of a frame that are asked for, at most, the largest ones.
const REGIONS: usize = 8;
/// A mask of the frame before belongs to a region with which it overlaps by this, as a share of both.
const SAME: f64 = 0.2;
/// An accepted mask covers less than this share of the picture.
const LARGEST: f64 = 0.9;
/// By how many standard deviations of the mean an accepted mask moves more than what stands still.
const ABOVE: f64 = 3.0;
/// An accepted mask fits its region by this at least.
const LEAST_FIT: f64 = 0.5;
/// Log odds of an accepted mask, at most. Ones that are off by two pixels raise the walker's masks most with 1,
/// and ones that slip by six do them no harm; with 2 these do.
const BOUND: f32 = 1.0;
/// Log odds that are handed on to the next frame.
const HANDED: f32 = 16.0;

/// What a source's masks say of a clip.
pub(super) struct Prompted {
    /// Log odds by frame and pixel, to be added.
    pub odds: Vec<Vec<f32>>,
    /// Frames in which a mask was accepted.
    pub accepted: usize,
}

/// What they say of a frame.
#[derive(Serialize, Deserialize)]
struct Said {
    /// Log odds by pixel, to be added.
    odds: Vec<f32>,
    /// Log odds of each mask that was accepted.
    accepted: Vec<Image>,
}

/// Asks a source for what moves by `masks`, frame by frame.
///
/// # Errors
/// What the source or the observer of `work` returns; masks of another size than the frames' or with values
/// that are no numbers.
pub(super) fn ask(
    judged: &Judged,
    masks: &[Image],
    source: &mut dyn MaskSource,
    work: &mut Work,
    part: &str,
) -> Result<Prompted> {
    let mut out = Prompted { odds: Vec::with_capacity(masks.len()), accepted: 0 };
    let mut before = Vec::new();
    for (number, mask) in masks.iter().enumerate() {
        let said = work.part(&numbered(&format!("{part}/prompted"), number), |_| {
            let picture = &judged.observed.frames[number];
            let frame = Frame::new(number, picture, judged.gathered(number), mask);
            let handed: Vec<Image> =
                before.iter().map(|odds| warped(judged.observed.flow, number, odds)).collect();
            frame.ask(source, &handed)
        })?;
        out.accepted += usize::from(!said.accepted.is_empty());
        out.odds.push(said.odds);
        before = said.accepted;
        work.progress(Stage::Masks, (number + 1) as f64 / masks.len() as f64)?;
    }
    Ok(out)
}

/// A mask of the frame before, where its pixels are now; 0 where that is not known.
fn warped(flow: &NeighbourFlow, frame: usize, before: &Image) -> Image {
    let value = |i: usize| {
        let step = flow.step(frame, false, centre(i, flow.width));
        step.map_or(0.0, |from| from.confidence * before.between(from.pixel.x, from.pixel.y))
    };
    let pixels = (0..flow.width * flow.height).map(value).collect();
    Image { pixels, ..*before }
}

fn centre(i: usize, width: usize) -> DVec2 {
    DVec2::new((i % width) as f64 + 0.5, (i / width) as f64 + 0.5)
}

/// A frame, and what is known of its motion.
struct Frame<'a> {
    number: usize,
    picture: &'a Image,
    width: usize,
    /// Log odds of motion by pixel.
    odds: Vec<f32>,
    /// Their means about each pixel.
    means: Vec<f32>,
    /// By pixel, one more than the number of its region; 0 outside.
    region: Vec<usize>,
    /// Pixels of each region.
    regions: Vec<Vec<usize>>,
    /// Mean and standard deviation of the probability of motion where nothing moves.
    level: (f64, f64),
}

impl<'a> Frame<'a> {
    /// A frame by the log odds of motion of its pixels, and the mask that was made of them.
    fn new(number: usize, picture: &'a Image, odds: Vec<f32>, mask: &Image) -> Frame<'a> {
        let width = mask.width as usize;
        let mut found: Vec<Vec<usize>> =
            regions(&mask.pixels, width, true).into_iter().map(|(region, _)| region).collect();
        // The sort is stable: of two of one size the upper one comes first.
        found.sort_by_key(|region| std::cmp::Reverse(region.len()));
        found.truncate(REGIONS);
        let mut region = vec![0; odds.len()];
        for (k, pixels) in found.iter().enumerate() {
            pixels.iter().for_each(|i| region[*i] = k + 1);
        }
        let stands = mask.near(share(MARGIN, width));
        let still: Vec<f64> = (0..odds.len())
            .filter(|i| !stands[*i])
            .map(|i| f64::from(probability(odds[i])))
            .collect();
        let n = still.len().max(1) as f64;
        let mean = still.iter().sum::<f64>() / n;
        let variance = still.iter().map(|p| (p - mean).powi(2)).sum::<f64>() / n;
        Frame {
            number,
            picture,
            width,
            means: means(&odds, width, share(ABOUT, width)),
            odds,
            region,
            regions: found,
            level: (mean, variance.sqrt()),
        }
    }

    /// Asks for all regions. `handed` are the masks that were accepted in the frame before, as they are here.
    fn ask(&self, source: &mut dyn MaskSource, handed: &[Image]) -> Result<Said> {
        let query = |k: usize| {
            let prompts = self.prompts(k);
            let any = prompts.iter().any(|prompt| prompt.inside);
            any.then(|| (k, MaskQuery { prompts, before: self.before(k, handed) }))
        };
        let (asked, queries): (Vec<usize>, Vec<MaskQuery>) =
            (0..self.regions.len()).filter_map(query).unzip();
        if queries.is_empty() {
            return Ok(Said { odds: vec![0.0; self.odds.len()], accepted: Vec::new() });
        }
        let found = source.masks(self.number, self.picture, &queries)?;
        if found.len() != queries.len() {
            return Err(self.wrong(&format!(
                "{} answers to {} questions came back",
                found.len(),
                queries.len()
            )));
        }
        let mut accepted = Vec::new();
        for (k, candidates) in asked.into_iter().zip(found) {
            candidates.iter().try_for_each(|one| self.check(one))?;
            let best = candidates
                .into_iter()
                .filter_map(|one| Some((self.fit(k, &one.odds)?, one)))
                .max_by(|a, b| a.0.total_cmp(&b.0).then(a.1.score.total_cmp(&b.1.score)));
            accepted.extend(best.map(|(_, one)| (k, one.odds)));
        }
        let odds = self.say(&accepted);
        let bounded = |(_, mut odds): (usize, Image)| {
            odds.pixels.iter_mut().for_each(|odds| *odds = odds.clamp(-HANDED, HANDED));
            odds
        };
        Ok(Said { odds, accepted: accepted.into_iter().map(bounded).collect() })
    }

    /// Points on a region where it moves most plainly, and beside it where the world plainly stands still.
    fn prompts(&self, k: usize) -> Vec<Prompt> {
        let on = self.chosen(self.regions[k].clone(), |i| self.means[i], 0.0);
        let beside = self.beside(k).collect();
        let off = self.chosen(beside, |i| -self.means[i], -STANDS);
        let prompt = |inside| move |i| Prompt { pixel: centre(i, self.width), inside };
        on.into_iter().map(prompt(true)).chain(off.into_iter().map(prompt(false))).collect()
    }

    /// Pixels about a region that are in none.
    fn beside(&self, k: usize) -> impl Iterator<Item = usize> {
        let reach = share(BESIDE, self.width);
        let (width, height) = (self.width, self.odds.len() / self.width);
        let bounds = |of: fn(usize, usize) -> usize| {
            let along = self.regions[k].iter().map(move |i| of(*i, width));
            let low = along.clone().min().unwrap_or(0).saturating_sub(reach);
            (low, along.max().unwrap_or(0) + reach)
        };
        let (left, right) = bounds(|i, width| i % width);
        let (top, bottom) = bounds(|i, width| i / width);
        let row = move |y| (left..=right.min(width - 1)).map(move |x| y * width + x);
        (top..=bottom.min(height - 1)).flat_map(row).filter(|i| self.region[*i] == 0)
    }

    /// The pixels with the highest scores above a least one, which keep apart.
    fn chosen(
        &self,
        mut pixels: Vec<usize>,
        score: impl Fn(usize) -> f32,
        least: f32,
    ) -> Vec<usize> {
        pixels.retain(|i| score(*i) > least);
        pixels.sort_by(|a, b| score(*b).total_cmp(&score(*a)).then(a.cmp(b)));
        let apart = APART * self.width as f64;
        let mut out: Vec<usize> = Vec::new();
        for i in pixels {
            let near = |j: &usize| centre(*j, self.width).distance(centre(i, self.width)) < apart;
            if !out.iter().any(near) {
                out.push(i);
            }
            if out.len() == POINTS {
                break;
            }
        }
        out
    }

    /// The mask of the frame before that belongs to a region.
    fn before(&self, k: usize, handed: &[Image]) -> Option<Image> {
        let overlap = |mask: &Image| {
            let pixels = mask.pixels.iter().filter(|odds| **odds > 0.0).count();
            let both = self.regions[k].iter().filter(|i| mask.pixels[**i] > 0.0).count();
            both as f64 / (pixels + self.regions[k].len() - both) as f64
        };
        let best = handed.iter().max_by(|a, b| overlap(a).total_cmp(&overlap(b)))?;
        (overlap(best) > SAME).then(|| best.clone())
    }

    /// How well a mask fits a region that moves: the expected share of pixels that are in both, of those in
    /// either. None if it is not to be believed.
    fn fit(&self, k: usize, mask: &Image) -> Option<f64> {
        let inside = |i: usize| mask.pixels[i] > 0.0;
        let p = |i: usize| f64::from(probability(self.odds[i]));
        let (mut area, mut moving) = (0usize, 0.0);
        for i in (0..self.odds.len()).filter(|i| inside(*i)) {
            area += 1;
            moving += p(i);
        }
        if area == 0 || area as f64 >= LARGEST * self.odds.len() as f64 {
            return None;
        }
        // Pixels beside each other say the same.
        let alike = (2 * share(ABOUT, self.width) + 1).pow(2) as f64;
        let (mean, deviation) = self.level;
        let doubt = deviation / (area as f64 / alike).max(1.0).sqrt();
        let outside: f64 = self.regions[k].iter().filter(|i| !inside(**i)).map(|i| p(*i)).sum();
        let fit = moving / (area as f64 + outside);
        let above = moving / area as f64 > mean + ABOVE * doubt;
        (above && fit >= LEAST_FIT).then_some(fit)
    }

    /// What accepted masks, each of a region, say of the pixels in them, in their region and beside.
    fn say(&self, accepted: &[(usize, Image)]) -> Vec<f32> {
        let mut said: Vec<Option<f32>> = vec![None; self.odds.len()];
        for (k, mask) in accepted {
            let own = |i: usize| self.region[i] == k + 1;
            let mut thing = Image::new(mask.width, mask.height, 1);
            for (i, value) in thing.pixels.iter_mut().enumerate() {
                *value = f32::from(u8::from(own(i) || mask.pixels[i] > 0.0));
            }
            let near = thing.near(share(MARGIN, self.width));
            for i in 0..said.len() {
                let odds = mask.pixels[i];
                // Of another region it says only what belongs to it, too.
                if odds > 0.0 || own(i) || (near[i] && self.region[i] == 0) {
                    let odds = odds.clamp(-BOUND, BOUND);
                    said[i] = Some(said[i].map_or(odds, |other| other.max(odds)));
                }
            }
        }
        said.into_iter().map(|said| said.unwrap_or(0.0)).collect()
    }

    /// That a mask is one.
    fn check(&self, FoundMask { odds, score }: &FoundMask) -> Result<()> {
        let (width, height) = (self.picture.width, self.picture.height);
        if (odds.width, odds.height, odds.channels) != (width, height, 1) {
            return Err(self.wrong(&format!(
                "a mask is {}×{} with {} channels; one channel of {width}×{height} was expected",
                odds.width, odds.height, odds.channels
            )));
        }
        match odds.pixels.iter().chain([score]).any(|value| value.is_nan()) {
            true => Err(self.wrong("a mask or its score is not a number")),
            false => Ok(()),
        }
    }

    fn wrong(&self, what: &str) -> Error {
        Error::Input(format!("the source of masks, asked for frame {}: {what}", self.number))
    }
}

/// Pixels that are a share of the width, one at least.
fn share(share: f64, width: usize) -> usize {
    (share * width as f64).round().max(1.0) as usize
}

fn probability(odds: f32) -> f32 {
    1.0 / (1.0 + (-odds).exp())
}

/// Means over squares that reach so far from each pixel, those at the border of what is within the picture.
fn means(values: &[f32], width: usize, reach: usize) -> Vec<f32> {
    let height = values.len() / width;
    let along = |from: &dyn Fn(usize) -> f32, i: usize, side: usize| {
        let range = i.saturating_sub(reach)..=(i + reach).min(side - 1);
        let n = range.clone().count() as f32;
        range.map(from).sum::<f32>() / n
    };
    let across: Vec<f32> = (0..values.len())
        .map(|i| along(&|x| values[i / width * width + x], i % width, width))
        .collect();
    (0..values.len())
        .map(|i| along(&|y| across[y * width + i % width], i / width, height))
        .collect()
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::super::cameras::Cameras;
    use super::super::masks::{Observed, segment};
    use super::super::residual::triangulate_frames;
    use super::super::sliding::{HEIGHT, WIDTH, centre, map, within, working};
    use super::super::{Observer, Options, Sources, track_observed};
    use super::*;
    use crate::data::synth::{self, SynthOptions};
    use crate::eval::mask_iou;
    use crate::observe::{SuppliedFlow, observe_flow};

    /// What a stand-in for a network draws.
    #[derive(Clone, Copy, Debug, PartialEq)]
    enum Draws {
        /// The thing a pixel too small or too large all around and with holes, beside what is wrong.
        Nearly,
        /// Discs about prompts, of any size.
        Blobs,
        Everything,
        Nothing,
        /// All but the thing.
        Inverted,
    }

    /// Knows the clip's truth, and draws of it.
    struct Standin<'a> {
        truth: &'a [Image],
        draws: Draws,
        /// Frames in which it was asked, and how often with a mask to begin with.
        asked: Vec<usize>,
        begun: usize,
    }

    impl Standin<'_> {
        fn new(truth: &[Image], draws: Draws) -> Standin<'_> {
            Standin { truth, draws, asked: Vec::new(), begun: 0 }
        }

        /// What the points on a thing point at.
        fn thing(&self, number: usize, query: &MaskQuery) -> Image {
            let truth = &self.truth[number];
            let width = truth.width as usize;
            let mut out = Image::new(truth.width, truth.height, 1);
            let inside = query.prompts.iter().filter(|prompt| prompt.inside);
            let hit: Vec<usize> =
                inside.map(|p| p.pixel.y as usize * width + p.pixel.x as usize).collect();
            for (region, _) in regions(&truth.pixels, width, true) {
                if hit.iter().any(|i| region.contains(i)) {
                    region.into_iter().for_each(|i| out.pixels[i] = 1.0);
                }
            }
            out
        }

        fn draw(&self, number: usize, query: &MaskQuery) -> Vec<Image> {
            let thing = self.thing(number, query);
            let everything = Image { pixels: vec![1.0; thing.pixels.len()], ..thing };
            let inverted = inverse(&thing);
            match self.draws {
                Draws::Nearly => {
                    let mut near = match number % 2 {
                        0 => inverse(&grown(&inverted, 1)),
                        _ => grown(&thing, 1),
                    };
                    for (i, value) in near.pixels.iter_mut().enumerate() {
                        let (x, y) = (i % thing.width as usize, i / thing.width as usize);
                        if (x + 3 * number) % 11 < 2 && y % 7 < 2 {
                            *value = 0.0;
                        }
                    }
                    vec![inverted, near, everything]
                }
                Draws::Blobs => (0..3).map(|k| blob(&thing, query, 3 * number + k)).collect(),
                Draws::Everything => vec![everything],
                Draws::Nothing => vec![inverse(&everything)],
                Draws::Inverted => vec![inverted],
            }
        }
    }

    impl MaskSource for Standin<'_> {
        fn masks(
            &mut self,
            number: usize,
            _frame: &Image,
            asked: &[MaskQuery],
        ) -> Result<Vec<Vec<FoundMask>>> {
            self.asked.push(number);
            self.begun += usize::from(asked.iter().any(|query| query.before.is_some()));
            let odds = |mask: Image| {
                let pixels = mask.pixels.iter().map(|value| 16.0 * value - 8.0).collect();
                FoundMask { odds: Image { pixels, ..mask }, score: 0.5 }
            };
            let drawn = |query| self.draw(number, query).into_iter().map(odds).collect();
            Ok(asked.iter().map(drawn).collect())
        }
    }

    fn inverse(mask: &Image) -> Image {
        Image { pixels: mask.pixels.iter().map(|value| 1.0 - value).collect(), ..*mask }
    }

    fn grown(mask: &Image, by: usize) -> Image {
        let pixels = mask.near(by).into_iter().map(|near| f32::from(u8::from(near))).collect();
        Image { pixels, ..*mask }
    }

    /// A disc near one of the prompts.
    fn blob(like: &Image, query: &MaskQuery, seed: usize) -> Image {
        let mut state = seed as u32 + 1;
        let mut random = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            f64::from(state >> 8) / f64::from(1 << 24)
        };
        random();
        let at = query.prompts[(random() * query.prompts.len() as f64) as usize].pixel;
        let radius = (0.03 + 0.2 * random()) * f64::from(like.width);
        let middle = at + radius * (DVec2::new(random(), random()) - 0.5);
        let inside = |i| super::centre(i, like.width as usize).distance(middle) < radius;
        let pixels = (0..like.pixels.len()).map(|i| f32::from(u8::from(inside(i)))).collect();
        Image { pixels, ..*like }
    }

    /// Puts parts away, and ends the work after so many of the source's frames.
    struct Keeps {
        parts: BTreeMap<String, Vec<u8>>,
        left: usize,
    }

    impl Observer for Keeps {
        fn progress(&mut self, _: Stage, _: f64) -> Result<()> {
            match self.left {
                0 => Err(Error::Interrupted { checkpoint: None }),
                _ => Ok(()),
            }
        }

        fn keeps(&self) -> bool {
            true
        }

        fn keep(&mut self, part: &str, value: Vec<u8>) -> Result<()> {
            self.left -= usize::from(part.contains("prompted"));
            self.parts.insert(part.into(), value);
            Ok(())
        }

        fn kept(&mut self, part: &str) -> Result<Option<Vec<u8>>> {
            Ok(self.parts.get(part).cloned())
        }
    }

    /// A small clip, its flow a little wrong.
    fn clip(name: &str, frames: usize, (width, height): (u32, u32)) -> (synth::Clip, SuppliedFlow) {
        let size = SynthOptions { frames, width, height, seed: 3 };
        let width = width as usize;
        let clip = synth::clip(name, &size).unwrap();
        let bent = |(k, flow): (usize, &Image)| {
            let mut out = flow.clone();
            for (i, v) in out.pixels.chunks_exact_mut(2).enumerate() {
                let (x, y) = ((i % width) as f32, (i / width) as f32);
                v[0] += 0.2 * (0.31 * x + 0.17 * y + k as f32).sin();
                v[1] += 0.2 * (0.23 * y - 0.29 * x + 2.0 * k as f32).cos();
            }
            out
        };
        let all = |fields: &[Image]| fields.iter().enumerate().map(bent).collect();
        let flow = SuppliedFlow::new(all(&clip.flow_forward), all(&clip.flow_backward)).unwrap();
        (clip, flow)
    }

    /// The clip's pixels judged against its true cameras, and the masks that this makes.
    fn judged<T>(
        clip: &synth::Clip,
        mut flow: SuppliedFlow,
        then: impl FnOnce(&Judged, &[Image]) -> T,
    ) -> T {
        let flow = observe_flow(&clip.frames, &mut flow, &mut |_| Ok(())).unwrap();
        let cameras = &Cameras::known(clip.intrinsics, clip.view_from_world.clone());
        working(|work| {
            let seen = triangulate_frames(cameras, &flow, work, "test", 0.0..0.5).unwrap();
            let observed = Observed { frames: &clip.frames, cameras, flow: &flow, seen: &seen };
            let judged = Judged::new(observed, None, work, "test", 0.5..0.6).unwrap();
            let masks = judged.segment(None, work, "test", 0.6..0.7).unwrap();
            assert_eq!(masks, segment(observed, None, work, "test", 0.5..0.7).unwrap());
            then(&judged, &masks)
        })
    }

    fn iou(masks: &[Image], truth: &[Image]) -> f64 {
        let all = masks.iter().zip(truth).map(|(mask, truth)| mask_iou(mask, truth).unwrap());
        all.sum::<f64>() / truth.len() as f64
    }

    #[test]
    fn good_masks_help_and_wrong_ones_do_no_harm() {
        let (clip, flow) = clip("walk", 8, (160, 90));
        judged(&clip, flow, |judged, masks| {
            let before = iou(masks, &clip.masks);
            let with = |draws| {
                let mut source = Standin::new(&clip.masks, draws);
                let (said, fused) = working(|work| {
                    let said = ask(judged, masks, &mut source, work, "test").unwrap();
                    let fused = judged.segment(Some(&said.odds), work, "test", 0.7..0.8).unwrap();
                    (said, fused)
                });
                assert!(source.asked.len() > 5, "{draws:?}: {:?}", source.asked);
                let after = iou(&fused, &clip.masks);
                eprintln!("{draws:?}: {} accepted, IoU {before:.3} to {after:.3}", said.accepted);
                (said.accepted, after, source.begun)
            };
            let (accepted, after, begun) = with(Draws::Nearly);
            assert!(accepted > 4 && begun > 2, "{accepted} {begun}");
            assert!(after > before + 0.005, "{before} {after}");
            for draws in [Draws::Blobs, Draws::Everything, Draws::Nothing, Draws::Inverted] {
                let (accepted, after, _) = with(draws);
                assert!(after > before - 0.02, "{draws:?}: {before} {after}");
                assert!(draws == Draws::Blobs || accepted == 0, "{draws:?}: {accepted}");
            }
        });
    }

    #[test]
    fn an_interrupted_run_asks_for_the_rest_alone() {
        let (clip, flow) = clip("walk", 6, (120, 68));
        judged(&clip, flow, |judged, masks| {
            let mut source = Standin::new(&clip.masks, Draws::Nearly);
            let whole = working(|work| ask(judged, masks, &mut source, work, "test").unwrap());
            let frames = source.asked;
            let mut observer = Keeps { parts: BTreeMap::new(), left: 3 };
            let mut source = Standin::new(&clip.masks, Draws::Nearly);
            let ended = ask(judged, masks, &mut source, &mut Work::new(&mut observer), "test");
            assert!(matches!(ended, Err(Error::Interrupted { .. })));
            observer.left = usize::MAX;
            let mut rest = Standin::new(&clip.masks, Draws::Nearly);
            let work = &mut Work::new(&mut observer);
            let resumed = ask(judged, masks, &mut rest, work, "test").unwrap();
            assert_eq!((resumed.odds, resumed.accepted), (whole.odds, whole.accepted));
            assert!(!source.asked.is_empty() && !rest.asked.is_empty());
            assert_eq!([source.asked, rest.asked].concat(), frames);
        });
    }

    #[test]
    fn what_the_user_supplies_wins() {
        let (clip, flow) = clip("rigid", 8, (120, 68));
        let run = |masks: Option<Vec<Image>>| {
            let options = Options {
                masks,
                lens: false,
                stereo: false,
                lift: false,
                rounds: 1,
                ..Options::default()
            };
            let mut source = Standin::new(&clip.masks, Draws::Nearly);
            let sources =
                Sources { flow: &mut flow.clone(), masks: Some(&mut source), features: None };
            let mut observer = Keeps { parts: BTreeMap::new(), left: usize::MAX };
            let track = track_observed(&clip.frames, &options, sources, &mut observer).unwrap();
            let note = track.quality.notes.into_iter().find(|note| note.starts_with("masks: "));
            (source.asked, note.unwrap())
        };
        let (asked, note) = run(Some(clip.masks.clone()));
        assert!(asked.is_empty() && note.contains("supplied"), "{asked:?} {note}");
        let (asked, note) = run(None);
        assert_eq!((asked.len(), &*note), (8, "masks: the network's accepted in 8 of 8 frames"));
    }

    /// A square of 20 × 20 pixels that moves, its left half most plainly, and what does not stand plainly to
    /// the right of it.
    fn square(p: DVec2) -> bool {
        within(p, (20.0, 10.0), (40.0, 30.0))
    }

    fn odds(p: DVec2) -> f32 {
        match (square(p), p.x) {
            (true, x) if x < 30.0 => 3.0,
            (true, _) => 1.0,
            (false, 40.0..46.0) => 0.0,
            (false, _) => -2.0,
        }
    }

    fn mask(of: impl Fn(DVec2) -> bool) -> Image {
        map(|p| if of(p) { 8.0 } else { -8.0 })
    }

    /// Runs with a frame that shows the square.
    fn with_square<T>(then: impl FnOnce(&Frame) -> T) -> T {
        let picture = Image::new(WIDTH, HEIGHT, 3);
        let moves = map(|p| f32::from(u8::from(square(p))));
        then(&Frame::new(0, &picture, map(odds).pixels, &moves))
    }

    #[test]
    fn points_are_where_motion_and_rest_are_plainest_and_keep_apart() {
        let prompts = with_square(|frame| frame.prompts(0));
        let kind = |inside| prompts.iter().filter(move |p| p.inside == inside).map(|p| p.pixel);
        assert_eq!((kind(true).count(), kind(false).count()), (POINTS, POINTS));
        for p in kind(true) {
            assert!(within(p, (20.0, 10.0), (30.0, 30.0)), "{p}");
        }
        for p in kind(false) {
            let about = within(p, (10.0, 0.0), (50.0, 40.0));
            assert!(about && !square(p) && !(40.0..46.0).contains(&p.x), "{p}");
        }
        for inside in [true, false] {
            for (i, p) in kind(inside).enumerate() {
                let nearest = kind(inside).skip(i + 1).map(|q| p.distance(q));
                assert!(nearest.fold(f64::MAX, f64::min) >= 0.05 * f64::from(WIDTH));
            }
        }
    }

    #[test]
    fn a_mask_is_believed_if_it_fits_what_moves() {
        with_square(|frame| {
            let fit = |of: &dyn Fn(DVec2) -> bool| frame.fit(0, &mask(of));
            let whole = fit(&square).unwrap();
            // By the expected shares: half of the pixels with log odds of 3, half with 1.
            let expected = 0.5 * f64::from(probability(3.0) + probability(1.0));
            assert!((whole - expected).abs() < 1e-6, "{whole} {expected}");
            // What is neither said to move nor to stand may belong to it, what stands lowers its fit.
            let wider = fit(&|p| within(p, (20.0, 10.0), (44.0, 30.0))).unwrap();
            let across = fit(&|p| within(p, (16.0, 10.0), (40.0, 30.0))).unwrap();
            assert!(whole > wider && wider > across, "{whole} {wider} {across}");
            let wrong: [&dyn Fn(DVec2) -> bool; 5] = [
                &|_| true,
                &|_| false,
                &|p| !square(p),
                &|p| within(p, (30.0, 10.0), (40.0, 30.0)),
                &|p| within(p, (0.0, 0.0), (20.0, 40.0)),
            ];
            for (k, wrong) in wrong.into_iter().enumerate() {
                assert_eq!(fit(wrong), None, "{k}");
            }
        });
    }

    #[test]
    fn what_a_mask_says_is_bounded_and_about_its_region() {
        with_square(|frame| {
            let said = frame.say(&[(0, mask(|p| within(p, (22.0, 10.0), (42.0, 30.0))))]);
            for (i, said) in said.iter().enumerate() {
                let p = centre(i);
                let expected = match p {
                    p if within(p, (22.0, 10.0), (42.0, 30.0)) => BOUND,
                    p if within(p, (18.0, 8.0), (44.0, 32.0)) => -BOUND,
                    _ => 0.0,
                };
                assert_eq!(*said, expected, "{p}");
            }
        });
    }

    #[test]
    fn masks_that_are_none_are_refused() {
        struct Wrong(Vec<Vec<FoundMask>>);
        impl MaskSource for Wrong {
            fn masks(
                &mut self,
                _: usize,
                _: &Image,
                _: &[MaskQuery],
            ) -> Result<Vec<Vec<FoundMask>>> {
                Ok(self.0.clone())
            }
        }
        let found = |odds, score| vec![vec![FoundMask { odds, score }]];
        let cases = [
            (Vec::new(), "asked for frame 0: 0 answers to 1 questions"),
            (found(Image::new(8, HEIGHT, 1), 0.0), "a mask is 8×40 with 1 channels"),
            (found(map(|_| f32::NAN), 0.0), "not a number"),
            (found(map(|_| 0.0), f32::NAN), "not a number"),
        ];
        for (answers, expected) in cases {
            let error = with_square(|frame| frame.ask(&mut Wrong(answers), &[]).err().unwrap());
            assert!(error.to_string().contains(expected), "{error}");
        }
    }
}
