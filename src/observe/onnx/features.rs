//! Networks that detect and describe keypoints, such as XFeat (Potje et al. 2024).

use std::path::Path;

use std::f64::consts::FRAC_1_SQRT_2;

use glam::DVec2;

use super::contract::{Contract, FeaturesContract};
use super::network::{Network, Planes, check_frame};
use super::picture::Layout;
use crate::Result;
use crate::observe::features::{FeatureSource, Features, Rule};
use crate::types::Image;

/// Radius of non-maximum suppression, pixels.
const APART: usize = 2;
/// Minimum keypoint probability.
const LIKELY: f32 = 0.05;
/// Maximum number of keypoints per frame.
const POINTS: usize = 2000;
/// Minimum inner product of matching descriptors; the value of XFeat's authors.
const ALIKE: f32 = 0.82;
/// Standard deviation of a keypoint along each axis, pixels of the network's input image.
const NOISE: f32 = 1.0;

/// A network that detects and describes keypoints.
pub struct FeaturesNetwork {
    network: Network,
    contract: FeaturesContract,
}

impl FeaturesNetwork {
    /// Makes the network from a model with a feature contract.
    pub(super) fn new((network, contract): (Network, Contract)) -> Result<FeaturesNetwork> {
        match contract {
            Contract::Features(contract) => Ok(FeaturesNetwork { network, contract }),
            other => Err(network.listed_for("features", &other)),
        }
    }

    /// The network's file.
    pub fn file(&self) -> &Path {
        &self.network.file
    }

    /// The network's contract.
    pub fn contract(&self) -> &FeaturesContract {
        &self.contract
    }

    /// The most probable keypoints of a frame with their descriptors.
    ///
    /// # Errors
    /// A frame without three channels; the network fails, its output violates its contract, or is not finite.
    pub fn features(&mut self, frame: &Image) -> Result<Features> {
        check_frame(frame)?;
        let FeaturesContract { input, picture: rule, descriptors, keypoints, reliability, .. } =
            &self.contract;
        let layout = Layout::new(rule, (frame.width, frame.height));
        let given = vec![(input.as_str(), layout.picture(rule, frame))];
        let names = [descriptors.as_str(), keypoints, reliability];
        let found = self.network.run_pictures(given, layout.picture, &names)?;
        for (planes, name) in found.iter().zip(names) {
            self.network.check_finite(&planes.values, name, layout.picture)?;
        }
        let [described, likely, reliable] = &found[..] else {
            return Err(self.network.wrong(descriptors, "has not come out"));
        };
        self.network.check_channels(likely, 1, keypoints)?;
        self.network.check_channels(reliable, 1, reliability)?;
        let placement = layout.placement();
        let described = channels(described);
        let (mut pixels, mut descriptors) = (Vec::new(), Vec::new());
        for at in peaks(likely, &channels(reliable)[0]) {
            // Both maps are sampled at the point's relative position in the input image, whatever their
            // resolution.
            let share = at / DVec2::new(f64::from(likely.size.0), f64::from(likely.size.1));
            let picture = DVec2::new(f64::from(layout.picture.0), f64::from(layout.picture.1));
            let pixel = placement.corner + placement.scale * share * picture;
            let inside = pixel.cmpge(DVec2::ZERO).all()
                && pixel.x < f64::from(frame.width)
                && pixel.y < f64::from(frame.height);
            if inside {
                pixels.push(pixel);
                descriptors.extend(described_at(&described, share));
            }
        }
        let noise = NOISE * (placement.scale.length() * FRAC_1_SQRT_2) as f32;
        Ok(Features { pixels, noise, descriptors, rule: Rule::Product(ALIKE) })
    }
}

impl FeatureSource for FeaturesNetwork {
    fn features(&mut self, _number: usize, frame: &Image) -> Result<Features> {
        FeaturesNetwork::features(self, frame)
    }
}

/// Positions of the most probable keypoints, best first.
fn peaks(likely: &Planes, reliable: &Image) -> Vec<DVec2> {
    let (width, height) = (likely.size.0 as usize, likely.size.1 as usize);
    let at = |x: usize, y: usize| likely.values[y * width + x];
    let mut found = Vec::new();
    for y in 0..height {
        for x in 0..width {
            let value = at(x, y);
            if value < LIKELY {
                continue;
            }
            let xs = x.saturating_sub(APART)..(x + APART + 1).min(width);
            let ys = y.saturating_sub(APART)..(y + APART + 1).min(height);
            // Of equal neighbours the first one counts.
            let beaten = ys
                .flat_map(|v| xs.clone().map(move |u| (u, v)))
                .any(|(u, v)| at(u, v) > value || (at(u, v) == value && (v, u) < (y, x)));
            if !beaten {
                let middle = DVec2::new(x as f64, y as f64) + 0.5;
                let share = middle / DVec2::new(width as f64, height as f64);
                let score = value * sampled(reliable, share);
                found.push((score, middle + within(likely, x, y)));
            }
        }
    }
    found.sort_by(|a, b| b.0.total_cmp(&a.0));
    found.into_iter().take(POINTS).map(|(_, at)| at).collect()
}

/// Sub-pixel offset of the peak from the pixel's centre, by a parabola through its neighbours.
fn within(likely: &Planes, x: usize, y: usize) -> DVec2 {
    let (width, height) = (likely.size.0 as usize, likely.size.1 as usize);
    if x == 0 || y == 0 || x + 1 == width || y + 1 == height {
        return DVec2::ZERO;
    }
    let at = |x: usize, y: usize| f64::from(likely.values[y * width + x]);
    let offset = |before: f64, here: f64, after: f64| {
        let bend = before - 2.0 * here + after;
        if bend < 0.0 { (0.5 * (before - after) / bend).clamp(-0.5, 0.5) } else { 0.0 }
    };
    DVec2::new(
        offset(at(x - 1, y), at(x, y), at(x + 1, y)),
        offset(at(x, y - 1), at(x, y), at(x, y + 1)),
    )
}

/// The channels of an output as separate images.
fn channels(planes: &Planes) -> Vec<Image> {
    let (width, height) = planes.size;
    let one = |plane: &[f32]| Image { width, height, channels: 1, pixels: plane.to_vec() };
    planes.values.chunks_exact(width as usize * height as usize).map(one).collect()
}

/// Samples a channel at a position given as a share of its sides.
fn sampled(channel: &Image, share: DVec2) -> f32 {
    channel.between(share.x * f64::from(channel.width), share.y * f64::from(channel.height))
}

/// The descriptor at a position, scaled to unit length.
fn described_at(channels: &[Image], share: DVec2) -> Vec<f32> {
    let mut values: Vec<f32> = channels.iter().map(|channel| sampled(channel, share)).collect();
    let length = values.iter().map(|v| v * v).sum::<f32>().sqrt().max(f32::MIN_POSITIVE);
    values.iter_mut().for_each(|value| *value /= length);
    values
}
