//! The first Gaussians, from points.

use crate::data::Point;
use crate::types::{Gaussians, SH_C0, range, sh_coefficients};
use rayon::prelude::*;
use rstar::RTree;
use rstar::primitives::GeomWithData;

/// Opacity of a Gaussian that has just been seeded.
pub const FIRST_OPACITY: f32 = 0.1;

/// The logit of [`FIRST_OPACITY`].
pub(super) fn first_logit() -> f32 {
    (FIRST_OPACITY / (1.0 - FIRST_OPACITY)).ln()
}

/// One Gaussian per point, as in the initialisation of 3D Gaussian Splatting: isotropic, with the root
/// mean square of the distances to the three nearest other points as scale, opacity 0.1 and the point's
/// colour. A point that is not finite or beyond [`range::REACH`] is not counted as a neighbour; a
/// training rejects its Gaussian.
pub fn seed_from_points(points: &[Point], sh_degree: u32) -> Gaussians {
    let count = points.len();
    let coefficients = sh_coefficients(sh_degree);
    let positions: Vec<[f32; 3]> = points.iter().map(|p| p.position).collect();
    let mut sh = vec![[0.0; 3]; count * coefficients];
    for (row, point) in sh.chunks_exact_mut(coefficients).zip(points) {
        row[0] = point.colour.map(|c| (c - 0.5) / SH_C0);
    }
    Gaussians {
        log_scales: nearest_distances(&positions).into_iter().map(|d| [d.ln(); 3]).collect(),
        rotations: vec![[1.0, 0.0, 0.0, 0.0]; count],
        opacity_logits: vec![first_logit(); count],
        positions,
        sh_degree,
        sh,
        motion_logits: Vec::new(),
    }
}

/// Smallest scale, as a share of the median scale, for points that coincide.
const LEAST_SHARE: f32 = 1e-3;
/// The scale where no point has a distinct neighbour, world units.
const LONELY: f32 = 3.162_277_6e-4;

/// Root mean square distance of every point to its three nearest others; at least [`LEAST_SHARE`] of the
/// median.
fn nearest_distances(points: &[[f32; 3]]) -> Vec<f32> {
    // The tree orders distances and panics on NaN.
    let usable = |p: &[f32; 3]| p.iter().all(|v| v.abs() <= range::REACH);
    let entries = points.iter().enumerate().filter(|(_, p)| usable(p));
    let entries = entries.map(|(i, p)| GeomWithData::new(*p, i)).collect();
    let tree: RTree<GeomWithData<[f32; 3], usize>> = RTree::bulk_load(entries);
    let squared = |a: [f32; 3], b: [f32; 3]| (0..3).map(|k| (a[k] - b[k]).powi(2)).sum::<f32>();
    let mut distances: Vec<f32> = points
        .par_iter()
        .enumerate()
        .map(|(i, &point)| {
            if !usable(&point) {
                return 0.0;
            }
            let others = tree.nearest_neighbor_iter(point).filter(|other| other.data != i).take(3);
            let (mut sum, mut count) = (0.0, 0);
            for other in others {
                sum += squared(point, *other.geom());
                count += 1;
            }
            (sum / count.max(1) as f32).sqrt()
        })
        .collect();
    let mut apart: Vec<f32> = distances.iter().copied().filter(|d| *d > 0.0).collect();
    let middle = apart.len() / 2;
    let least = match apart.is_empty() {
        true => LONELY,
        false => LEAST_SHARE * *apart.select_nth_unstable_by(middle, f32::total_cmp).1,
    };
    distances.iter_mut().for_each(|d| *d = d.max(least));
    distances
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scales_come_from_the_nearest_points() {
        let at = |x: f32| Point { position: [x, 0.0, 0.0], colour: [0.5, 1.0, 0.0] };
        let seeded = seed_from_points(&[at(0.0), at(1.0), at(3.0), at(103.0)], 1);
        let expected = ((1.0f32 + 9.0 + 103.0 * 103.0) / 3.0).sqrt().ln();
        assert!((seeded.log_scales[0][2] - expected).abs() < 1e-5);
        assert_eq!(seeded.sh.len(), 4 * 4);
        assert!((0.5 + SH_C0 * seeded.sh[4][1] - 1.0).abs() < 1e-6);
        // Points that coincide, and one alone, still get a finite scale.
        for points in [vec![at(1.0); 5], vec![at(1.0)]] {
            let seeded = seed_from_points(&points, 0);
            assert!(seeded.log_scales.iter().flatten().all(|s| s.is_finite()));
        }
        // Numbers that the file readers reject affect only their own point.
        for wild in [1e19, 1e38, f32::MAX, f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            let seeded = seed_from_points(&[at(0.0), at(wild), at(1.0), at(3.0), at(103.0)], 1);
            assert!(seeded.log_scales.iter().flatten().all(|s| s.is_finite()), "{wild}");
            assert!((seeded.log_scales[0][2] - expected).abs() < 1e-5, "{wild}");
        }
    }
}
