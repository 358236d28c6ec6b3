//! Depth that a network has estimated from single frames, brought to the world's unit.
//!
//! Such depth shows shapes and what is nearer than what, but leaves open a scale, and often a shift,
//! which differ from frame to frame. Both are fitted to what was triangulated of the static world in the same
//! frame (Ranftl et al., "Towards Robust Monocular Depth Estimation", TPAMI 2022, align so to compare):
//! first by the least median of residuals, so that neither what the network gets wrong nor what was
//! triangulated wrongly pulls, then by what agrees with that.

use super::quantile;
use super::residual::Seen;
use crate::observe::{EstimatedDepth, EstimatedKind};
use crate::types::Image;

/// A frame is aligned by so many pixels at least, of every so many.
const LEAST: usize = 50;
const EVERY: usize = 5;
/// What was triangulated is compared with where its relative deviation is less, and what it leaves
/// unexplained, in deviations.
const CERTAIN: (f32, f32) = (0.1, 4.0);
/// Lines that are tried to begin with, and a number without a common factor with that.
const CANDIDATES: usize = 128;
const STRIDE: usize = 37;
/// Rounds of reweighting by Tukey's biweight, its width in median residuals, and that at least.
const ROUNDS: usize = 10;
const WIDTH: f64 = 6.0;
const ALIKE: f64 = 0.005;

/// Inverse depth of each frame in the world's unit, 0 where unknown, also in all of a frame that cannot be
/// aligned. Without anything to compare with in any frame, the median depth of all is the unit.
pub(super) fn aligned(estimated: &EstimatedDepth, seen: &[Seen], masks: &[Image]) -> Vec<Vec<f32>> {
    let EstimatedDepth { maps, kind } = estimated;
    let fits: Vec<Option<Line>> = maps
        .iter()
        .zip(seen)
        .zip(masks)
        .map(|((map, seen), mask)| fit(*kind, &pairs(*kind, map, seen, mask)))
        .collect();
    let blind = fits.iter().all(Option::is_none).then(|| usual(estimated));
    maps.iter()
        .zip(fits)
        .map(|(map, fit)| {
            let line = fit.or(blind);
            map.pixels
                .iter()
                .map(|told| line.map_or(0.0, |line| line.inverse(*kind, *told)))
                .collect()
        })
        .collect()
}

/// What is fitted: `factor` x + `shift`, of inverse depth or of depth.
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

/// What a line is fitted to, of what a map holds: inverse depth, or depth where that is shifted.
fn known(kind: EstimatedKind, told: f32) -> Option<f64> {
    let told = f64::from(told);
    match kind {
        EstimatedKind::Depth => (told > 0.0 && told.is_finite()).then(|| told.recip()),
        EstimatedKind::ShiftedDepth => (told.is_finite() && told != 0.0).then_some(told),
        EstimatedKind::ShiftedInverse => told.is_finite().then_some(told),
    }
}

/// What the map says (x) and the inverse depth that was triangulated, of static pixels.
fn pairs(kind: EstimatedKind, map: &Image, seen: &Seen, mask: &Image) -> Vec<(f64, f64)> {
    let pair = |i: usize| {
        let d = seen.inverse_depth[i];
        let certain = seen.support[i] >= 0.5
            && seen.deviation[i] < CERTAIN.0 * d
            && seen.score[i] < CERTAIN.1
            && mask.pixels[i] <= 0.5;
        certain.then(|| known(kind, map.pixels[i])).flatten().map(|x| (x, f64::from(d)))
    };
    (0..map.pixels.len()).step_by(EVERY).filter_map(pair).collect()
}

/// The line that most pairs agree with; none through too few pairs, or where what
/// is said to be farther is nearer.
fn fit(kind: EstimatedKind, pairs: &[(f64, f64)]) -> Option<Line> {
    if pairs.len() < LEAST {
        return None;
    }
    if kind == EstimatedKind::Depth {
        let factor = quantile(pairs.iter().map(|(x, d)| d / x).collect(), 0.5);
        return Some(Line { factor, shift: 0.0 });
    }
    // Residuals are relative: (factor x + shift) / y − 1, with y inverse depth or depth.
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
    // Lines through two, one near and one far, by the median of what they leave.
    let mut by_told: Vec<usize> = (0..rows.len()).collect();
    by_told.sort_by(|i, j| pairs[*i].0.total_cmp(&pairs[*j].0));
    let third = rows.len() / 3;
    let through = |k: usize| {
        // Each with each other only once, evenly spread.
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
        let width = (WIDTH * spread(&line)).max(ALIKE);
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
        // One depth throughout determines no shift.
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

/// Without anything to compare with: no shift, and a median depth of 1.
fn usual(estimated: &EstimatedDepth) -> Line {
    let all = estimated.maps.iter().flat_map(|map| map.pixels.iter().step_by(EVERY));
    let x: Vec<f64> = all.filter_map(|told| known(estimated.kind, *told)).collect();
    let median = quantile(x, 0.5);
    Line { factor: if median > 0.0 { median.recip() } else { 1.0 }, shift: 0.0 }
}

#[cfg(test)]
mod tests {
    use super::super::sliding::*;
    use super::*;
    use glam::DVec2;

    /// Ground that comes nearer towards the lower border.
    fn truth(p: DVec2) -> f32 {
        0.1 + 0.01 * p.y as f32
    }

    /// It triangulated, one pixel in nine wrongly.
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

    /// A map of a kind, with a scale and a shift of its own.
    fn told(kind: EstimatedKind) -> EstimatedDepth {
        let value = |p: DVec2| match kind {
            EstimatedKind::Depth => 3.0 / truth(p),
            EstimatedKind::ShiftedDepth => 3.0 / truth(p) - 2.0,
            EstimatedKind::ShiftedInverse => 40.0 * truth(p) - 5.0,
        };
        EstimatedDepth { maps: vec![map(value)], kind }
    }

    const KINDS: [EstimatedKind; 3] =
        [EstimatedKind::Depth, EstimatedKind::ShiftedDepth, EstimatedKind::ShiftedInverse];

    #[test]
    fn a_frames_own_scale_and_shift_are_found() {
        for kind in KINDS {
            let found = aligned(&told(kind), &[seen()], &nothing_moves());
            for (i, d) in found[0].iter().enumerate() {
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
    fn what_is_unknown_stays_so() {
        let mut estimated = told(EstimatedKind::ShiftedInverse);
        // Not a number, and farther away than anything can be.
        (estimated.maps[0].pixels[7], estimated.maps[0].pixels[8]) = (f32::NAN, -1e3);
        let found = aligned(&estimated, &[seen()], &nothing_moves());
        assert_eq!((found[0][7], found[0][8]), (0.0, 0.0));
        assert!(found[0][9] > 0.0);
    }

    #[test]
    fn what_contradicts_the_scene_is_not_taken() {
        // Far for near.
        let mut estimated = told(EstimatedKind::ShiftedInverse);
        estimated.maps[0].pixels.iter_mut().for_each(|x| *x = -*x);
        // The second frame is right, so the first one is left out alone.
        estimated.maps.extend(told(EstimatedKind::ShiftedInverse).maps);
        let masks = [nothing_moves(), nothing_moves()].concat();
        let found = aligned(&estimated, &[seen(), seen()], &masks);
        assert!(found[0].iter().all(|d| *d == 0.0));
        assert!(found[1].iter().all(|d| *d > 0.0));
    }

    #[test]
    fn without_parallax_the_unit_is_the_median_depth() {
        let blind = Seen { deviation: vec![f32::INFINITY; seen().score.len()], ..seen() };
        for kind in [EstimatedKind::Depth, EstimatedKind::ShiftedInverse] {
            let found = aligned(&told(kind), std::slice::from_ref(&blind), &nothing_moves());
            let median = quantile(found[0].iter().map(|d| f64::from(*d)).collect(), 0.5);
            assert!((median - 1.0).abs() < 0.02, "{kind:?}: {median}");
        }
    }
}
