//! The start of the flow at the coarsest level: semi-global matching (Hirschmüller 2008) of census
//! transforms over a two-dimensional window of displacements. All in whole numbers.

use super::pyramid::clamp;
use crate::oracle::Real;
use crate::types::FlowSettings;

/// The signs of the 24 neighbours in a 5×5 window against its centre: bit set where the neighbour
/// is brighter. Immune to any change of lighting that keeps the order of values.
pub fn census<T: Real>(luma: &[T], width: usize, height: usize) -> Vec<u32> {
    let mut out = Vec::with_capacity(luma.len());
    for y in 0..height as isize {
        for x in 0..width as isize {
            let centre = luma[y as usize * width + x as usize];
            let (mut bits, mut n) = (0u32, 0);
            for j in -2..=2 {
                for i in -2..=2 {
                    if (i, j) != (0, 0) {
                        let q = clamp(y + j, height) * width + clamp(x + i, width);
                        bits |= u32::from(luma[q] > centre) << n;
                        n += 1;
                    }
                }
            }
            out.push(bits);
        }
    }
    out
}

/// Where a path comes from: the previous pixel of left-to-right, right-to-left, top-down, bottom-up.
pub const PATHS: [(isize, isize); 4] = [(-1, 0), (1, 0), (0, -1), (0, 1)];

/// The cost of matching a pixel with a place outside the other image.
pub const OUTSIDE: u32 = 8;

/// Adds to `volume` the costs accumulated along one of `PATHS`.
///
/// `volume` holds, per pixel, `(2·radius + 1)²` displacements, row by row from (−radius, −radius).
/// A step of one between neighbouring pixels costs `small`, any greater one `large`.
pub fn accumulate(
    a: &[u32],
    b: &[u32],
    [width, height]: [usize; 2],
    radius: usize,
    path: usize,
    [small, large]: [u32; 2],
    volume: &mut [u32],
) {
    let side = 2 * radius + 1;
    let labels = side * side;
    let (dx, dy) = PATHS[path];
    let (length, lines) = if dx != 0 { (width, height) } else { (height, width) };
    let mut previous = vec![0u32; labels];
    let mut current = vec![0u32; labels];
    for line in 0..lines {
        for step in 0..length {
            let along = if dx + dy < 0 { step } else { length - 1 - step };
            let (x, y) = if dx != 0 { (along, line) } else { (line, along) };
            let p = y * width + x;
            let least = previous.iter().copied().min().unwrap_or(0);
            for l in 0..labels {
                let (i, j) = (l % side, l / side);
                let (tx, ty) = ((x + i) as isize, (y + j) as isize);
                let (tx, ty) = (tx - radius as isize, ty - radius as isize);
                let inside = tx >= 0 && ty >= 0 && tx < width as isize && ty < height as isize;
                let cost = if inside {
                    (a[p] ^ b[ty as usize * width + tx as usize]).count_ones()
                } else {
                    OUTSIDE
                };
                current[l] = if step == 0 {
                    cost
                } else {
                    let mut best = previous[l].min(least + large);
                    if i > 0 {
                        best = best.min(previous[l - 1] + small);
                    }
                    if i + 1 < side {
                        best = best.min(previous[l + 1] + small);
                    }
                    if j > 0 {
                        best = best.min(previous[l - side] + small);
                    }
                    if j + 1 < side {
                        best = best.min(previous[l + side] + small);
                    }
                    cost + best - least
                };
                volume[p * labels + l] += current[l];
            }
            std::mem::swap(&mut previous, &mut current);
        }
    }
}

/// The cheapest displacement of each pixel; of equal ones the shortest, then the first.
pub fn cheapest<T: Real>(volume: &[u32], radius: usize) -> Vec<[T; 2]> {
    let side = 2 * radius + 1;
    let offset = |l: usize| {
        let (i, j) = ((l % side) as i64, (l / side) as i64);
        (i - radius as i64, j - radius as i64)
    };
    let key = |(l, cost): (usize, &u32)| {
        let (u, v) = offset(l);
        (*cost, u * u + v * v, l)
    };
    volume
        .chunks_exact(side * side)
        .map(|costs| {
            let (_, _, l) = costs.iter().enumerate().map(key).min().unwrap_or_default();
            let (u, v) = offset(l);
            [T::of(u as f64), T::of(v as f64)]
        })
        .collect()
}

/// The whole stage: from the luminance of both images at the coarsest level to a flow.
pub fn coarse<T: Real>(
    a: &[T],
    b: &[T],
    width: usize,
    height: usize,
    settings: &FlowSettings,
) -> Vec<[T; 2]> {
    let radius = settings.start_radius as usize;
    let penalties = [settings.start_small_step, settings.start_large_step];
    let (a, b) = (census(a, width, height), census(b, width, height));
    let mut volume = vec![0; width * height * (2 * radius + 1).pow(2)];
    for path in 0..PATHS.len() {
        accumulate(&a, &b, [width, height], radius, path, penalties, &mut volume);
    }
    cheapest(&volume, radius)
}
