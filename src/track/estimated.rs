//! Depth that a network has estimated from single frames, scaled to the world's unit, and the shapes of
//! movers that it shows.
//!
//! Such depth gives shapes and depth order, but leaves a scale and often a shift undetermined, which differ
//! from frame to frame. Both are fitted to the triangulated static world of the same frame (Ranftl et al.,
//! "Towards Robust Monocular Depth Estimation", TPAMI 2022, align in this way for comparison). The fit first
//! takes the least median of residuals, so that neither errors of the network nor errors of the triangulation
//! affect it, then reweights the pixels that agree.

use glam::DVec2;
use rayon::prelude::*;

use super::depth::{Layer, is_certain};
use super::movers::nearest_pixel;
use super::quantile;
use super::residual::Seen;
use crate::observe::{EstimatedDepth, EstimatedKind, NeighbourFlow};
use crate::types::Image;

/// Minimum number of pixels that a frame is aligned with, and the stride at which pixels are sampled.
const LEAST: usize = 50;
const EVERY: usize = 5;
/// Minimum support of a triangulated pixel that is compared.
const SUPPORT: f32 = 0.5;
/// Number of frames to each side that shapes are averaged over.
const AROUND: usize = 4;
/// Number of candidate lines of the initial fit, and a stride that is coprime to it.
const CANDIDATES: usize = 128;
const STRIDE: usize = 37;
/// Number of reweighting rounds with Tukey's biweight, the width of the biweight in median residuals, and the
/// minimum width.
const ROUNDS: usize = 10;
const BIWEIGHT: f64 = 6.0;
const ALIKE: f64 = 0.005;
/// The median absolute value of a normal variable, in its standard deviations.
const NORMAL_MEDIAN: f64 = 0.6745;
/// Lower bound of the relative standard deviation of an estimate.
const FINEST: f64 = 0.002;

/// A network's estimate of a frame, in the world's unit.
#[derive(Clone, Debug, Default)]
pub(super) struct Estimate {
    /// Inverse depth of each pixel, 0 where unknown; 0 everywhere in a frame that cannot be aligned.
    pub inverse: Vec<f32>,
    /// Its relative standard deviation, measured against the triangulated static world; infinite if nothing
    /// could be compared.
    deviation: f32,
    /// Factor on this deviation for each pixel, if the network gives confidence; else empty.
    doubt: Vec<f32>,
}

impl Estimate {
    /// Relative standard deviation of a pixel's inverse depth.
    pub fn deviation(&self, i: usize) -> f32 {
        self.deviation * self.doubt.get(i).copied().unwrap_or(1.0)
    }
}

/// Each frame's estimate in the world's unit. If no frame can be aligned, the median depth over all frames is
/// the unit.
pub(super) fn aligned(estimated: &EstimatedDepth, seen: &[Seen], masks: &[Image]) -> Vec<Estimate> {
    let EstimatedDepth { maps, kind, confidence } = estimated;
    let fits: Vec<Option<Line>> = maps
        .par_iter()
        .zip(seen)
        .zip(masks)
        .map(|((map, seen), mask)| fit(*kind, &pairs(*kind, map, seen, mask)))
        .collect();
    let blind = fits.iter().all(Option::is_none).then(|| usual(estimated));
    maps.par_iter()
        .enumerate()
        .zip(fits)
        .zip(seen.par_iter().zip(masks))
        .map(|(((frame, map), fit), (seen, mask))| {
            let doubt = confidence.as_ref().map_or_else(Vec::new, |all| doubt(&all[frame]));
            let line = fit.or(blind);
            let inverse = |told: &f32| line.map_or(0.0, |line| line.inverse(*kind, *told));
            let inverse: Vec<f32> = map.pixels.iter().map(inverse).collect();
            let deviation = match fit {
                Some(_) => deviation(&inverse, &doubt, seen, mask),
                None => f32::INFINITY,
            };
            Estimate { inverse, deviation, doubt }
        })
        .collect()
}

/// The deviation of each pixel relative to a pixel of median confidence; 1 where confidence is unknown.
fn doubt(confidence: &Image) -> Vec<f32> {
    let told = confidence.pixels.iter().filter(|c| **c > 0.0);
    let median = quantile(told.map(|c| f64::from(*c)).collect(), 0.5) as f32;
    confidence.pixels.iter().map(|c| if *c > 0.0 { median / c } else { 1.0 }).collect()
}

/// The relative deviation of an aligned estimate, from its differences to the triangulated depth, including
/// the triangulation's own deviation. It is measured by the median, so that outliers on either side have no
/// influence. `doubt` is the relative deviation of each pixel, or empty.
fn deviation(inverse: &[f32], doubt: &[f32], seen: &Seen, mask: &Image) -> f32 {
    let compared = |i: &usize| inverse[*i] > 0.0 && is_comparable(seen, mask, *i);
    let differences: Vec<f64> = (0..inverse.len())
        .step_by(EVERY)
        .filter(compared)
        .map(|i| {
            let off = f64::from(inverse[i] / seen.inverse_depth[i] - 1.0).abs();
            off / f64::from(doubt.get(i).copied().unwrap_or(1.0))
        })
        .collect();
    match differences.len() < LEAST {
        true => f32::INFINITY,
        false => (quantile(differences, 0.5) / NORMAL_MEDIAN).max(FINEST) as f32,
    }
}

/// Whether the triangulated depth of a pixel can be compared with a network's estimate.
fn is_comparable(seen: &Seen, mask: &Image, i: usize) -> bool {
    seen.support[i] >= SUPPORT && is_certain(seen, mask, i)
}

/// The fitted line `factor` x + `shift`, which gives inverse depth or depth.
#[derive(Clone, Copy, Debug)]
struct Line {
    factor: f64,
    shift: f64,
}

impl Line {
    /// Inverse depth, 0 where unknown.
    fn inverse(self, kind: EstimatedKind, told: f32) -> f32 {
        let Some(x) = known(kind, told) else { return 0.0 };
        let y = self.factor * x + self.shift;
        let inverse = match kind {
            EstimatedKind::Depth | EstimatedKind::ShiftedInverse => y,
            EstimatedKind::ShiftedDepth => y.recip(),
        };
        if y > 0.0 && inverse.is_finite() { inverse as f32 } else { 0.0 }
    }
}

/// The quantity that a line is fitted to, from a map's value: inverse depth, or depth if the map is shifted
/// depth.
fn known(kind: EstimatedKind, told: f32) -> Option<f64> {
    let told = f64::from(told);
    match kind {
        EstimatedKind::Depth => (told > 0.0 && told.is_finite()).then(|| told.recip()),
        EstimatedKind::ShiftedDepth => (told.is_finite() && told != 0.0).then_some(told),
        EstimatedKind::ShiftedInverse => told.is_finite().then_some(told),
    }
}

/// Pairs of the map's value (x) and the triangulated inverse depth, of static pixels.
fn pairs(kind: EstimatedKind, map: &Image, seen: &Seen, mask: &Image) -> Vec<(f64, f64)> {
    let pair = |i: usize| {
        let x = is_comparable(seen, mask, i).then(|| known(kind, map.pixels[i])).flatten()?;
        Some((x, f64::from(seen.inverse_depth[i])))
    };
    (0..map.pixels.len()).step_by(EVERY).filter_map(pair).collect()
}

/// The line that most pairs agree with; `None` for too few pairs, for pairs of one depth, or if the map's
/// depth order is reversed.
fn fit(kind: EstimatedKind, pairs: &[(f64, f64)]) -> Option<Line> {
    if pairs.len() < LEAST {
        return None;
    }
    if kind == EstimatedKind::Depth {
        let factor = quantile(pairs.iter().map(|(x, d)| d / x).collect(), 0.5);
        return Some(Line { factor, shift: 0.0 });
    }
    // Residuals are relative: (factor x + shift) / y − 1, where y is inverse depth or depth.
    let rows: Vec<(f64, f64)> = pairs
        .iter()
        .map(|(x, d)| match kind {
            EstimatedKind::ShiftedDepth => (x * d, *d),
            _ => (x / d, d.recip()),
        })
        .collect();
    let residual =
        |line: &Line, (a, b): &(f64, f64)| (line.factor * a + line.shift * b - 1.0).abs();
    let spread = |line: &Line| quantile(rows.iter().map(|row| residual(line, row)).collect(), 0.5);
    // Candidate lines pass through two pairs with different map values; each is scored by the median of its
    // residuals.
    let mut by_told: Vec<usize> = (0..rows.len()).collect();
    by_told.sort_by(|i, j| pairs[*i].0.total_cmp(&pairs[*j].0));
    let third = rows.len() / 3;
    let through = |k: usize| {
        // The pairs of samples are distinct and evenly spread.
        let place = |k: usize| (k * third / CANDIDATES).min(third - 1);
        let (i, j) = (by_told[place(k)], by_told[rows.len() - 1 - place(k * STRIDE % CANDIDATES)]);
        let ((a, b), (c, d)) = (rows[i], rows[j]);
        let determinant = a * d - b * c;
        let line = Line { factor: (d - b) / determinant, shift: (a - c) / determinant };
        (line.factor.is_finite() && line.shift.is_finite()).then_some(line)
    };
    let lines: Vec<(f64, Line)> =
        (0..CANDIDATES).filter_map(through).map(|line| (spread(&line), line)).collect();
    let mut line = lines.into_iter().min_by(|a, b| a.0.total_cmp(&b.0))?.1;
    for _ in 0..ROUNDS {
        let width = (BIWEIGHT * spread(&line)).max(ALIKE);
        let mut sums = [0.0; 5];
        for row in &rows {
            let (a, b) = *row;
            let w = (1.0 - (residual(&line, row) / width).powi(2)).max(0.0).powi(2);
            for (sum, term) in sums.iter_mut().zip([a * a, a * b, b * b, a, b]) {
                *sum += w * term;
            }
        }
        let [aa, ab, bb, a1, b1] = sums;
        let determinant = aa * bb - ab * ab;
        // Pairs of a single depth do not determine a shift.
        if determinant <= 1e-9 * aa * bb {
            return None;
        }
        line = Line {
            factor: (a1 * bb - b1 * ab) / determinant,
            shift: (b1 * aa - a1 * ab) / determinant,
        };
    }
    Some(line).filter(|line| line.factor > 0.0)
}

/// The line if nothing can be compared: no shift, and a median depth of 1.
fn usual(estimated: &EstimatedDepth) -> Line {
    let all = estimated.maps.iter().flat_map(|map| map.pixels.iter().step_by(EVERY));
    let x: Vec<f64> = all.filter_map(|told| known(estimated.kind, *told)).collect();
    let median = quantile(x, 0.5);
    Line { factor: if median > 0.0 { median.recip() } else { 1.0 }, shift: 0.0 }
}

/// Gives movers the shape that a network estimated, and keeps their distance. `pixels` are their inverse
/// depths by frame, `owners` give the object of each pixel, and `open` marks the objects whose shapes may
/// change.
///
/// The difference to the current shape is averaged over neighbouring frames, along the flow, and then scaled
/// by the share of it that persists there. The share that is due to chance is estimated from the variation
/// between frames (shrinkage towards the prior, James and Stein 1961).
pub(super) fn shape(
    pixels: &mut [Vec<Option<(f32, f32)>>],
    owners: &[Vec<Option<u16>>],
    open: &[bool],
    layers: &[Layer],
    flow: &NeighbourFlow,
) {
    if layers.iter().all(|layer| layer.estimated.is_empty()) {
        return;
    }
    let may = |f: usize, i: usize| {
        owners[f][i].map(usize::from).filter(|own| open.get(*own).copied().unwrap_or(false))
    };
    // The logarithm of the ratio of the network's inverse depth to the current one, minus its median over the
    // object.
    let beyond: Vec<Vec<Option<f64>>> = (0..pixels.len())
        .into_par_iter()
        .map(|f| {
            let ratio = |i: usize| {
                let told = f64::from(*layers[f].estimated.get(i)?);
                let own = may(f, i).filter(|_| told > 0.0)?;
                Some((own, (told / f64::from(pixels[f][i]?.0)).ln()))
            };
            let ratios: Vec<Option<(usize, f64)>> = (0..pixels[f].len()).map(ratio).collect();
            let mut of: Vec<Vec<f64>> = vec![Vec::new(); open.len()];
            ratios.iter().flatten().for_each(|(own, ratio)| of[*own].push(*ratio));
            let medians: Vec<f64> = of.into_iter().map(|of| quantile(of, 0.5)).collect();
            ratios.into_iter().map(|r| r.map(|(own, ratio)| ratio - medians[own])).collect()
        })
        .collect();
    let averages: Vec<Vec<Option<Average>>> = (0..pixels.len())
        .into_par_iter()
        .map(|f| {
            let average = |i: usize| {
                let mut sums = Sums::default();
                sums.add(1.0, beyond[f][i]?);
                let own = owners[f][i];
                let pixel =
                    DVec2::new((i % flow.width) as f64 + 0.5, (i / flow.width) as f64 + 0.5);
                flow.follow(f, pixel, AROUND, |other, chain| {
                    let there = nearest_pixel(chain.pixel, flow.width, beyond[other].len());
                    if let Some(value) =
                        beyond[other][there].filter(|_| owners[other][there] == own)
                    {
                        sums.add(f64::from(chain.confidence), value);
                    }
                });
                Some(sums.average())
            };
            (0..pixels[f].len()).map(average).collect()
        })
        .collect();
    // For each object: the sum of squares of the averages, and of their squared standard errors.
    let mut squares = vec![(0.0, 0.0); open.len()];
    for (f, averages) in averages.iter().enumerate() {
        for (i, average) in averages.iter().enumerate() {
            if let Some((own, Average { mean, error: Some(error) })) = may(f, i).zip(*average) {
                squares[own].0 += mean * mean;
                squares[own].1 += error;
            }
        }
    }
    let lasts: Vec<f64> = squares
        .iter()
        .map(|(all, chance)| if *all > 0.0 { (1.0 - chance / all).max(0.0) } else { 0.0 })
        .collect();
    for (f, pixels) in pixels.iter_mut().enumerate() {
        for (i, pixel) in pixels.iter_mut().enumerate() {
            if let (Some(own), Some(average), Some((inverse, _))) =
                (may(f, i), averages[f][i], pixel.as_mut())
            {
                *inverse = (f64::from(*inverse) * (lasts[own] * average.mean).exp()) as f32;
            }
        }
    }
}

/// A weighted average, and its squared standard error if it has more than one value.
#[derive(Clone, Copy)]
struct Average {
    mean: f64,
    error: Option<f64>,
}

/// Sums of weights, of their squares, and of weighted values and squares.
#[derive(Default)]
struct Sums {
    weight: f64,
    weight_squared: f64,
    value: f64,
    value_squared: f64,
}

impl Sums {
    fn add(&mut self, weight: f64, value: f64) {
        self.weight += weight;
        self.weight_squared += weight * weight;
        self.value += weight * value;
        self.value_squared += weight * value * value;
    }

    fn average(&self) -> Average {
        let mean = self.value / self.weight;
        let spread = (self.value_squared / self.weight - mean * mean).max(0.0);
        // The effective number of values.
        let count = self.weight * self.weight / self.weight_squared;
        Average { mean, error: (count > 1.5).then(|| spread / (count - 1.0)) }
    }
}

#[cfg(test)]
mod tests {
    use super::super::sliding::*;
    use super::*;
    use glam::DVec2;

    /// Ground that gets nearer towards the lower border.
    fn truth(p: DVec2) -> f32 {
        0.1 + 0.01 * p.y as f32
    }

    /// The triangulated ground, with one pixel in nine wrong.
    fn seen() -> Seen {
        let wrong = |p: DVec2| (p.x as u32 + 7 * p.y as u32).is_multiple_of(9);
        let inverse_depth = map(|p| if wrong(p) { 3.0 * truth(p) } else { truth(p) }).pixels;
        let n = inverse_depth.len();
        let deviation = inverse_depth.iter().map(|d| 0.01 * d).collect();
        Seen { inverse_depth, deviation, score: vec![1.0; n], support: vec![2.0; n] }
    }

    fn nothing_moves() -> [Image; 1] {
        [map(|_| 0.0)]
    }

    /// A map of a kind, with an arbitrary scale and shift.
    fn told(kind: EstimatedKind) -> EstimatedDepth {
        let value = |p: DVec2| match kind {
            EstimatedKind::Depth => 3.0 / truth(p),
            EstimatedKind::ShiftedDepth => 3.0 / truth(p) - 2.0,
            EstimatedKind::ShiftedInverse => 40.0 * truth(p) - 5.0,
        };
        EstimatedDepth { maps: vec![map(value)], kind, confidence: None }
    }

    const KINDS: [EstimatedKind; 3] =
        [EstimatedKind::Depth, EstimatedKind::ShiftedDepth, EstimatedKind::ShiftedInverse];

    #[test]
    fn a_frames_own_scale_and_shift_are_found() {
        for kind in KINDS {
            let found = aligned(&told(kind), &[seen()], &nothing_moves());
            // The estimate is correct, and a ninth of the triangulated pixels are not.
            assert!(found[0].deviation(0) < 0.003, "{kind:?}: {}", found[0].deviation(0));
            for (i, d) in found[0].inverse.iter().enumerate() {
                let expected = truth(centre(i));
                assert!(
                    (d / expected - 1.0).abs() < 1e-3,
                    "{kind:?} {}: {d} {expected}",
                    centre(i)
                );
            }
        }
    }

    #[test]
    fn confidence_says_where_deviations_are_larger() {
        // The error is 2 % on the right and 1 % on the left, with both signs. It is 0 at every third pixel,
        // which determines the scale.
        let left = |p: DVec2| p.x < 0.5 * f64::from(WIDTH);
        let off = |p: DVec2| {
            let by = if left(p) { 0.01 } else { 0.02 };
            1.0 + by * f64::from((p.x as u32 / 3 + p.y as u32) % 3) - by
        };
        let mut estimated = told(EstimatedKind::Depth);
        estimated.maps[0] = map(|p| 3.0 / truth(p) * off(p) as f32);
        estimated.confidence = Some(vec![map(|p| if left(p) { 8.0 } else { 4.0 })]);
        let found = aligned(&estimated, &[seen()], &nothing_moves());
        let last = found[0].inverse.len() - 1;
        let [left, right] = [0, last].map(|i| f64::from(found[0].deviation(i)));
        let expected = 0.01 / NORMAL_MEDIAN;
        assert!((right / left - 2.0).abs() < 1e-5, "{left} {right}");
        assert!((left / expected - 1.0).abs() < 0.1, "{left} {expected}");
    }

    #[test]
    fn what_is_unknown_stays_so() {
        let mut estimated = told(EstimatedKind::ShiftedInverse);
        // The values are NaN and one beyond infinity.
        (estimated.maps[0].pixels[7], estimated.maps[0].pixels[8]) = (f32::NAN, -1e3);
        let found = aligned(&estimated, &[seen()], &nothing_moves());
        assert_eq!((found[0].inverse[7], found[0].inverse[8]), (0.0, 0.0));
        assert!(found[0].inverse[9] > 0.0);
    }

    #[test]
    fn what_contradicts_the_scene_is_not_taken() {
        // The depth order is reversed.
        let mut estimated = told(EstimatedKind::ShiftedInverse);
        estimated.maps[0].pixels.iter_mut().for_each(|x| *x = -*x);
        // The second frame is correct, so only the first one is rejected.
        estimated.maps.extend(told(EstimatedKind::ShiftedInverse).maps);
        let masks = [nothing_moves(), nothing_moves()].concat();
        let found = aligned(&estimated, &[seen(), seen()], &masks);
        assert!(found[0].inverse.iter().all(|d| *d == 0.0));
        assert!(found[1].inverse.iter().all(|d| *d > 0.0));
    }

    #[test]
    fn without_parallax_the_unit_is_the_median_depth() {
        let blind = Seen { deviation: vec![f32::INFINITY; seen().score.len()], ..seen() };
        for kind in [EstimatedKind::Depth, EstimatedKind::ShiftedInverse] {
            let found = aligned(&told(kind), std::slice::from_ref(&blind), &nothing_moves());
            let median = quantile(found[0].inverse.iter().map(|d| f64::from(*d)).collect(), 0.5);
            assert!((median - 1.0).abs() < 0.02, "{kind:?}: {median}");
        }
    }

    /// A mover at a fixed place in the image, flat at a depth of 2. The network's inverse depth of each of
    /// its pixels is 1.5 times the exponential of `told`. Returns the logarithm of the change of each pixel's
    /// inverse depth.
    fn shaped(open: bool, told: impl Fn(usize, DVec2) -> f64) -> Vec<f64> {
        let inside = |p: DVec2| within(p, (14.0, 8.0), (44.0, 32.0));
        let n = (WIDTH * HEIGHT) as usize;
        let own: Vec<Option<u16>> = (0..n).map(|i| inside(centre(i)).then_some(0)).collect();
        let mut pixels: Vec<Vec<Option<(f32, f32)>>> =
            vec![own.iter().map(|own| own.map(|_| (0.5, 0.4))).collect(); FRAMES];
        let layer = |f: usize| Layer {
            inverse: vec![0.1; n],
            confidence: vec![1.0; n],
            supplied: vec![false; n],
            estimated: (0..n).map(|i| (1.5 * told(f, centre(i)).exp()) as f32).collect(),
        };
        let layers: Vec<Layer> = (0..FRAMES).map(layer).collect();
        let flow = flow(|_, _| DVec2::ZERO);
        shape(&mut pixels, &vec![own; FRAMES], &[open], &layers, &flow);
        let nearer =
            pixels[2].iter().flatten().map(|(inverse, _)| (f64::from(*inverse) / 0.5).ln());
        nearer.collect()
    }

    /// A bulge with a median of 0.
    fn bulge(p: DVec2) -> f64 {
        0.2 * (0.3 * (p.x - 29.0)).sin()
    }

    /// Noise without a pattern, different in each frame.
    fn noise(f: usize, p: DVec2) -> f64 {
        0.1 * (41.3 * p.x + 17.9 * p.y + 57.7 * (f as f64 + 1.3).powi(2)).sin()
    }

    fn root_mean_square(of: impl Iterator<Item = f64>) -> f64 {
        let (sum, n) = of.fold((0.0, 0.0), |(sum, n), x| (sum + x * x, n + 1.0));
        (sum / n).sqrt()
    }

    #[test]
    fn a_shape_that_lasts_is_taken() {
        let inside = |i: &usize| within(centre(*i), (14.0, 8.0), (44.0, 32.0));
        let truth: Vec<f64> =
            (0..(WIDTH * HEIGHT) as usize).filter(inside).map(|i| bulge(centre(i))).collect();
        let found = shaped(true, |_, p| bulge(p));
        let off = root_mean_square(found.iter().zip(&truth).map(|(a, b)| a - b));
        assert!(off < 0.01, "{off}");
        let found = shaped(true, |f, p| bulge(p) + noise(f, p));
        let off = root_mean_square(found.iter().zip(&truth).map(|(a, b)| a - b));
        assert!(off < 0.5 * root_mean_square((0..500).map(|i| noise(2, centre(i)))), "{off}");
    }

    #[test]
    fn one_that_changes_from_frame_to_frame_is_not() {
        let left = root_mean_square(shaped(true, noise).into_iter());
        assert!(left < 0.015, "{left}");
        assert!(shaped(false, |_, p| bulge(p)).iter().all(|nearer| nearer.abs() < 1e-6));
    }
}
