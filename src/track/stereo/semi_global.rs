//! Selects one level per pixel so that the matches are good and neighbours agree.
//!
//! Semi-global matching (Hirschmüller 2008): along eight directions, dynamic programming accumulates the
//! least sum of matching costs and of penalties for jumps between neighbours. The level with the least total
//! over all directions is selected.

use super::patch::difference;
use super::sweep::Volume;
use crate::types::Image;

/// Penalties for a step to the next level (`STEP`) and for a jump to any level (`JUMP`: across a strong
/// colour edge, and between equal colours).
const STEP: i16 = 6;
const JUMP: (i16, i16) = (14, 60);
/// Colour difference at which the extra penalty of a jump falls to 1/e.
const EDGE: f32 = 0.05;

/// Sums over all directions per pixel and level, levels contiguous.
pub(super) fn sums(volume: &Volume, image: &Image) -> Vec<i16> {
    let Volume { width, height, levels, .. } = *volume;
    let mut total = vec![0i16; width * height * levels];
    let directions: [(isize, isize); 8] =
        [(1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, 1), (1, -1), (-1, -1)];
    for (dx, dy) in directions {
        // The accumulated costs of the previous row and of this row.
        let mut before = vec![0i16; width * levels];
        let mut here = vec![0i16; width * levels];
        for step in 0..height {
            let y = if dy < 0 { height - 1 - step } else { step };
            for across in 0..width {
                let x = if dx < 0 { width - 1 - across } else { across };
                let i = y * width + x;
                let (from_x, from_y) = (x as isize - dx, y as isize - dy);
                let inside =
                    (0..width as isize).contains(&from_x) && (0..height as isize).contains(&from_y);
                let costs = volume.of(i);
                let sum = &mut total[i * levels..][..levels];
                if !inside {
                    let carried = &mut here[x * levels..][..levels];
                    for ((carried, cost), sum) in carried.iter_mut().zip(costs).zip(sum) {
                        *carried = i16::from(*cost);
                        *sum += *carried;
                    }
                    continue;
                }
                let from = from_y as usize * width + from_x as usize;
                let jump = jump(difference(image, i, from));
                let from_x = from_x as usize;
                if dy == 0 {
                    // Both lie in `here`.
                    let (a, b) = (from_x * levels, x * levels);
                    let (low, high) = here.split_at_mut(a.max(b));
                    let (last, carried) = match a < b {
                        true => (&low[a..][..levels], &mut high[..levels]),
                        false => (&high[..levels], &mut low[b..][..levels]),
                    };
                    carry(last, costs, jump, carried, sum);
                } else {
                    let last = &before[from_x * levels..][..levels];
                    carry(last, costs, jump, &mut here[x * levels..][..levels], sum);
                }
            }
            std::mem::swap(&mut before, &mut here);
        }
    }
    total
}

/// The penalty for a jump between two pixels with a colour difference.
fn jump(difference: f32) -> i16 {
    JUMP.0 + (f32::from(JUMP.1 - JUMP.0) * (-difference / EDGE).exp()) as i16
}

fn carry(last: &[i16], costs: &[u8], jump: i16, carried: &mut [i16], sum: &mut [i16]) {
    let n = costs.len();
    let least = last.iter().copied().min().unwrap_or(0);
    let any = least + jump;
    let at = |l: usize| {
        let mut best = last[l].min(any);
        if l > 0 {
            best = best.min(last[l - 1] + STEP);
        }
        if l + 1 < n {
            best = best.min(last[l + 1] + STEP);
        }
        i16::from(costs[l]) + best - least
    };
    let ends = if n > 1 { [0, n - 1] } else { [0, 0] };
    for l in ends {
        carried[l] = at(l);
    }
    if n > 2 {
        let (below, same, above) = (&last[..n - 2], &last[1..n - 1], &last[2..n]);
        let (inner, costs) = (&mut carried[1..n - 1], &costs[1..n - 1]);
        for l in 0..n - 2 {
            let best = same[l].min(any).min(below[l].min(above[l]) + STEP);
            inner[l] = i16::from(costs[l]) + best - least;
        }
    }
    for (sum, carried) in sum.iter_mut().zip(carried.iter()) {
        *sum += carried;
    }
}

/// The level with the least sum, at fractions, and that sum. The fraction is the vertex of the parabola
/// through the least sum and its neighbours.
pub(super) fn best(sums: &[i16]) -> (f64, i16) {
    let (l, &least) = sums.iter().enumerate().min_by_key(|(_, sum)| **sum).unwrap();
    if l == 0 || l + 1 == sums.len() {
        return (l as f64, least);
    }
    let [a, b, c] = [sums[l - 1], least, sums[l + 1]].map(f64::from);
    let bend = a - 2.0 * b + c;
    let off = if bend > 0.0 { (0.5 * (a - c) / bend).clamp(-0.5, 0.5) } else { 0.0 };
    (l as f64 + off, least)
}

#[cfg(test)]
mod tests {
    use super::*;

    const LEVELS: usize = 12;

    /// An image that is dark to the left of column `edge`, and a cost volume with the correct level per
    /// column; all levels cost the same in a column without one.
    fn clip(edge: u32, right: impl Fn(u32) -> Option<usize>) -> (Volume, Image) {
        let (width, height) = (16, 9);
        let mut image = Image::new(width, height, 3);
        let mut costs = Vec::new();
        for y in 0..height {
            for x in 0..width {
                image.at_mut(x, y).fill(if x < edge { 0.2 } else { 0.8 });
                let cost = |l| right(x).map_or(50, |right: usize| if l == right { 10 } else { 90 });
                costs.extend((0..LEVELS).map(cost));
            }
        }
        let (width, height) = (width as usize, height as usize);
        (Volume { width, height, levels: LEVELS, costs }, image)
    }

    fn levels(volume: &Volume, image: &Image) -> Vec<f64> {
        sums(volume, image).chunks_exact(LEVELS).map(|sums| best(sums).0).collect()
    }

    #[test]
    fn what_is_blank_is_filled_up_to_the_edge_of_colour() {
        // The level is known at both sides only; between them only the colour edge separates the two.
        let known = |x| (x < 3).then_some(2).or((x >= 10).then_some(9));
        let (volume, image) = clip(6, known);
        for (i, level) in levels(&volume, &image).into_iter().enumerate() {
            let expected = if i % 16 < 6 { 2.0 } else { 9.0 };
            assert_eq!(level, expected, "column {}", i % 16);
        }
    }

    #[test]
    fn one_pixel_that_matches_elsewhere_is_overruled() {
        let (mut volume, image) = clip(0, |_| Some(4));
        let odd = (4 * 16 + 8) * LEVELS;
        volume.costs[odd + 4] = 60;
        volume.costs[odd + 10] = 30;
        assert!(levels(&volume, &image).iter().all(|level| *level == 4.0));
    }

    #[test]
    fn the_vertex_between_levels_is_found() {
        // 4 (l − 3.25)² at whole numbers.
        let sums: Vec<i16> = (0..8).map(|l| (4.0 * (f64::from(l) - 3.25).powi(2)) as i16).collect();
        let (level, least) = best(&sums);
        assert!((level - 3.25).abs() < 0.1 && least == sums[3], "{level}");
        assert_eq!(best(&[1, 2, 3]), (0.0, 1));
        assert_eq!(best(&[5]), (0.0, 5));
    }
}
