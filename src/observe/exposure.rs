//! Exposure of each frame: automatic exposure and white balance change while a clip is filmed.
//!
//! A tracked point keeps its colour, so a colour change that all points share between two frames is caused
//! by the camera. In linear light this is one gain per channel. The ratios of many pairs of frames, near
//! and far apart, are solved for jointly, so that small errors do not accumulate along the clip. Movers
//! pass through light and shadow; the median over the points rejects them.

use std::borrow::Cow;

use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::PointTrack;
use crate::types::Image;

/// Offset of the sRGB encoding: an encoded value plus this offset is proportional to a power of linear
/// light, except for the darkest values.
const TOE: f32 = 0.055;
/// Range of usable encoded values; values outside are clipped or noise.
const USABLE: (f32, f32) = (0.08, 0.95);
/// Frame distances at which pairs are compared.
const APART: [usize; 5] = [1, 2, 4, 8, 16];
/// Minimum number of common points for comparing two frames.
const LEAST_POINTS: usize = 30;
/// Deviation of a gain from 1, in encoded values, below which the gain is not modelled. Smaller changes are
/// within view-dependent appearance.
const SIGNIFICANT: f32 = 0.02;
/// Prior standard deviation of the log gain between neighbouring frames, for frames without common points.
const STEADY: f64 = 0.1;

/// The exposure of each frame of a clip relative to the whole clip.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Exposure {
    /// Per frame: the factor on each encoded RGB value after 0.055 is added to it. The median over the
    /// frames is 1. Empty where the exposure does not change.
    pub gains: Vec<[f32; 3]>,
}

impl Exposure {
    /// Measures the exposure of `frames` (RGB, encoded values in [0, 1]) from points tracked through them.
    /// Changes of less than 2 % are treated as constant exposure.
    pub fn measure(frames: &[Image], tracks: &[PointTrack]) -> Exposure {
        if frames.is_empty() {
            return Exposure::default();
        }
        let colours: Vec<Colours> =
            tracks.par_iter().map(|track| Colours::of(frames, track)).collect();
        let compared: Vec<Comparison> = APART
            .into_par_iter()
            .flat_map(|apart| {
                let pairs = 0..frames.len().saturating_sub(apart);
                pairs.into_par_iter().map(move |first| (first, first + apart))
            })
            .filter_map(|(first, second)| compare(&colours, first, second))
            .collect();
        let mut gains = vec![[1.0f32; 3]; frames.len()];
        for channel in 0..3 {
            let Some(logs) = solve(frames.len(), &compared, channel) else {
                return Exposure::default();
            };
            for (gain, log) in gains.iter_mut().zip(logs) {
                gain[channel] = log.exp() as f32;
            }
        }
        let changes = gains.iter().flatten().any(|gain| (gain - 1.0).abs() > SIGNIFICANT);
        if changes { Exposure { gains } } else { Exposure::default() }
    }

    /// Whether all frames have the same exposure.
    pub fn is_constant(&self) -> bool {
        self.gains.is_empty()
    }

    /// The image of a frame (RGB), corrected to the exposure of the whole clip.
    pub fn even<'a>(&self, frame: usize, image: &'a Image) -> Cow<'a, Image> {
        let Some(gain) = self.gains.get(frame) else { return Cow::Borrowed(image) };
        let mut even = image.clone();
        for pixel in even.pixels.chunks_exact_mut(3) {
            for (value, gain) in pixel.iter_mut().zip(gain) {
                *value = ((*value + TOE) / gain - TOE).clamp(0.0, 1.0);
            }
        }
        Cow::Owned(even)
    }

    /// Applies [`even`](Exposure::even) to all frames.
    pub fn even_all<'a>(&self, frames: &'a [Image]) -> Cow<'a, [Image]> {
        if self.is_constant() {
            return Cow::Borrowed(frames);
        }
        let even = |(frame, image)| self.even(frame, image).into_owned();
        Cow::Owned(frames.par_iter().enumerate().map(even).collect())
    }
}

/// Brightness ratio between two frames.
struct Comparison {
    first: usize,
    second: usize,
    /// Median of the log ratio and its standard deviation, per channel.
    log_ratio: [(f64, f64); 3],
}

/// The colours of a point in each frame.
struct Colours {
    frames: Vec<usize>,
    mean: Vec<Option<[f32; 3]>>,
}

impl Colours {
    fn of(frames: &[Image], track: &PointTrack) -> Colours {
        let seen = track.frames.iter().zip(&track.pixels);
        let mean = seen.map(|(frame, at)| mean(&frames[*frame], *at)).collect();
        Colours { frames: track.frames.clone(), mean }
    }

    fn at(&self, frame: usize) -> Option<[f32; 3]> {
        self.frames.binary_search(&frame).ok().and_then(|k| self.mean[k])
    }
}

fn compare(colours: &[Colours], first: usize, second: usize) -> Option<Comparison> {
    let mut ratios: [Vec<f64>; 3] = Default::default();
    for point in colours {
        let (Some(a), Some(b)) = (point.at(first), point.at(second)) else { continue };
        for ((ratios, a), b) in ratios.iter_mut().zip(a).zip(b) {
            let usable = |v: f32| (USABLE.0..USABLE.1).contains(&v);
            if usable(a) && usable(b) {
                ratios.push(f64::from((b + TOE) / (a + TOE)).ln());
            }
        }
    }
    let mut log_ratio = [(0.0, f64::INFINITY); 3];
    for (found, ratios) in log_ratio.iter_mut().zip(&mut ratios) {
        let n = ratios.len();
        if n < LEAST_POINTS {
            continue;
        }
        let middle = median(ratios);
        ratios.iter_mut().for_each(|ratio| *ratio = (*ratio - middle).abs());
        // Standard deviation of the median, from the median absolute deviation of a normal distribution.
        let deviation = 1.48 * 1.25 * median(ratios) / (n as f64).sqrt();
        *found = (middle, deviation.max(1e-4));
    }
    log_ratio.iter().any(|found| found.1.is_finite()).then_some(Comparison {
        first,
        second,
        log_ratio,
    })
}

/// Mean colour of 3 × 3 pixels; `None` at the image border.
fn mean(image: &Image, at: glam::DVec2) -> Option<[f32; 3]> {
    let (x, y) = (at.x.floor(), at.y.floor());
    let within = |v: f64, size: u32| v >= 1.0 && v + 2.0 <= f64::from(size);
    if !within(x, image.width) || !within(y, image.height) {
        return None;
    }
    let (x, y) = (x as u32, y as u32);
    let mut sum = [0.0; 3];
    for (dx, dy) in (0..9).map(|i| (i % 3, i / 3)) {
        for (sum, value) in sum.iter_mut().zip(image.at(x + dx - 1, y + dy - 1)) {
            *sum += value / 9.0;
        }
    }
    Some(sum)
}

/// Log gains of all frames, shifted so that their median is zero.
fn solve(frames: usize, compared: &[Comparison], channel: usize) -> Option<Vec<f64>> {
    let mut normal = DMatrix::<f64>::zeros(frames, frames);
    let mut right = DVector::<f64>::zeros(frames);
    let mut add = |first: usize, second: usize, (log, deviation): (f64, f64)| {
        let weight = deviation.powi(-2);
        normal[(first, first)] += weight;
        normal[(second, second)] += weight;
        normal[(first, second)] -= weight;
        normal[(second, first)] -= weight;
        right[first] -= weight * log;
        right[second] += weight * log;
    };
    for second in 1..frames {
        add(second - 1, second, (0.0, STEADY));
    }
    for found in compared {
        add(found.first, found.second, found.log_ratio[channel]);
    }
    // Only differences are measured, so the first frame is fixed and the median subtracted afterwards.
    normal[(0, 0)] += STEADY.powi(-2);
    let mut logs = normal.cholesky()?.solve(&right).data.as_vec().clone();
    let middle = median(&mut logs.clone());
    logs.iter_mut().for_each(|log| *log -= middle);
    Some(logs)
}

/// The median of at least one value.
fn median(values: &mut [f64]) -> f64 {
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}

#[cfg(test)]
mod tests {
    use glam::DVec2;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    const SIZE: (u32, u32) = (64, 48);

    fn light(encoded: f64) -> f64 {
        if encoded <= 0.04045 { encoded / 12.92 } else { ((encoded + 0.055) / 1.055).powf(2.4) }
    }

    fn encoded(light: f64) -> f64 {
        if light <= 0.003_130_8 { light * 12.92 } else { 1.055 * light.powf(1.0 / 2.4) - 0.055 }
    }

    /// Frames of one image at the given gains in linear light, with noise. In one region the light changes
    /// independently, as on a mover.
    fn filmed(gains: &[[f64; 3]]) -> (Image, Vec<Image>, Vec<PointTrack>) {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let mut scene = Image::new(SIZE.0, SIZE.1, 3);
        for (i, value) in scene.pixels.iter_mut().enumerate() {
            let x = (i / 3) % SIZE.0 as usize;
            *value = 0.15 + 0.5 * ((x / 4) as f32 * 0.7).sin().abs() + 0.1 * rng.random::<f32>();
        }
        let frames: Vec<Image> = gains
            .iter()
            .enumerate()
            .map(|(frame, gain)| {
                let mut image = scene.clone();
                for (i, value) in image.pixels.iter_mut().enumerate() {
                    let moves = (i / 3) / SIZE.0 as usize > 2 * SIZE.1 as usize / 3;
                    let own = if moves { 1.0 + 0.08 * frame as f64 } else { 1.0 };
                    let lit = encoded(gain[i % 3] * own * light(f64::from(*value)));
                    *value = (lit + 0.01 * (f64::from(rng.random::<f32>()) - 0.5)).clamp(0.0, 1.0)
                        as f32;
                }
                image
            })
            .collect();
        let tracks = (0..15 * 11)
            .map(|i| {
                let pixel = DVec2::new((i % 15) as f64 + 0.9, (i / 15) as f64 + 0.9) * 4.0;
                PointTrack::followed(0, vec![pixel; gains.len()], vec![0.1; gains.len()])
            })
            .collect();
        (scene, frames, tracks)
    }

    #[test]
    fn a_drift_of_exposure_and_white_balance_is_measured_and_taken_off() {
        // 30 % brighter and 10 % warmer.
        let gains: Vec<[f64; 3]> = (0..21)
            .map(|frame| {
                let t = frame as f64 / 20.0 - 0.5;
                [1.3f64.powf(t) * 1.1f64.powf(t), 1.3f64.powf(t), 1.3f64.powf(t)]
            })
            .collect();
        let (scene, frames, tracks) = filmed(&gains);
        let found = Exposure::measure(&frames, &tracks);
        for (gain, found) in gains.iter().zip(&found.gains) {
            for (gain, found) in gain.iter().zip(found) {
                let gain = gain.powf(1.0 / 2.4);
                assert!((f64::from(*found) / gain - 1.0).abs() < 3e-3, "{found} for {gain}");
            }
        }
        let worst = |frame: &Image| {
            let still = 2 * frame.pixels.len() / 3;
            let pairs = frame.pixels[..still].iter().zip(&scene.pixels);
            pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
        };
        assert!(worst(&frames[20]) > 0.04, "{}", worst(&frames[20]));
        let even = found.even_all(&frames);
        assert!(even.iter().all(|frame| worst(frame) < 0.01), "{}", worst(&even[20]));
    }

    #[test]
    fn a_steady_exposure_is_left_alone() {
        let (_, frames, tracks) = filmed(&[[1.0; 3]; 12]);
        let found = Exposure::measure(&frames, &tracks);
        assert!(found.is_constant(), "{found:?}");
        assert_eq!(*found.even(3, &frames[3]), frames[3]);
    }

    #[test]
    fn what_tells_nothing_changes_nothing() {
        let black = vec![Image::new(SIZE.0, SIZE.1, 3); 4];
        let (_, frames, tracks) = filmed(&[[1.0; 3], [1.3; 3], [1.0; 3], [1.3; 3]]);
        assert!(Exposure::measure(&black, &tracks).is_constant());
        assert!(Exposure::measure(&frames, &[]).is_constant());
        assert!(Exposure::measure(&[], &[]).is_constant());
        // A black frame among others gives no measurement and does not affect the others.
        let mut one = frames;
        one[2] = black[0].clone();
        let found = Exposure::measure(&one, &tracks);
        let ratio = f64::from(found.gains[3][1] / found.gains[0][1]);
        assert!((ratio / 1.3f64.powf(1.0 / 2.4) - 1.0).abs() < 3e-3, "{found:?}");
    }
}
