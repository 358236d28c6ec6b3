//! Likeness of two images: the share of one that is found in the other, independent of motion.

use rayon::prelude::*;

use crate::types::Image;

/// Side of a block, pixels.
const BLOCK: usize = 16;
/// Distance between adjacent blocks, pixels.
const STEP: usize = 8;
/// Standard deviations of the two blurs of the difference-of-Gaussians filter, which removes noise (finer)
/// and illumination (coarser), pixels.
const FINE: f32 = 0.8;
const COARSE: f32 = 5.0;
/// Standard deviation within a block below which it counts as textureless.
const PLAIN: f32 = 0.005;
/// Minimum number of textured blocks.
const LEAST_BLOCKS: usize = 8;
/// Search radius of a block near its own position, which covers the motion of a calm video, pixels.
const NEAR: usize = 3;
/// Correlation above which a block counts as found near its position.
const SURE: f32 = 0.7;
/// Correlation above which a block counts as found anywhere.
const FOUND: f32 = 0.5;
/// Maximum difference of the motions of neighbouring blocks, pixels.
const APART: usize = 3;
/// Minimum number of neighbouring blocks that must move with a block.
const COMPANY: usize = 2;
/// Mean difference below which one image repeats the other.
const SAME: f32 = 0.0015;

/// A small grey image, prepared for comparisons.
pub(super) struct Picture {
    width: usize,
    height: usize,
    grey: Vec<f32>,
    /// Band-pass filtered values, without noise and illumination.
    details: Vec<f32>,
    /// By upper left corner of a block: root of the sum of squares about the block's mean.
    norms: Vec<f32>,
    /// Upper left corners of the textured blocks, by grid position.
    blocks: Vec<Option<(usize, usize)>>,
    /// Number of blocks in a row of the grid.
    row: usize,
}

impl Picture {
    /// Prepares a grey image.
    pub(super) fn of(image: &Image) -> Picture {
        let (width, height) = (image.width as usize, image.height as usize);
        let grey = image.pixels.clone();
        let (fine, coarse) = (blur(&grey, width, height, FINE), blur(&grey, width, height, COARSE));
        let details: Vec<f32> = fine.iter().zip(&coarse).map(|(f, c)| f - c).collect();
        let mut picture =
            Picture { width, height, grey, details, norms: Vec::new(), blocks: Vec::new(), row: 0 };
        if width < BLOCK || height < BLOCK {
            return picture;
        }
        picture.norms = norms(&picture.details, width, height);
        let along = |side: usize| {
            let spare = (side - BLOCK) % STEP;
            (spare / 2..=side - BLOCK).step_by(STEP)
        };
        picture.row = along(width).count();
        let corners = along(height).flat_map(|y| along(width).map(move |x| (x, y)));
        picture.blocks = corners.map(|at| (picture.norm(at) >= plain()).then_some(at)).collect();
        picture
    }

    /// Whether it has enough texture for comparisons.
    pub(super) fn is_telling(&self) -> bool {
        self.blocks.iter().flatten().count() >= LEAST_BLOCKS
    }

    /// Whether it shows the same content as the other image at the same position.
    pub(super) fn repeats(&self, other: &Picture) -> bool {
        let difference: f32 = self.grey.iter().zip(&other.grey).map(|(a, b)| (a - b).abs()).sum();
        self.has_size_of(other) && difference <= SAME * self.grey.len() as f32
    }

    fn has_size_of(&self, other: &Picture) -> bool {
        (self.width, self.height) == (other.width, other.height)
    }

    /// Number of positions of a block along a row.
    fn places(&self) -> usize {
        self.width - BLOCK + 1
    }

    fn norm(&self, (x, y): (usize, usize)) -> f32 {
        self.norms[y * self.places() + x]
    }

    /// The block at a corner, without its mean and scaled to unit length.
    fn block(&self, (left, top): (usize, usize)) -> [[f32; BLOCK]; BLOCK] {
        let mut block: [[f32; BLOCK]; BLOCK] = std::array::from_fn(|y| {
            let start = (top + y) * self.width + left;
            std::array::from_fn(|x| self.details[start + x])
        });
        let mean = block.iter().flatten().sum::<f32>() / (BLOCK * BLOCK) as f32;
        let scale = 1.0 / self.norm((left, top));
        block.iter_mut().flatten().for_each(|value| *value = (*value - mean) * scale);
        block
    }

    /// Correlation of a block with the one at a corner.
    fn correlation(&self, block: &[[f32; BLOCK]; BLOCK], at: (usize, usize)) -> f32 {
        let norm = self.norm(at);
        if norm < plain() {
            return 0.0;
        }
        let mut sums = [0.0; BLOCK];
        for (y, row) in block.iter().enumerate() {
            let start = (at.1 + y) * self.width + at.0;
            let here = &self.details[start..start + BLOCK];
            for x in 0..BLOCK {
                sums[x] += row[x] * here[x];
            }
        }
        sums.iter().sum::<f32>() / norm
    }

    /// Position with the best correlation of a block within a distance of a corner.
    fn best(
        &self,
        block: &[[f32; BLOCK]; BLOCK],
        (x, y): (usize, usize),
        within: usize,
    ) -> (f32, (usize, usize)) {
        let mut best = (0.0, (0, 0));
        for v in y.saturating_sub(within)..=y.saturating_add(within).min(self.height - BLOCK) {
            for u in x.saturating_sub(within)..=x.saturating_add(within).min(self.width - BLOCK) {
                let found = self.correlation(block, (u, v));
                if found > best.0 {
                    best = (found, (u, v));
                }
            }
        }
        best
    }
}

/// Norm of a textureless block.
fn plain() -> f32 {
    PLAIN * BLOCK as f32
}

/// Share in [0, 1] of the blocks of `a` that are found in `b`: near their positions, or anywhere if the
/// reverse search returns to the block and the blocks around it move with it. Independent of brightness and
/// contrast. Unrelated images have less than 0.1. Zero where the sizes differ.
pub(super) fn likeness(a: &Picture, b: &Picture) -> f32 {
    let blocks = a.blocks.iter().flatten().count();
    if blocks == 0 || !a.has_size_of(b) {
        return 0.0;
    }
    let share = |count: usize| count as f32 / blocks as f32;
    let near = |at: &&(usize, usize)| b.best(&a.block(**at), **at, NEAR).0 >= SURE;
    let near = share(a.blocks.iter().flatten().filter(near).count());
    if near >= 0.5 {
        return near;
    }
    let moved: Vec<Option<(isize, isize)>> =
        a.blocks.par_iter().map(|at| shift(a, b, (*at)?)).collect();
    let together = |i: usize, j: usize| match (moved[i], moved[j]) {
        (Some(p), Some(q)) => p.0.abs_diff(q.0) <= APART && p.1.abs_diff(q.1) <= APART,
        _ => false,
    };
    let (row, rows) = (a.row, moved.len() / a.row);
    let in_company = |&i: &usize| {
        let (x, y) = (i % row, i / row);
        let around = (y.saturating_sub(1)..(y + 2).min(rows))
            .flat_map(|v| (x.saturating_sub(1)..(x + 2).min(row)).map(move |u| v * row + u));
        around.filter(|&j| j != i && together(i, j)).count() >= COMPANY
    };
    near.max(share((0..moved.len()).filter(in_company).count()))
}

/// Displacement of a block of `a` in `b`, if it is found there and the reverse search confirms it.
fn shift(a: &Picture, b: &Picture, at: (usize, usize)) -> Option<(isize, isize)> {
    let (correlation, to) = b.best(&a.block(at), at, usize::MAX);
    if correlation < FOUND {
        return None;
    }
    let (_, back) = a.best(&b.block(to), to, usize::MAX);
    let found_back = back.0.abs_diff(at.0) <= 1 && back.1.abs_diff(at.1) <= 1;
    found_back.then(|| (to.0 as isize - at.0 as isize, to.1 as isize - at.1 as isize))
}

/// By upper left corner of a block: root of the sum of squares about the block's mean.
fn norms(values: &[f32], width: usize, height: usize) -> Vec<f32> {
    // Summed-area table.
    let mut sums = vec![(0.0f64, 0.0f64); (width + 1) * (height + 1)];
    for y in 0..height {
        let mut row = (0.0, 0.0);
        for x in 0..width {
            let value = f64::from(values[y * width + x]);
            row = (row.0 + value, row.1 + value * value);
            let above = sums[y * (width + 1) + x + 1];
            sums[(y + 1) * (width + 1) + x + 1] = (above.0 + row.0, above.1 + row.1);
        }
    }
    let norm = |x: usize, y: usize| {
        let at = |x: usize, y: usize| sums[y * (width + 1) + x];
        let corners = [at(x + BLOCK, y + BLOCK), at(x, y), at(x + BLOCK, y), at(x, y + BLOCK)];
        let of = |part: fn(&(f64, f64)) -> f64| {
            let [a, b, c, d] = corners.each_ref().map(part);
            a + b - c - d
        };
        let (sum, squares) = (of(|s| s.0), of(|s| s.1));
        (squares - sum * sum / (BLOCK * BLOCK) as f64).max(0.0).sqrt() as f32
    };
    (0..=height - BLOCK).flat_map(|y| (0..=width - BLOCK).map(move |x| norm(x, y))).collect()
}

/// A Gaussian blur; border values are repeated outside.
fn blur(values: &[f32], width: usize, height: usize, deviation: f32) -> Vec<f32> {
    let radius = (3.0 * deviation).ceil() as isize;
    let mut weights: Vec<f32> =
        (-radius..=radius).map(|i| (-0.5 * (i as f32 / deviation).powi(2)).exp()).collect();
    let sum: f32 = weights.iter().sum();
    weights.iter_mut().for_each(|weight| *weight /= sum);
    let along = |values: &[f32], length: usize, stride: usize, at: usize| -> f32 {
        let place = (at / stride % length) as isize;
        let start = at - place as usize * stride;
        let near = weights.iter().zip(place - radius..);
        near.map(|(weight, i)| {
            weight * values[start + i.clamp(0, length as isize - 1) as usize * stride]
        })
        .sum()
    };
    let rows: Vec<f32> = (0..values.len()).map(|at| along(values, width, 1, at)).collect();
    (0..values.len()).map(|at| along(&rows, height, width, at)).collect()
}
