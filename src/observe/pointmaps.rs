//! Pointmaps: the 3D point at each pixel of two frames, in the camera frame of the first (Wang et al.,
//! "DUSt3R", CVPR 2024), gathered over a clip.
//!
//! Frames are paired with neighbours at odd distances ([`pairs`], the graph that MonST3R calls
//! `swinstride`), each pair in both directions. A grid of points of each map is kept for the alignment
//! ([`super::alignment`]). Depth is kept as one full map per frame: the depth maps of a frame's pairs
//! differ by a factor each, which is removed before they are averaged by confidence. Memory therefore holds
//! a window of frames and one depth map per frame.

use glam::{DVec2, DVec3};

use super::{EstimatedDepth, EstimatedKind};
use crate::types::Image;
use crate::{Error, Result};

/// Position of a network's input image within a frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Placement {
    /// Width and height of the frame.
    pub frame: (u32, u32),
    /// Width and height of the network's input image.
    pub picture: (u32, u32),
    /// Frame pixels per pixel of the input image, along x and y.
    pub scale: DVec2,
    /// Position of the input image's corner in the frame, pixels.
    pub corner: DVec2,
}

impl Placement {
    /// Placement of an input image that is the frame itself.
    pub fn whole(width: u32, height: u32) -> Placement {
        let frame = (width, height);
        Placement { frame, picture: frame, scale: DVec2::ONE, corner: DVec2::ZERO }
    }

    /// Converts a position in the input image to one in the frame.
    pub fn frame_from_picture(&self, at: DVec2) -> DVec2 {
        self.scale * at + self.corner
    }

    /// Converts a position in the frame to one in the input image.
    pub fn picture_from_frame(&self, at: DVec2) -> DVec2 {
        (at - self.corner) / self.scale
    }

    /// The placement with x and y exchanged.
    pub fn transposed(&self) -> Placement {
        let swapped = |(a, b): (u32, u32)| (b, a);
        Placement {
            frame: swapped(self.frame),
            picture: swapped(self.picture),
            scale: DVec2::new(self.scale.y, self.scale.x),
            corner: DVec2::new(self.corner.y, self.corner.x),
        }
    }

    /// The centre of the input image, which networks take for the principal point, in pixels of the frame.
    pub fn middle(&self) -> DVec2 {
        let (width, height) = self.picture;
        self.frame_from_picture(0.5 * DVec2::new(width.into(), height.into()))
    }

    /// Resamples a one-channel map of the input image to the size of the frame; NaN outside the input image.
    fn at_frame_size(&self, map: &[f32]) -> Image {
        let mut out = Image::new(self.frame.0, self.frame.1, 1);
        let (columns, rows) = self.picture;
        for y in 0..self.frame.1 {
            for x in 0..self.frame.0 {
                let centre = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
                let at = self.picture_from_frame(centre).floor();
                let end = DVec2::new(columns.into(), rows.into());
                let inside = at.cmpge(DVec2::ZERO).all() && at.cmplt(end).all();
                let place = at.y as usize * columns as usize + at.x as usize;
                out.at_mut(x, y)[0] = if inside { map[place] } else { f32::NAN };
            }
        }
        out
    }
}

/// Pointmaps of a pair of frames, in pixels of the network's input image.
#[derive(Clone, Debug)]
pub struct PairMaps {
    /// Three channels per frame: the point that each pixel shows, in the camera frame of the first, in a
    /// unit specific to the pair.
    pub points: [Image; 2],
    /// One channel per frame: confidence of each point, 1 (none) or more.
    pub confidence: [Image; 2],
}

/// A source of pointmaps for a clip.
pub trait PointmapSource {
    /// Position of all input images within their frames.
    fn placement(&self) -> Placement;

    /// Pointmaps of two frames, in the camera frame of the first.
    ///
    /// # Errors
    /// Whatever keeps the source from answering.
    fn pair(&mut self, first: usize, second: usize) -> Result<PairMaps>;

    /// Called when no frame before this one will be requested any more.
    fn forget(&mut self, _before: usize) {}
}

/// Maximum number of preceding frames that a frame is paired with.
const WINDOW: usize = 5;
/// Number of grid points for the alignment along the longer side of an image.
const GRID: u32 = 28;
/// Depth with less confidence is unknown.
const BELIEVED: f32 = 1.1;
/// Two depth maps are compared at this many pixels, or up to twice as many.
const SAMPLES: usize = 4096;
/// Bounds of the confidence threshold for alignment points; the threshold is the median of the map.
const CONFIDENT: [f64; 2] = [1.1, 3.0];
/// Share of a map's depths that counts as near.
const NEAR: f64 = 0.95;

/// Distances of paired frames: odd ones, fewer in a short clip.
pub fn distances(frames: usize) -> Vec<usize> {
    let window = WINDOW.min(frames.saturating_sub(1).div_ceil(2));
    (0..window).map(|k| 2 * k + 1).collect()
}

/// Pairs of frames, the earlier one first, ordered by the later one.
pub fn pairs(frames: usize) -> impl Iterator<Item = (usize, usize)> {
    let distances = distances(frames);
    (0..frames).flat_map(move |later| {
        let earlier = distances.clone().into_iter().filter_map(move |d| later.checked_sub(d));
        earlier.map(move |earlier| (earlier, later))
    })
}

/// Points of one image of a pair at the grid points.
#[derive(Clone, Debug)]
pub(super) struct View {
    /// In the camera frame of the pair's first frame.
    pub points: Vec<DVec3>,
    /// Logarithm of the confidence; 0 for points that are not used: far ones, those with little confidence,
    /// and those outside the frame.
    pub weights: Vec<f64>,
}

/// A pair of frames in one direction.
#[derive(Clone, Debug)]
pub(super) struct Pair {
    /// The frame whose camera the points are in, and the other one.
    pub frames: [usize; 2],
    /// The points of each frame.
    pub views: [View; 2],
    /// Product of the mean confidences.
    pub score: f64,
}

/// The pointmaps of a clip.
#[derive(Clone, Debug)]
pub struct Pointmaps {
    /// Position of the input images within the frames.
    pub(super) placement: Placement,
    /// Number of frames.
    pub(super) frames: usize,
    /// Grid points, in pixels of the frames.
    pub(super) pixels: Vec<DVec2>,
    /// Each pair in one direction, then in the other.
    pub(super) pairs: Vec<Pair>,
    /// Per frame, at its size: z up to a factor per frame, NaN where unknown.
    pub(super) depth: Vec<Image>,
    /// Per frame, at its size: confidence of that depth, 0 where unknown.
    pub(super) confidence: Vec<Image>,
}

impl Pointmaps {
    /// Gathers all pairs of a clip from a source; `progress` is called with the share done.
    ///
    /// # Errors
    /// Fewer than two frames; maps that do not have the size of the input image; errors of the source and
    /// of `progress`.
    pub fn gather(
        source: &mut dyn PointmapSource,
        frames: usize,
        progress: &mut dyn FnMut(f64) -> Result<()>,
    ) -> Result<Pointmaps> {
        if frames < 2 {
            let what = format!("pointmaps are of two frames at least, {frames} given");
            return Err(Error::Input(what));
        }
        let placement = source.placement();
        let places = places(placement.picture);
        let pixel = |(x, y): &(u32, u32)| {
            placement.frame_from_picture(DVec2::new(f64::from(*x) + 0.5, f64::from(*y) + 0.5))
        };
        let pixels: Vec<DVec2> = places.iter().map(pixel).collect();
        let reach = distances(frames).last().copied().unwrap_or(1);
        let count = self::pairs(frames).count();
        let (mut pairs, mut fused) = (Vec::new(), vec![Fused::default(); frames]);
        let mut depth = Vec::with_capacity(frames);
        let mut confidence = Vec::with_capacity(frames);
        for (first, second) in self::pairs(frames) {
            // Frames that no later frame is paired with are finished.
            while depth.len() + reach < second {
                let done = std::mem::take(&mut fused[depth.len()]);
                confidence.push(done.confidence(&placement));
                depth.push(done.map(&placement));
                source.forget(depth.len());
            }
            for frames in [[first, second], [second, first]] {
                let maps = source.pair(frames[0], frames[1])?;
                check(&maps, placement.picture)?;
                fused[frames[0]].add(&maps.points[0], &maps.confidence[0]);
                let mean = |map: &Image| {
                    let sum: f64 = map.pixels.iter().map(|c| f64::from(*c)).sum();
                    sum / map.pixels.len() as f64
                };
                let view = |k: usize| view(&maps, k, &places, &pixels, placement.frame);
                let score = mean(&maps.confidence[0]) * mean(&maps.confidence[1]);
                pairs.push(Pair { frames, views: [view(0), view(1)], score });
            }
            progress(pairs.len() as f64 / (2 * count) as f64)?;
        }
        for fused in fused.drain(depth.len()..) {
            confidence.push(fused.confidence(&placement));
            depth.push(fused.map(&placement));
        }
        Ok(Pointmaps { placement, frames, pixels, pairs, depth, confidence })
    }

    /// The depth of the frames, each multiplied by its factor.
    pub fn into_depth(self, factors: &[f64]) -> EstimatedDepth {
        let scaled = |(mut map, factor): (Image, &f64)| {
            map.pixels.iter_mut().for_each(|z| *z *= *factor as f32);
            map
        };
        let maps = self.depth.into_iter().zip(factors).map(scaled).collect();
        EstimatedDepth { maps, kind: EstimatedKind::Depth, confidence: Some(self.confidence) }
    }
}

/// Grid points in pixels of the input image.
fn places((width, height): (u32, u32)) -> Vec<(u32, u32)> {
    let spacing = (f64::from(width.max(height)) / f64::from(GRID)).max(1.0);
    let along = |side: u32| {
        let count = (f64::from(side) / spacing) as u32;
        (0..count.max(1)).map(move |k| (((f64::from(k) + 0.5) * spacing) as u32).min(side - 1))
    };
    along(height).flat_map(|y| along(width).map(move |x| (x, y))).collect()
}

/// Checks that maps have the size of the input image.
fn check(maps: &PairMaps, (width, height): (u32, u32)) -> Result<()> {
    let all = maps.points.iter().map(|m| (m, 3)).chain(maps.confidence.iter().map(|m| (m, 1)));
    for (map, channels) in all {
        if (map.width, map.height, map.channels) != (width, height, channels) {
            return Err(Error::Input(format!(
                "a pointmap is {}×{} with {} channels, of images of {width}×{height}; {channels} channels of that \
                 size were expected",
                map.width, map.height, map.channels
            )));
        }
    }
    Ok(())
}

/// The confident and near points of one image, for the alignment.
fn view(
    maps: &PairMaps,
    k: usize,
    places: &[(u32, u32)],
    pixels: &[DVec2],
    frame: (u32, u32),
) -> View {
    let point = |(x, y): &(u32, u32)| {
        let at = maps.points[k].at(*x, *y);
        DVec3::new(at[0].into(), at[1].into(), at[2].into())
    };
    let points: Vec<DVec3> = places.iter().map(point).collect();
    let confidence: Vec<f64> =
        places.iter().map(|(x, y)| f64::from(maps.confidence[k].at(*x, *y)[0])).collect();
    let least = quantile(confidence.clone(), 0.5).clamp(CONFIDENT[0], CONFIDENT[1]);
    let confident = |i: &usize| confidence[*i] >= least;
    let depths = (0..points.len()).filter(confident).map(|i| points[i].z).collect();
    let far = quantile(depths, NEAR);
    let end = DVec2::new(frame.0.into(), frame.1.into());
    let weight = |i: usize| {
        let inside = pixels[i].cmpge(DVec2::ZERO).all() && pixels[i].cmplt(end).all();
        // The camera's own points lie in front of it; the second camera may see points behind the first.
        let before = points[i].z > 0.0 || k == 1;
        let used = inside && before && confident(&i) && points[i].z <= far;
        if used { confidence[i].ln() } else { 0.0 }
    };
    let weights = (0..points.len()).map(weight).collect();
    View { points, weights }
}

/// The average of the depth maps of a frame's pairs: per pixel, the sum of the weights (logarithms of
/// confidence), the weighted sum of log depths, and their number.
#[derive(Clone, Debug, Default)]
struct Fused(Vec<(f32, f32, u16)>);

impl Fused {
    /// Adds another map, which has its own unit.
    fn add(&mut self, points: &Image, confidence: &Image) {
        let count = confidence.pixels.len();
        self.0.resize(count, (0.0, 0.0, 0));
        let logarithm = |i: usize| {
            let z = points.pixels[3 * i + 2];
            (z > 0.0 && confidence.pixels[i] >= BELIEVED).then(|| z.ln())
        };
        // The scale factor relative to the depth so far, as a median.
        let stride = (count / SAMPLES).max(1);
        let offset = |i: usize| {
            let (weight, sum, _) = self.0[i];
            logarithm(i).filter(|_| weight > 0.0).map(|log| f64::from(sum / weight - log))
        };
        let offset = quantile((0..count).step_by(stride).filter_map(offset).collect(), 0.5) as f32;
        for (i, (total, sum, maps)) in self.0.iter_mut().enumerate() {
            let Some(log) = logarithm(i) else { continue };
            let weight = confidence.pixels[i].ln();
            *total += weight;
            *sum += weight * (log + offset);
            *maps += 1;
        }
    }

    /// Confidence of the map at the size of the frame: the geometric mean of the confidences.
    fn confidence(&self, placement: &Placement) -> Image {
        let mean = |(weight, _, maps): &(f32, f32, u16)| {
            if *maps > 0 { (weight / f32::from(*maps)).exp() } else { 0.0 }
        };
        let map: Vec<f32> = self.0.iter().map(mean).collect();
        let mut out = placement.at_frame_size(&map);
        out.pixels.iter_mut().filter(|c| c.is_nan()).for_each(|c| *c = 0.0);
        out
    }

    /// The depth map at the size of the frame.
    fn map(self, placement: &Placement) -> Image {
        let depth = |(weight, sum, _): &(f32, f32, u16)| {
            if *weight > 0.0 { (sum / weight).exp() } else { f32::NAN }
        };
        let map: Vec<f32> = self.0.iter().map(depth).collect();
        placement.at_frame_size(&map)
    }
}

/// The quantile `share` of the values; 0 without values.
pub(super) fn quantile(mut values: Vec<f64>, share: f64) -> f64 {
    if values.is_empty() {
        return 0.0;
    }
    let place = ((values.len() - 1) as f64 * share).round() as usize;
    *values.select_nth_unstable_by(place, f64::total_cmp).1
}
