//! Focal length estimation from a set of image pairs.
//!
//! A fundamental matrix becomes an essential matrix only under the right focal length: two singular values
//! of E = Kᵀ F K must be equal (Kruppa's equations for square pixels and a known principal point). The
//! equality of singular values has no error scale, so each candidate focal length is judged by its cost in
//! pixels: the nearest essential matrix to Kᵀ F K is refined on the pairs' Sampson distances, and the
//! remaining squared distances are summed over all image pairs. The sum is a χ² whose width gives the
//! uncertainty of the focal length. Uninformative pairs (planes, rotations, parallel axes) add a constant
//! and do no harm.

use super::epipolar::{cheiral_pose, essential_from_fundamental};
use super::relative::refine_relative;
use crate::error::{Error, Result};
use crate::types::{Intrinsics, Pose};
use glam::{DMat3, DVec2};
use rayon::prelude::*;

/// Two images of the same camera.
#[derive(Clone, Debug)]
pub struct FocalPair {
    /// Their fundamental matrix, from [`super::two_view::fundamental_ransac`].
    pub fundamental: DMat3,
    /// Its inliers: pixels in the first and the second image.
    pub pixels: Vec<(DVec2, DVec2)>,
}

/// Options of the focal length search.
#[derive(Clone, Copy, Debug)]
pub struct FocalOptions {
    /// Range of the candidates, as multiples of the longer side of the image.
    pub range: (f64, f64),
    /// Number of candidates, evenly spaced in their logarithm.
    pub candidates: usize,
    /// Maximum relative standard deviation of an observable focal length.
    pub observable: f64,
    /// Lower bound of the pixels' noise, pixels.
    pub noise_floor: f64,
}

impl Default for FocalOptions {
    fn default() -> Self {
        FocalOptions { range: (0.4, 2.5), candidates: 40, observable: 0.1, noise_floor: 0.1 }
    }
}

/// An estimated focal length with its uncertainty.
#[derive(Clone, Debug)]
pub struct FocalEstimate {
    /// Best focal length, pixels.
    pub focal: f64,
    /// Relative standard deviation: the width of the cost's minimum and, by the jackknife, the disagreement
    /// between the image pairs. Infinite where the minimum is open on a side of the range. Errors that all
    /// pairs share, mainly lens distortion, are not included.
    pub relative_std: f64,
    /// Whether the deviation is small enough to rely on the estimate. If not, use a prior.
    pub observable: bool,
    /// (focal length, cost in pixels²) of all candidates, ascending.
    pub curve: Vec<(f64, f64)>,
}

/// Maximum number of pixel pairs used per image pair: more would add time, but no independent data.
const PAIRS_CAP: usize = 250;
/// Width of the Cauchy kernel on Sampson distances, pixels.
const KERNEL: f64 = 1.0;

/// Estimates the focal length from image pairs of one camera with square pixels and its principal point in
/// the image centre.
///
/// # Errors
/// No pair with at least eight pixels, an image without pixels, an invalid range.
pub fn estimate_focal(
    pairs: &[FocalPair],
    width: u32,
    height: u32,
    options: &FocalOptions,
) -> Result<FocalEstimate> {
    let usable: Vec<FocalPair> = pairs
        .iter()
        .filter(|p| p.fundamental.is_finite())
        .filter_map(|p| {
            let finite = p.pixels.iter().filter(|(a, b)| a.is_finite() && b.is_finite());
            let pixels: Vec<_> = finite.copied().collect();
            let stride = pixels.len().div_ceil(PAIRS_CAP).max(1);
            (pixels.len() >= 8).then(|| FocalPair {
                fundamental: p.fundamental,
                pixels: pixels.into_iter().step_by(stride).collect(),
            })
        })
        .collect();
    let (low, high) = options.range;
    if width == 0 || height == 0 || !(low > 0.0 && high > low && high.is_finite()) {
        return Err(Error::Input(format!(
            "focal length: cannot search {low} … {high} times the side of a {width}×{height} image"
        )));
    }
    if usable.is_empty() {
        return Err(Error::Failed(
            "focal length: no image pair with at least 8 matched pixels; give the focal length"
                .into(),
        ));
    }
    let side = f64::from(width.max(height));
    let count = options.candidates.max(5);
    let ratio = (high / low).ln() / (count - 1) as f64;
    let candidates: Vec<f64> = (0..count).map(|i| side * low * (ratio * i as f64).exp()).collect();
    let costs: Vec<Vec<f64>> =
        usable.par_iter().map(|pair| curve_of(pair, &candidates, width, height)).collect();
    let curve: Vec<(f64, f64)> = candidates
        .iter()
        .enumerate()
        .map(|(i, &f)| (f, costs.iter().map(|c| c[i]).sum()))
        .collect();
    let pixels: usize = usable.iter().map(|p| p.pixels.len()).sum();
    let freedom = pixels.saturating_sub(5 * usable.len() + 1).max(1) as f64;
    let lowest: Vec<f64> = (0..usable.len())
        .map(|left_out| {
            let without: Vec<f64> =
                curve.iter().zip(&costs[left_out]).map(|(c, own)| c.1 - own).collect();
            minimum(&without)
        })
        .collect();
    let relative_std = valley(&curve, freedom, options).hypot(jackknife(&lowest) * ratio);
    let total: Vec<f64> = curve.iter().map(|c| c.1).collect();
    let focal = candidates[0] * (minimum(&total) * ratio).exp();
    let observable = relative_std <= options.observable;
    Ok(FocalEstimate { focal, relative_std, observable, curve })
}

/// Standard deviation of an estimate by the jackknife, from the leave-one-out estimates.
fn jackknife(estimates: &[f64]) -> f64 {
    let n = estimates.len() as f64;
    let mean = estimates.iter().sum::<f64>() / n;
    ((n - 1.0) / n * estimates.iter().map(|e| (e - mean).powi(2)).sum::<f64>()).sqrt()
}

/// Cost of every candidate for one image pair.
fn curve_of(pair: &FocalPair, candidates: &[f64], width: u32, height: u32) -> Vec<f64> {
    let fit = |focal: f64, neighbour: Option<&Pose>| -> Option<(Pose, f64)> {
        let k = Intrinsics::centred(focal, width, height);
        let rays: Vec<_> = pair.pixels.iter().map(|&(a, b)| (k.ray(a), k.ray(b))).collect();
        let own = cheiral_pose(&essential_from_fundamental(&pair.fundamental, &k, &k), &rays);
        [own.map(|c| c.0), neighbour.copied()]
            .into_iter()
            .flatten()
            .map(|start| refine_relative(&start, &k, &k, &pair.pixels, None, KERNEL, 12))
            .min_by(|a, b| a.1.total_cmp(&b.1))
    };
    // In both directions of the range: each candidate also starts from its neighbour's result.
    let mut best: Vec<Option<(Pose, f64)>> = vec![None; candidates.len()];
    for reverse in [false, true] {
        let mut neighbour: Option<Pose> = None;
        for step in 0..candidates.len() {
            let i = if reverse { candidates.len() - 1 - step } else { step };
            let found = fit(candidates[i], neighbour.as_ref());
            neighbour = found.map(|f| f.0);
            if let Some(found) = found
                && best[i].is_none_or(|b| found.1 < b.1)
            {
                best[i] = Some(found);
            }
        }
    }
    // A pair that no candidate fits is uninformative.
    best.iter().map(|b| b.map_or(0.0, |b| b.1)).collect()
}

/// Position of the minimum of evenly spaced costs, in steps, by a parabola through three of them.
fn minimum(costs: &[f64]) -> f64 {
    let lowest = index_of_lowest(costs);
    if lowest == 0 || lowest + 1 == costs.len() {
        return lowest as f64;
    }
    let (a, b, c) = (costs[lowest - 1], costs[lowest], costs[lowest + 1]);
    let bend = a - 2.0 * b + c;
    let offset = if bend > 0.0 { (0.5 * (a - c) / bend).clamp(-0.5, 0.5) } else { 0.0 };
    lowest as f64 + offset
}

fn index_of_lowest(costs: &[f64]) -> usize {
    (0..costs.len()).min_by(|&a, &b| costs[a].total_cmp(&costs[b])).unwrap_or(0)
}

/// Relative standard deviation from the width of the curve's minimum.
fn valley(curve: &[(f64, f64)], freedom: f64, options: &FocalOptions) -> f64 {
    let costs: Vec<f64> = curve.iter().map(|c| c.1).collect();
    let (lowest, last) = (index_of_lowest(&costs), curve.len() - 1);
    let variance = (costs[lowest] / freedom).max(options.noise_floor.powi(2));
    // The cost rises by nine variances at three standard deviations.
    let limit = costs[lowest] + 9.0 * variance;
    let crossing = |indices: &mut dyn Iterator<Item = usize>| -> Option<f64> {
        let mut before = lowest;
        for i in indices {
            if curve[i].1 > limit {
                let (x, y) = (curve[before], curve[i]);
                let part = ((limit - x.1) / (y.1 - x.1)).clamp(0.0, 1.0);
                return Some(x.0.ln() + part * (y.0 / x.0).ln());
            }
            before = i;
        }
        None
    };
    let below = crossing(&mut (0..lowest).rev());
    let above = crossing(&mut (lowest + 1..=last));
    match (below, above) {
        (Some(below), Some(above)) => (above - below) / 6.0,
        _ => f64::INFINITY,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::ransac::RansacOptions;
    use crate::geometry::se3::exp_so3;
    use crate::geometry::two_view::fundamental_ransac;
    use glam::DVec3;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    fn image_pair(pose: Pose, focal: f64, sigma: f64, seed: u64) -> FocalPair {
        let k = Intrinsics::centred(focal, 640, 360);
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let pixels: Vec<_> = (0..300)
            .map(|_| {
                let a = DVec2::new(rng.random_range(0.0..640.0), rng.random_range(0.0..360.0));
                let b = k.project(pose.apply(k.ray(a) * rng.random_range(2.0..8.0)));
                let noise = |rng: &mut ChaCha8Rng| {
                    // Sum of twelve uniforms: variance 1.
                    (0..12).map(|_| rng.random::<f64>()).sum::<f64>() - 6.0
                };
                (a, b + DVec2::new(noise(&mut rng), noise(&mut rng)) * sigma)
            })
            .collect();
        let options = RansacOptions { threshold: 2.0, ..Default::default() };
        let found = fundamental_ransac(&pixels, &options).unwrap();
        let pixels = found.inliers.iter().map(|&i| pixels[i]).collect();
        FocalPair { fundamental: found.model, pixels }
    }

    /// A camera that moves around a subject: its axes converge from different distances.
    fn walk(focal: f64, sigma: f64) -> Vec<FocalPair> {
        (0..6)
            .map(|i| {
                let t = i as f64;
                let turn = exp_so3(DVec3::new(0.05 * t - 0.1, 0.25 - 0.02 * t, 0.03 * t));
                let pose = Pose::new(turn, DVec3::new(-1.0, 0.2 * t - 0.4, 0.3 * t));
                image_pair(pose, focal, sigma, 30 + i)
            })
            .collect()
    }

    #[test]
    fn a_walk_around_tells_the_focal_length() {
        for focal in [380.0, 640.0, 1100.0] {
            let found = estimate_focal(&walk(focal, 0.3), 640, 360, &Default::default()).unwrap();
            let error = (found.focal / focal).ln().abs();
            assert!(found.observable, "{focal}: {} ± {}", found.focal, found.relative_std);
            assert!(
                error < 0.05 && error < 5.0 * found.relative_std.max(0.01),
                "{focal}: {} ± {}",
                found.focal,
                found.relative_std
            );
        }
    }

    #[test]
    fn a_sideways_slide_does_not_and_says_so() {
        let pairs: Vec<_> = (0..4)
            .map(|i| {
                let pose =
                    Pose::new(glam::DQuat::IDENTITY, DVec3::new(-0.2 * (i + 1) as f64, 0.0, 0.0));
                image_pair(pose, 600.0, 0.3, 50 + i)
            })
            .collect();
        let found = estimate_focal(&pairs, 640, 360, &Default::default()).unwrap();
        assert!(!found.observable, "{} ± {}", found.focal, found.relative_std);
        assert!(found.focal.is_finite() && found.curve.len() == 40);
    }

    #[test]
    fn bad_input_is_refused_in_words() {
        assert!(estimate_focal(&[], 640, 360, &Default::default()).is_err());
        let nothing =
            FocalPair { fundamental: DMat3::ZERO, pixels: vec![(DVec2::ONE, DVec2::ONE); 9] };
        let found =
            estimate_focal(std::slice::from_ref(&nothing), 640, 360, &Default::default()).unwrap();
        assert!(!found.observable && found.focal.is_finite());
        assert!(estimate_focal(&[nothing], 0, 0, &Default::default()).is_err());
    }
}
