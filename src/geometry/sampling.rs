//! A subset of correspondences that covers the image and all depths.

use glam::DVec2;

/// Number of cells along the longer side of the image.
const CELLS: usize = 16;
/// Number of depth layers, with equally many correspondences each.
const LAYERS: usize = 4;

/// At most `cap` indices in ascending order, taken in turn from the cells of a spatial grid times four
/// layers of depth; within a cell, those with the largest weights come first. Neither a textured corner nor
/// a single depth then dominates a pose.
///
/// `depths` and `weights` are per pixel (entries with a weight of 0 or non-finite values are never taken).
/// The lists are read up to the shortest of the three.
pub fn spread_subset(pixels: &[DVec2], depths: &[f64], weights: &[f64], cap: usize) -> Vec<usize> {
    let count = pixels.len().min(depths.len()).min(weights.len());
    let usable: Vec<usize> = (0..count)
        .filter(|&i| {
            pixels[i].is_finite()
                && depths[i].is_finite()
                && weights[i].is_finite()
                && weights[i] > 0.0
        })
        .collect();
    if usable.len() <= cap {
        return usable;
    }
    let mut by_depth = usable.clone();
    by_depth.sort_by(|&a, &b| depths[a].total_cmp(&depths[b]).then(a.cmp(&b)));
    let low = usable.iter().fold(DVec2::INFINITY, |m, &i| m.min(pixels[i]));
    let high = usable.iter().fold(DVec2::NEG_INFINITY, |m, &i| m.max(pixels[i]));
    let size = (high - low).max_element().max(f64::MIN_POSITIVE);
    let mut cells = vec![Vec::new(); CELLS * CELLS * LAYERS];
    for (rank, &i) in by_depth.iter().enumerate() {
        let place = (pixels[i] - low) / size * CELLS as f64;
        let (x, y) = ((place.x as usize).min(CELLS - 1), (place.y as usize).min(CELLS - 1));
        let layer = rank * LAYERS / by_depth.len();
        cells[(layer * CELLS + y) * CELLS + x].push(i);
    }
    for cell in &mut cells {
        cell.sort_by(|&a: &usize, &b| weights[b].total_cmp(&weights[a]).then(a.cmp(&b)));
    }
    let mut taken = Vec::with_capacity(cap);
    for round in 0.. {
        for cell in &cells {
            if taken.len() == cap {
                taken.sort_unstable();
                return taken;
            }
            taken.extend(cell.get(round));
        }
    }
    taken
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn covers_the_image_and_the_depths_and_prefers_weight() {
        // 3,900 points in one corner at one depth, 100 elsewhere.
        let pixels: Vec<DVec2> = (0..4000)
            .map(|i| {
                let t = f64::from(i % 63) / 63.0;
                if i < 3900 {
                    DVec2::new(t, t * t)
                } else {
                    DVec2::new(f64::from(i % 100) * 6.0, 300.0)
                }
            })
            .collect();
        let depths: Vec<f64> = (0..4000).map(|i| if i < 3900 { 1.0 } else { 5.0 }).collect();
        let weights: Vec<f64> = (0..4000).map(|i| if i % 2 == 0 { 1.0 } else { 0.5 }).collect();
        let taken = spread_subset(&pixels, &depths, &weights, 200);
        assert_eq!(taken.len(), 200);
        assert!(taken.windows(2).all(|w| w[0] < w[1]));
        assert!(taken.iter().filter(|&&i| i >= 3900).count() >= 90);
        assert!(taken.iter().filter(|&&i| i < 3900).all(|&i| i % 2 == 0));
    }

    #[test]
    fn small_or_bad_lists() {
        let p = [DVec2::ZERO, DVec2::NAN, DVec2::ONE];
        assert_eq!(spread_subset(&p, &[1.0; 3], &[1.0; 3], 5), vec![0, 2]);
        assert_eq!(spread_subset(&p, &[1.0; 3], &[0.0, 1.0, 1.0], 5), vec![2]);
        assert_eq!(spread_subset(&[DVec2::ZERO; 9], &[1.0; 9], &[1.0; 9], 3), vec![0, 3, 5]);
        assert!(spread_subset(&[DVec2::ZERO; 9], &[1.0; 9], &[1.0; 9], 0).is_empty());
        assert!(spread_subset(&[], &[], &[], 3).is_empty());
    }
}
