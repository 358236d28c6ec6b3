//! Pictures for the page of `track`: frames with the outlines of what moves, and residual flow.

use std::borrow::Cow;
use std::collections::BTreeMap;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use glam::DVec2;
use image::codecs::jpeg::JpegEncoder;
use image::{ExtendedColorType, ImageEncoder};
use rayon::prelude::*;
use splat4d::data::images;
use splat4d::observe::{FlowPair, FlowSource};
use splat4d::track::Track;
use splat4d::types::Image;
use splat4d::{Error, Result};

/// At most so many frames are shown.
const MOST: usize = 12;
/// A picture on the page is at most so wide.
const WIDEST: u32 = 400;
/// Of JPEG.
const QUALITY: u8 = 82;
/// Flow that is believed less is not shown.
const BELIEVED: f32 = 0.3;
/// Where flow is not believed.
const UNKNOWN: [f32; 3] = [0.5; 3];

/// Frames to show, evenly spread over a clip.
pub fn shown(frames: usize) -> Vec<usize> {
    let count = frames.min(MOST);
    let mut all: Vec<usize> = (0..count).map(|i| i * (frames - 1) / (count - 1).max(1)).collect();
    all.dedup();
    all
}

/// A source of flow that keeps what leads from the frames that are shown to the next, from the last frame
/// to the one before.
pub struct Watched<'a> {
    source: Box<dyn FlowSource + 'a>,
    shown: Vec<usize>,
    last: usize,
    /// By frame: where its pixels go, two channels, and how far that is believed.
    pub kept: BTreeMap<usize, (Image, Option<Image>)>,
}

impl<'a> Watched<'a> {
    /// Of a clip of so many frames.
    pub fn new(source: Box<dyn FlowSource + 'a>, frames: usize) -> Watched<'a> {
        let last = frames.saturating_sub(1);
        Watched { source, shown: shown(frames), last, kept: BTreeMap::new() }
    }
}

impl FlowSource for Watched<'_> {
    fn pair(&mut self, first: usize) -> Result<FlowPair> {
        let pair = self.source.pair(first)?;
        if self.shown.contains(&first) {
            let field = (pair.forward.clone(), pair.forward_confidence.clone());
            self.kept.insert(first, field);
        }
        if first + 1 == self.last {
            let field = (pair.backward.clone(), pair.backward_confidence.clone());
            self.kept.insert(self.last, field);
        }
        Ok(pair)
    }

    fn is_costly(&self) -> bool {
        self.source.is_costly()
    }

    fn known(&mut self, first: usize, pair: &FlowPair) {
        self.source.known(first, pair);
    }
}

/// A frame as the page shows it: with outlines, and its residual flow, each as the address of a JPEG.
pub struct Pictures {
    pub frame: usize,
    pub outlined: String,
    pub residual: String,
}

/// The pictures of all frames that are shown, and the residual, in pixels, that the brightest colour
/// stands for.
pub fn draw(
    frames: &[Image],
    track: &Track,
    flow: &BTreeMap<usize, (Image, Option<Image>)>,
) -> Result<(Vec<Pictures>, f64)> {
    let residuals: Vec<(usize, Image)> =
        flow.par_iter().map(|(frame, field)| (*frame, residual(track, *frame, field))).collect();
    let most = brightest(residuals.iter().map(|(_, image)| image));
    let pictures = residuals.par_iter().map(|(frame, residual)| {
        let small = shrunk(&frames[*frame]);
        let mask = images::resize(&track.masks[*frame], small.width, small.height);
        Ok(Pictures {
            frame: *frame,
            outlined: address(&outlined(&small, &mask))?,
            residual: address(&shrunk(&heat(residual, most)))?,
        })
    });
    Ok((pictures.collect::<Result<Vec<Pictures>>>()?, most))
}

/// By pixel, how far flow is from that of a world that stands still, by depth and cameras; not a number where
/// either is not known.
fn residual(track: &Track, frame: usize, filmed: &(Image, Option<Image>)) -> Image {
    let (flow, believed) = match &track.lens {
        None => (Cow::Borrowed(&filmed.0), Cow::Borrowed(&filmed.1)),
        Some(lens) => {
            let undistorted = |map: &Image| lens.undistort(map, &track.intrinsics).0;
            let flow = lens.undistort_flow(&filmed.0, &track.intrinsics);
            (Cow::Owned(flow), Cow::Owned(filmed.1.as_ref().map(undistorted)))
        }
    };
    let last = track.view_from_world.len() - 1;
    let other = if frame < last { frame + 1 } else { last.saturating_sub(1) };
    let relative = track.view_from_world[other] * track.view_from_world[frame].inverse();
    let (k, depth) = (&track.intrinsics, &track.depth[frame]);
    let mut out = Image::new(depth.width, depth.height, 1);
    for y in 0..out.height {
        for x in 0..out.width {
            let pixel = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
            let there = relative.apply(k.ray(pixel) * f64::from(depth.at(x, y)[0]));
            let moved = flow.at(x, y);
            let sure = believed.as_ref().as_ref().is_none_or(|sure| sure.at(x, y)[0] >= BELIEVED);
            let known = sure && there.z > 0.0;
            let expected = k.project(there) - pixel;
            let off = DVec2::new(moved[0].into(), moved[1].into()).distance(expected);
            out.at_mut(x, y)[0] = if known { off as f32 } else { f32::NAN };
        }
    }
    out
}

/// A round number that nearly all residuals lie below, 1 px at least.
fn brightest<'a>(residuals: impl Iterator<Item = &'a Image>) -> f64 {
    let mut all: Vec<f32> = residuals
        .flat_map(|image| image.pixels.iter().copied().step_by(7).filter(|v| v.is_finite()))
        .collect();
    let at = all.len().saturating_sub(1) * 99 / 100;
    let most = match all.is_empty() {
        true => 1.0,
        false => f64::from(*all.select_nth_unstable_by(at, f32::total_cmp).1).max(1.0),
    };
    let power = 10f64.powf(most.log10().floor());
    [1.0, 2.0, 5.0, 10.0].map(|m| m * power).into_iter().find(|m| *m >= most).unwrap_or(most)
}

/// The colours of a residual from none to the brightest: ever lighter, so that no colour need be told
/// from another.
pub const HEAT: [[f32; 3]; 6] = [
    [0.0, 0.0, 0.05],
    [0.26, 0.04, 0.41],
    [0.58, 0.15, 0.40],
    [0.87, 0.32, 0.23],
    [0.99, 0.65, 0.04],
    [0.99, 1.0, 0.64],
];

fn heat(residual: &Image, most: f64) -> Image {
    let mut out = Image::new(residual.width, residual.height, 3);
    for (to, value) in out.pixels.chunks_exact_mut(3).zip(&residual.pixels) {
        if value.is_nan() {
            to.copy_from_slice(&UNKNOWN);
            continue;
        }
        let at = (value / most as f32).clamp(0.0, 1.0) * (HEAT.len() - 1) as f32;
        let low = (at as usize).min(HEAT.len() - 2);
        let share = at - low as f32;
        for c in 0..3 {
            to[c] = HEAT[low][c] * (1.0 - share) + HEAT[low + 1][c] * share;
        }
    }
    out
}

/// What moves gets a light edge inside and a dark one outside: one of them shows on any picture.
fn outlined(image: &Image, mask: &Image) -> Image {
    let moves = |x: i64, y: i64| {
        let inside = x >= 0 && y >= 0 && x < i64::from(mask.width) && y < i64::from(mask.height);
        inside && mask.at(x as u32, y as u32)[0] > 0.5
    };
    let mut out = image.clone();
    for y in 0..image.height {
        for x in 0..image.width {
            let (i, j) = (i64::from(x), i64::from(y));
            let here = moves(i, j);
            let steps = [(1, 0), (-1, 0), (0, 1), (0, -1)];
            if steps.iter().any(|(dx, dy)| moves(i + dx, j + dy) != here) {
                let colour = if here { [1.0, 0.86, 0.1] } else { [0.0; 3] };
                out.at_mut(x, y).copy_from_slice(&colour);
            }
        }
    }
    out
}

fn shrunk(image: &Image) -> Image {
    let width = image.width.min(WIDEST);
    let height =
        (u64::from(image.height) * u64::from(width) / u64::from(image.width.max(1))).max(1);
    images::resize(image, width, height as u32)
}

/// A picture as a `data:` address.
fn address(image: &Image) -> Result<String> {
    let bytes: Vec<u8> =
        image.pixels.iter().map(|v| (v.clamp(0.0, 1.0) * 255.0).round() as u8).collect();
    let mut jpeg = Vec::new();
    JpegEncoder::new_with_quality(&mut jpeg, QUALITY)
        .write_image(&bytes, image.width, image.height, ExtendedColorType::Rgb8)
        .map_err(|error| Error::Failed(format!("a picture could not be encoded: {error}")))?;
    Ok(format!("data:image/jpeg;base64,{}", STANDARD.encode(jpeg)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_are_spread_over_the_clip() {
        assert_eq!(shown(3), [0, 1, 2]);
        let many = shown(500);
        assert!(many.len() == MOST && many[0] == 0 && many[MOST - 1] == 499, "{many:?}");
    }

    #[test]
    fn outlines_lie_on_both_sides_of_an_edge() {
        let grey = Image { width: 4, height: 1, channels: 3, pixels: vec![0.5; 12] };
        let mask = Image { width: 4, height: 1, channels: 1, pixels: vec![0.0, 0.0, 0.9, 0.9] };
        let found = outlined(&grey, &mask);
        assert_eq!(found.at(0, 0), [0.5; 3]);
        assert_eq!(found.at(1, 0), [0.0; 3]);
        assert!(found.at(2, 0)[0] == 1.0 && found.at(3, 0)[0] == 1.0, "the picture ends there");
    }

    #[test]
    fn more_residual_is_lighter() {
        let residual =
            Image { width: 5, height: 1, channels: 1, pixels: vec![0.0, 1.0, 3.0, 9.0, f32::NAN] };
        let drawn = heat(&residual, 5.0);
        let light = |x: u32| drawn.at(x, 0).iter().sum::<f32>();
        assert!(light(0) < light(1) && light(1) < light(2) && light(2) < light(3));
        assert_eq!(drawn.at(4, 0), UNKNOWN);
        let even = Image { width: 70, height: 1, channels: 1, pixels: vec![3.7; 70] };
        assert_eq!(brightest([&even].into_iter()), 5.0);
        assert_eq!(brightest(std::iter::empty()), 1.0);
    }
}
