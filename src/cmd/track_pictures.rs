//! Images for the page of `track`: frames with the outlines of movers, and residual flow.

use std::borrow::Cow;
use std::collections::BTreeMap;

use glam::DVec2;
use rayon::prelude::*;
use splat4d::Result;
use splat4d::data::images;
use splat4d::observe::{FlowPair, FlowSource};
use splat4d::track::Track;
use splat4d::types::Image;

use super::pictures::{address, brightest, heat, shrunk};

/// Maximum number of frames shown.
const MOST: usize = 12;
/// Maximum width of an image on the page, pixels.
const WIDEST: u32 = 400;
/// Minimum confidence of displayed flow.
const BELIEVED: f32 = 0.3;

/// Frames to show, evenly spread over a clip.
pub fn shown(frames: usize) -> Vec<usize> {
    let count = frames.min(MOST);
    let mut all: Vec<usize> = (0..count).map(|i| i * (frames - 1) / (count - 1).max(1)).collect();
    all.dedup();
    all
}

/// A flow source that keeps the flow from the displayed frames to the next one, and from the last frame to
/// the previous one.
pub struct Watched<'a> {
    source: Box<dyn FlowSource + 'a>,
    shown: Vec<usize>,
    last: usize,
    /// Per frame: flow (two channels) and its confidence.
    pub kept: BTreeMap<usize, (Image, Option<Image>)>,
}

impl<'a> Watched<'a> {
    /// Wraps the flow source of a clip with a number of frames.
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

/// A frame on the page: with outlines, and its residual flow, each as the URL of a JPEG.
pub struct Pictures {
    pub frame: usize,
    pub outlined: String,
    pub residual: String,
}

/// The images of all displayed frames, and the residual in pixels of the brightest colour.
pub fn draw(
    frames: &[Image],
    track: &Track,
    flow: &BTreeMap<usize, (Image, Option<Image>)>,
) -> Result<(Vec<Pictures>, f64)> {
    let residuals: Vec<(usize, Image)> =
        flow.par_iter().map(|(frame, field)| (*frame, residual(track, *frame, field))).collect();
    let most = brightest(residuals.iter().map(|(_, image)| image), 1.0);
    let pictures = residuals.par_iter().map(|(frame, residual)| {
        let small = shrunk(&frames[*frame], WIDEST);
        let mask = images::resize(&track.masks[*frame], small.width, small.height);
        Ok(Pictures {
            frame: *frame,
            outlined: address(&outlined(&small, &mask))?,
            residual: address(&shrunk(&heat(residual, most), WIDEST))?,
        })
    });
    Ok((pictures.collect::<Result<Vec<Pictures>>>()?, most))
}

/// Per pixel, difference between the flow and that of a static world, from depth and cameras; NaN where
/// either is unknown.
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

/// Draws movers with a light edge inside and a dark one outside, so that one of them is visible on any image.
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
        assert!(found.at(2, 0)[0] == 1.0 && found.at(3, 0)[0] == 1.0, "the image ends there");
    }
}
