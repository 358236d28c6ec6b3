//! Pointmaps: what each pixel of two frames shows, as points in the camera of the first (Wang et al., "DUSt3R",
//! CVPR 2024), gathered over a clip.
//!
//! Frames are paired with neighbours at odd distances ([`pairs`], the graph that MonST3R calls `swinstride`), each pair
//! both ways. Of each map a grid of points is kept for the alignment ([`super::alignment`]); depth is kept whole, one
//! map a frame: those of a frame's pairs differ by a factor each, which is taken off, and are averaged by their
//! confidence. So memory is that of a window of frames and of one depth map each.

use glam::{DVec2, DVec3};

use super::{EstimatedDepth, EstimatedKind};
use crate::types::Image;
use crate::{Error, Result};

/// How the pixels of a network's picture lie in a frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Placement {
    /// Width and height of the frame.
    pub frame: (u32, u32),
    /// Width and height of the picture.
    pub picture: (u32, u32),
    /// Pixels of the frame in a pixel of the picture.
    pub scale: DVec2,
    /// Where in the frame the picture's corner lies.
    pub corner: DVec2,
}

impl Placement {
    /// A picture that is the frame itself.
    pub fn whole(width: u32, height: u32) -> Placement {
        let frame = (width, height);
        Placement { frame, picture: frame, scale: DVec2::ONE, corner: DVec2::ZERO }
    }

    /// A place in the picture as one in the frame.
    pub fn frame_from_picture(&self, at: DVec2) -> DVec2 {
        self.scale * at + self.corner
    }

    /// A place in the frame as one in the picture.
    pub fn picture_from_frame(&self, at: DVec2) -> DVec2 {
        (at - self.corner) / self.scale
    }

    /// That of frame and picture with x and y exchanged.
    pub fn transposed(&self) -> Placement {
        let swapped = |(a, b): (u32, u32)| (b, a);
        Placement {
            frame: swapped(self.frame),
            picture: swapped(self.picture),
            scale: DVec2::new(self.scale.y, self.scale.x),
            corner: DVec2::new(self.corner.y, self.corner.x),
        }
    }

    /// The middle of the picture, which networks take for the principal point, in the frame.
    pub fn middle(&self) -> DVec2 {
        let (width, height) = self.picture;
        self.frame_from_picture(0.5 * DVec2::new(width.into(), height.into()))
    }

    /// A map of the picture, one channel, at the size of the frame; not a number beyond the picture.
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

/// What a pair of frames shows, in pixels of the network's picture.
#[derive(Clone, Debug)]
pub struct PairMaps {
    /// Three channels: of each pixel of the first and of the second picture, the point that it shows, in the camera of
    /// the first, in a unit of the pair's own.
    pub points: [Image; 2],
    /// One channel: how far each is to be believed, 1 or more, 1 not at all.
    pub confidence: [Image; 2],
}

/// Something that knows the pointmaps of a clip.
pub trait PointmapSource {
    /// How all pictures lie in their frames.
    fn placement(&self) -> Placement;

    /// What two frames show, in the camera of the first.
    ///
    /// # Errors
    /// Whatever keeps the source from answering.
    fn pair(&mut self, first: usize, second: usize) -> Result<PairMaps>;

    /// Told that no frame before this one is asked for any more.
    fn forget(&mut self, _before: usize) {}
}

/// Frames are paired with at most so many of those before.
const WINDOW: usize = 5;
/// Points along the longer side of a picture that are aligned.
const GRID: u32 = 28;
/// Depth of less confidence is unknown.
const BELIEVED: f32 = 1.1;
/// Two depth maps are compared at so many pixels, or twice that.
const SAMPLES: usize = 4096;
/// Points for the alignment are of the confidence that half of a map reach, but for these bounds.
const CONFIDENT: [f64; 2] = [1.1, 3.0];
/// The share of a map's depths that is near.
const NEAR: f64 = 0.95;

/// Distances of the frames that are paired: odd ones, fewer in a short clip.
pub fn distances(frames: usize) -> Vec<usize> {
    let window = WINDOW.min(frames.saturating_sub(1).div_ceil(2));
    (0..window).map(|k| 2 * k + 1).collect()
}

/// Frames that are paired, the earlier one first, by the later one.
pub fn pairs(frames: usize) -> impl Iterator<Item = (usize, usize)> {
    let distances = distances(frames);
    (0..frames).flat_map(move |later| {
        let earlier = distances.clone().into_iter().filter_map(move |d| later.checked_sub(d));
        earlier.map(move |earlier| (earlier, later))
    })
}

/// Points of one picture of a pair at the places of the grid.
#[derive(Clone, Debug)]
pub(super) struct View {
    /// In the camera of the pair's first frame.
    pub points: Vec<DVec3>,
    /// The logarithm of the confidence; 0 of what is not used: far, of little confidence, beside the frame.
    pub weights: Vec<f64>,
}

/// A pair of frames, one way.
#[derive(Clone, Debug)]
pub(super) struct Pair {
    /// The frame whose camera it is, and the other one.
    pub frames: [usize; 2],
    /// What each shows.
    pub views: [View; 2],
    /// Product of the mean confidences.
    pub score: f64,
}

/// The pointmaps of a clip.
#[derive(Clone, Debug)]
pub struct Pointmaps {
    /// How the pictures lie in the frames.
    pub(super) placement: Placement,
    /// Number of frames.
    pub(super) frames: usize,
    /// Places of the grid, in pixels of the frames.
    pub(super) pixels: Vec<DVec2>,
    /// A pair one way, then the other way.
    pub(super) pairs: Vec<Pair>,
    /// Per frame, at its size: z up to a factor of the frame's own, not a number where it is unknown.
    pub(super) depth: Vec<Image>,
    /// Per frame, at its size: how far that is to be believed, 0 where it is unknown.
    pub(super) confidence: Vec<Image>,
}

impl Pointmaps {
    /// Asks a source for all pairs of a clip; `progress` is called with the share done.
    ///
    /// # Errors
    /// Fewer than two frames; maps of another size than the picture; those of the source and of `progress`.
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
            // What no later frame is paired with is done.
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

    /// The depth of the frames, each times a factor of its own.
    pub fn into_depth(self, factors: &[f64]) -> EstimatedDepth {
        let scaled = |(mut map, factor): (Image, &f64)| {
            map.pixels.iter_mut().for_each(|z| *z *= *factor as f32);
            map
        };
        let maps = self.depth.into_iter().zip(factors).map(scaled).collect();
        EstimatedDepth { maps, kind: EstimatedKind::Depth, confidence: Some(self.confidence) }
    }
}

/// Pixels of the picture on a grid.
fn places((width, height): (u32, u32)) -> Vec<(u32, u32)> {
    let spacing = (f64::from(width.max(height)) / f64::from(GRID)).max(1.0);
    let along = |side: u32| {
        let count = (f64::from(side) / spacing) as u32;
        (0..count.max(1)).map(move |k| (((f64::from(k) + 0.5) * spacing) as u32).min(side - 1))
    };
    along(height).flat_map(|y| along(width).map(move |x| (x, y))).collect()
}

/// That maps are of the picture's size.
fn check(maps: &PairMaps, (width, height): (u32, u32)) -> Result<()> {
    let all = maps.points.iter().map(|m| (m, 3)).chain(maps.confidence.iter().map(|m| (m, 1)));
    for (map, channels) in all {
        if (map.width, map.height, map.channels) != (width, height, channels) {
            return Err(Error::Input(format!(
                "a pointmap is {}×{} with {} channels, of pictures of {width}×{height}; {channels} channels of that \
                 size were expected",
                map.width, map.height, map.channels
            )));
        }
    }
    Ok(())
}

/// The points of one picture for the alignment: confident and near ones.
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
        // What the camera itself sees lies before it; the other one may stand beside what it sees.
        let before = points[i].z > 0.0 || k == 1;
        let used = inside && before && confident(&i) && points[i].z <= far;
        if used { confidence[i].ln() } else { 0.0 }
    };
    let weights = (0..points.len()).map(weight).collect();
    View { points, weights }
}

/// The depth maps of a frame's pairs, averaged: per pixel, the sum of weights, which are logarithms of confidence, and
/// of weighted logarithms of depth, and how many there are.
#[derive(Clone, Debug, Default)]
struct Fused(Vec<(f32, f32, u16)>);

impl Fused {
    /// Takes in another map, in a unit of its own.
    fn add(&mut self, points: &Image, confidence: &Image) {
        let count = confidence.pixels.len();
        self.0.resize(count, (0.0, 0.0, 0));
        let logarithm = |i: usize| {
            let z = points.pixels[3 * i + 2];
            (z > 0.0 && confidence.pixels[i] >= BELIEVED).then(|| z.ln())
        };
        // The factor that most pixels of what is known already agree with.
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

    /// How far the map is to be believed at the size of the frame: the geometric mean of the confidences.
    fn confidence(&self, placement: &Placement) -> Image {
        let mean = |(weight, _, maps): &(f32, f32, u16)| {
            if *maps > 0 { (weight / f32::from(*maps)).exp() } else { 0.0 }
        };
        let map: Vec<f32> = self.0.iter().map(mean).collect();
        let mut out = placement.at_frame_size(&map);
        out.pixels.iter_mut().filter(|c| c.is_nan()).for_each(|c| *c = 0.0);
        out
    }

    /// The map at the size of the frame.
    fn map(self, placement: &Placement) -> Image {
        let depth = |(weight, sum, _): &(f32, f32, u16)| {
            if *weight > 0.0 { (sum / weight).exp() } else { f32::NAN }
        };
        let map: Vec<f32> = self.0.iter().map(depth).collect();
        placement.at_frame_size(&map)
    }
}

/// The value that `share` of the values lie below; 0 of none.
pub(super) fn quantile(mut values: Vec<f64>, share: f64) -> f64 {
    if values.is_empty() {
        return 0.0;
    }
    let place = ((values.len() - 1) as f64 * share).round() as usize;
    *values.select_nth_unstable_by(place, f64::total_cmp).1
}
