//! Choosing control points: farthest-point sampling.

use crate::{Error, Result};
use rayon::prelude::*;

/// Indices of up to `count` points, each as far as possible from all before it (Gonzalez 1985). The
/// result covers the set evenly, and so does every prefix of it.
///
/// `points` holds rows of `dims` values; `dims` may be large (positions at many times, side by side,
/// sample trajectories). The seed selects the first point. Ties go to the lower index. Rows with a value
/// that is not finite are never chosen. The sampling ends early when all remaining points coincide with
/// a chosen one.
///
/// # Errors
///
/// [`Error::Shape`] when the values do not make up whole rows.
pub fn farthest_point_sample(
    points: &[f32],
    dims: usize,
    count: usize,
    seed: u64,
) -> Result<Vec<usize>> {
    if dims == 0 || !points.len().is_multiple_of(dims) {
        return Err(Error::Shape {
            op: "farthest-point sampling",
            arg: "points",
            expected: format!("a multiple of {dims}, the values per point, and that above 0"),
            actual: points.len(),
        });
    }
    let row = |index: usize| &points[index * dims..(index + 1) * dims];
    let rows: Vec<usize> =
        (0..points.len() / dims).filter(|&i| row(i).iter().all(|v| v.is_finite())).collect();
    if rows.is_empty() || count == 0 {
        return Ok(Vec::new());
    }
    // Fibonacci hashing spreads neighbouring seeds.
    let first = (seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 32) as usize % rows.len();
    let mut chosen = vec![rows[first]];
    let mut distances = vec![f64::INFINITY; rows.len()];
    while chosen.len() < count.min(rows.len()) {
        let last = row(chosen[chosen.len() - 1]);
        let farthest = distances
            .par_iter_mut()
            .zip(&rows)
            .enumerate()
            .map(|(place, (distance, &index))| {
                let squared: f64 = row(index)
                    .iter()
                    .zip(last)
                    .map(|(&a, &b)| (f64::from(a) - f64::from(b)).powi(2))
                    .sum();
                *distance = distance.min(squared);
                (*distance, place)
            })
            // A total order makes the result independent of how the work is split.
            .reduce(
                || (-1.0, usize::MAX),
                |a, b| if (b.0 > a.0) || (b.0 == a.0 && b.1 < a.1) { b } else { a },
            );
        if farthest.0 <= 0.0 {
            break;
        }
        chosen.push(rows[farthest.1]);
    }
    Ok(chosen)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn corners_come_first() {
        let mut points: Vec<f32> = Vec::new();
        for y in 0..11 {
            for x in 0..11 {
                points.extend([x as f32, y as f32]);
            }
        }
        let chosen = farthest_point_sample(&points, 2, 5, 3).unwrap();
        let corners = [0, 10, 110, 120];
        assert!(corners.iter().filter(|c| chosen.contains(c)).count() >= 3, "{chosen:?}");
        assert_eq!(chosen, farthest_point_sample(&points, 2, 5, 3).unwrap());
    }

    #[test]
    fn every_prefix_covers_within_twice_the_best_radius() {
        // On a line of 0..=100, k points cover at best with radius 100 / 2k.
        let points: Vec<f32> = (0..=100).map(|i| i as f32).collect();
        let chosen = farthest_point_sample(&points, 1, 20, 5).unwrap();
        for k in 1..=20 {
            let radius = points
                .iter()
                .map(|p| chosen[..k].iter().map(|&c| (points[c] - p).abs()).fold(1e9, f32::min))
                .fold(0.0, f32::max);
            assert!(radius <= 2.0 * (100.0 / (2.0 * k as f32)) + 1.0, "{k}: {radius}");
        }
    }

    #[test]
    fn coincident_and_broken_points_end_the_sampling() {
        let points = [1.0, 1.0, f32::NAN, 1.0, 2.0, 2.0, 1.0, 1.0];
        let mut chosen = farthest_point_sample(&points, 2, 9, 0).unwrap();
        chosen.sort();
        assert!(chosen == [0, 2] || chosen == [2, 3], "{chosen:?}");
        assert_eq!(farthest_point_sample(&[], 3, 4, 0).unwrap(), [0usize; 0]);
        assert_eq!(farthest_point_sample(&points, 2, 0, 0).unwrap(), [0usize; 0]);
        assert!(farthest_point_sample(&points, 3, 4, 0).is_err());
        assert!(farthest_point_sample(&points, 0, 4, 0).is_err());
    }
}
