//! Motion masks with the help of a segmentation network (the source) that draws the object at prompted
//! points.
//!
//! The residuals determine what moves. A network knows better where exactly a mover ends, and which of its
//! inner pixels belong to it although they leave no residual. Each mask region is queried with points: on the
//! region where motion is most certain, and beside it where the static world explains the images best. Of the
//! masks that the source returns, the one that fits the region best is used, if it moves more than the static
//! world and does not cover what is certainly static. Its log odds are bounded and added to those of motion,
//! so that they do not overrule strong evidence.

mod judge;
mod points;

use glam::DVec2;
use serde::{Deserialize, Serialize};

use super::Stage;
use super::masks::{Judged, regions};
use super::observer::{Work, numbered};
use crate::observe::{EstimatedDepth, MaskQuery, MaskSource, NeighbourFlow};
use crate::types::Image;
use crate::{Error, Result};

/// Radius over which the odds of a point are averaged, as a share of the image width.
const ABOUT: f64 = 0.01;
/// Distance from a region, as a share of the image width, within which its mask affects the odds of other
/// pixels.
const MARGIN: f64 = 0.03;
/// Maximum number of regions of a frame that are queried, the largest ones.
const REGIONS: usize = 8;
/// Bound of the log odds that are passed on to the next frame.
const HANDED: f32 = 16.0;

/// The evidence of a source's masks for a clip.
pub(super) struct Prompted {
    /// Log odds by frame and pixel, to be added to those of motion.
    pub odds: Vec<Vec<f32>>,
    /// Number of frames in which a mask was accepted.
    pub accepted: usize,
}

/// The evidence of a source's masks for a frame.
#[derive(Serialize, Deserialize)]
struct Said {
    /// Log odds by pixel, to be added to those of motion.
    odds: Vec<f32>,
    /// Log odds of each mask that was accepted.
    accepted: Vec<Image>,
}

/// Queries a source for the movers in `masks`, frame by frame. If estimated depth has confidence, prompts are
/// limited to confident and near pixels where there are any.
///
/// # Errors
/// What the source or the observer of `work` returns; masks of a size other than the frames', or with NaN
/// values.
pub(super) fn ask(
    judged: &Judged,
    masks: &[Image],
    depth: Option<&EstimatedDepth>,
    source: &mut dyn MaskSource,
    work: &mut Work,
    part: &str,
) -> Result<Prompted> {
    let mut out = Prompted { odds: Vec::with_capacity(masks.len()), accepted: 0 };
    let mut before = Vec::new();
    for (number, mask) in masks.iter().enumerate() {
        let said = work.part(&numbered(&format!("{part}/prompted"), number), |_| {
            let picture = &judged.observed.frames[number];
            let frame = Frame::new(number, picture, judged.gathered[number].clone(), mask);
            let frame = Frame { sure: depth.and_then(|depth| depth.sure(number)), ..frame };
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

/// A mask of the previous frame, warped to this one; 0 where the flow is unknown.
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

/// A frame and the evidence of its motion.
#[derive(Clone)]
struct Frame<'a> {
    number: usize,
    picture: &'a Image,
    width: usize,
    /// Log odds of motion by pixel.
    odds: Vec<f32>,
    /// Means of `odds` around each pixel.
    means: Vec<f32>,
    /// By pixel, the index of its region plus one; 0 outside.
    region: Vec<usize>,
    /// Pixels of each region.
    regions: Vec<Vec<usize>>,
    /// Whether each pixel may be used as a prompt; `None` if all may.
    sure: Option<Vec<bool>>,
    /// Mean and standard deviation of the probability of motion where nothing moves.
    level: (f64, f64),
}

impl<'a> Frame<'a> {
    /// A frame from the log odds of motion of its pixels, and the mask that was made from them.
    fn new(number: usize, picture: &'a Image, odds: Vec<f32>, mask: &Image) -> Frame<'a> {
        let width = mask.width as usize;
        let mut found: Vec<Vec<usize>> =
            regions(&mask.pixels, width, true).into_iter().map(|(region, _)| region).collect();
        // The sort is stable: of two regions of the same size the upper one comes first.
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
            sure: None,
            level: (mean, variance.sqrt()),
        }
    }

    /// Queries all regions. `handed` are the masks that were accepted in the previous frame, warped to this
    /// one.
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

    fn wrong(&self, what: &str) -> Error {
        Error::Input(format!("the source of masks, asked for frame {}: {what}", self.number))
    }
}

/// A share of the width in pixels, at least one.
fn share(share: f64, width: usize) -> usize {
    (share * width as f64).round().max(1.0) as usize
}

fn probability(odds: f32) -> f32 {
    1.0 / (1.0 + (-odds).exp())
}

/// Means over squares with the half-side `reach` around each pixel; at the border, over the part inside the
/// image.
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
mod tests;
