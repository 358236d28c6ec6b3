//! The tiles of the image that a splat overlaps.

use super::Real;

/// Side of a tile, pixels.
pub const TILE: u32 = 16;

/// Number of tiles along x and y of an image.
pub fn grid(width: u32, height: u32) -> [u32; 2] {
    [width.div_ceil(TILE), height.div_ceil(TILE)]
}

/// Tiles `min.. < max` along x and y.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct TileRect {
    /// First column and row.
    pub min: [u32; 2],
    /// One past the last column and row.
    pub max: [u32; 2],
}

impl TileRect {
    /// The tiles whose pixel centres come within `extent` of `mean`, per axis; empty where none
    /// does.
    pub fn around<R: Real>(mean: [R; 2], extent: [R; 2], width: u32, height: u32) -> TileRect {
        let size = [width, height];
        let mut rect = TileRect::default();
        for axis in 0..2 {
            let half = R::of(0.5);
            let last = R::of(f64::from(size[axis])) - R::one();
            // First and last pixel whose centre is within the extent, as real numbers, since an
            // extent of 1e23 pixels fits no integer type.
            let from = (mean[axis] - extent[axis] - half).ceil().max(R::zero());
            let to = (mean[axis] + extent[axis] - half).floor().min(last);
            if from.is_nan() || to.is_nan() || from > to {
                return TileRect::default();
            }
            rect.min[axis] = from.f64() as u32 / TILE;
            rect.max[axis] = to.f64() as u32 / TILE + 1;
        }
        rect
    }

    /// Every tile's column and row, row by row.
    pub fn tiles(self) -> impl Iterator<Item = [u32; 2]> {
        (self.min[1]..self.max[1])
            .flat_map(move |row| (self.min[0]..self.max[0]).map(move |column| [column, row]))
    }
}

/// Whether `power ≤ reach` holds, for a Gaussian with this mean and [factored conic](power),
/// anywhere in the rectangle spanned by the tile's pixel centres within the image.
///
/// The quadratic is convex, so outside its centre its least value over a rectangle lies on one of
/// the at most two edges that face the centre.
pub fn hit<R: Real>(
    mean: [R; 2],
    conic: [R; 3],
    reach: R,
    tile: [u32; 2],
    width: u32,
    height: u32,
) -> bool {
    let size = [width, height];
    let half = R::of(0.5);
    let low: [R; 2] = std::array::from_fn(|k| R::of(f64::from(tile[k] * TILE)) + half - mean[k]);
    let high: [R; 2] = std::array::from_fn(|k| {
        R::of(f64::from(((tile[k] + 1) * TILE).min(size[k]))) - half - mean[k]
    });
    let facing = |k: usize| {
        if low[k] > R::zero() {
            Some(low[k])
        } else if high[k] < R::zero() {
            Some(high[k])
        } else {
            None
        }
    };
    let power = |dx: R, dy: R| power(conic, dx, dy);
    let [a, b, e] = conic;
    let within = |free: R, k: usize| free.max(low[k]).min(high[k]);
    // Where dx is given, the least is at dy = −a b dx / (b² + e²); scaled, for the squares' sake.
    let least_y = |dx: R| {
        let unit = b.abs().max(e);
        let (column_b, column_e) = (b / unit, e / unit);
        let free = -(a / unit) * dx * column_b / (column_b * column_b + column_e * column_e);
        within(if unit > R::zero() { free } else { R::zero() }, 1)
    };
    // Where dy is given, at dx = −b dy / a.
    let least_x = |dy: R| within(if a > R::zero() { -(b / a) * dy } else { R::zero() }, 0);
    match (facing(0), facing(1)) {
        (None, None) => true,
        (dx, dy) => {
            dx.is_some_and(|dx| power(dx, least_y(dx)) <= reach)
                || dy.is_some_and(|dy| power(least_x(dy), dy) <= reach)
        }
    }
}

/// The exponent of a splat at an offset from its mean, by the factored conic `(a, b, e)`: the squared
/// length of the [whitened] offset. Half the conic is `UᵀU` with `U = [a b; 0 e]`; the usual entries
/// are `A = 2a²`, `B = 2ab` and `C = 2(b² + e²)`.
pub fn power<R: Real>(conic: [R; 3], dx: R, dy: R) -> R {
    let [h, k] = whitened(conic, dx, dy);
    h * h + k * k
}

/// `U` times an offset.
pub fn whitened<R: Real>([a, b, e]: [R; 3], dx: R, dy: R) -> [R; 2] {
    [a * dx + b * dy, e * dy]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rectangles_hold_exactly_the_pixels_in_reach() {
        let rect = |mean, extent| TileRect::around::<f64>(mean, extent, 40, 20);
        assert_eq!(rect([8.0, 8.0], [3.0, 3.0]), TileRect { min: [0, 0], max: [1, 1] });
        // Pixel 16's centre is 16.5: 8.5 reaches it, 8.4 does not.
        assert_eq!(rect([8.0, 8.0], [8.5, 3.0]).max, [2, 1]);
        assert_eq!(rect([8.0, 8.0], [8.4, 3.0]).max, [1, 1]);
        assert_eq!(rect([-5.0, 8.0], [5.4, 3.0]).tiles().count(), 0);
        assert_eq!(rect([8.2, 8.2], [0.1, 0.1]).tiles().count(), 0);
        assert_eq!(rect([8.0, 8.0], [1e30, 1e30]), TileRect { min: [0, 0], max: [3, 2] });
    }

    /// From A, B, C.
    fn factored([a, b, c]: [f64; 3]) -> [f64; 3] {
        let first = (0.5 * a).sqrt();
        let second = 0.5 * b / first;
        [first, second, (0.5 * c - second * second).sqrt()]
    }

    /// Against every point of a fine lattice over the tile's rectangle.
    #[test]
    fn hits_agree_with_exhaustive_search() {
        let (width, height) = (75, 50);
        let mut hits = 0;
        let mut checked = 0;
        for case in 0..60 {
            let t = case as f64;
            let angle = t * 0.37;
            let (wide, thin) = (3.0 + t * 0.4, 0.6 + 0.05 * t);
            let (c, s) = (angle.cos(), angle.sin());
            let (a, b) = (1.0 / (wide * wide), 1.0 / (thin * thin));
            let entries = [a * c * c + b * s * s, (a - b) * c * s, a * s * s + b * c * c];
            let conic = factored(entries);
            let [dx, dy] = [3.7, -2.1];
            let plain = 0.5 * (entries[0] * dx * dx + entries[2] * dy * dy) + entries[1] * dx * dy;
            assert!((power(conic, dx, dy) - plain).abs() < 1e-12);
            let mean = [(t * 13.7) % 90.0 - 8.0, (t * 7.9) % 60.0 - 5.0];
            for tile in (TileRect { min: [0, 0], max: grid(width, height).map(|n| n) }).tiles() {
                let x1 = ((tile[0] + 1) * TILE).min(width) as f64 - 0.5;
                let y1 = ((tile[1] + 1) * TILE).min(height) as f64 - 0.5;
                let (x0, y0) = (f64::from(tile[0] * TILE) + 0.5, f64::from(tile[1] * TILE) + 0.5);
                let mut least = f64::INFINITY;
                for i in 0..=150 {
                    for j in 0..=150 {
                        let x = x0 + (x1 - x0) * f64::from(i) / 150.0;
                        let y = y0 + (y1 - y0) * f64::from(j) / 150.0;
                        least = least.min(power(conic, x - mean[0], y - mean[1]));
                    }
                }
                // The lattice finds slightly more than the least: leave the borderline out.
                let reach = 5.0;
                if least <= reach || least > reach * 1.1 {
                    let hit = hit(mean, conic, reach, tile, width, height);
                    assert_eq!(hit, least <= reach, "case {case} tile {tile:?} least {least}");
                    hits += usize::from(hit);
                    checked += 1;
                }
            }
        }
        assert!(hits > 100 && checked - hits > 100, "{hits} of {checked}");
    }
}
