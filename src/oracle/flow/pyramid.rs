//! Luminance, its pyramid and its derivatives; taking a flow from one level to the next.

use crate::oracle::Real;

/// One level of an image pyramid.
pub struct Level<T> {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// Luminance, in [0, 1].
    pub luma: Vec<T>,
    /// ∂x, ∂y, ∂xx, ∂xy, ∂yy of the luminance, per pixel.
    pub derivatives: Vec<[T; 5]>,
}

/// An image at every level, the finest first.
pub struct Pyramid<T> {
    /// Level 0 is the image itself; each further level is half as wide and high, rounded up.
    pub levels: Vec<Level<T>>,
}

impl<T: Real> Pyramid<T> {
    /// Builds the pyramid of an image of `channels` interleaved values per pixel; it halves until
    /// the next level's shorter side would be less than `coarsest_side`.
    pub fn new(
        pixels: &[T],
        width: usize,
        height: usize,
        channels: usize,
        coarsest_side: u32,
    ) -> Pyramid<T> {
        let mut luma = luminance(pixels, channels);
        let (mut w, mut h) = (width, height);
        let mut levels = Vec::new();
        loop {
            let derivatives = derivatives(&luma, w, h);
            let next = (w.div_ceil(2), h.div_ceil(2));
            let smaller = halve(&luma, w, h);
            levels.push(Level { width: w, height: h, luma, derivatives });
            if next.0.min(next.1) < coarsest_side.max(1) as usize || next == (w, h) {
                return Pyramid { levels };
            }
            luma = smaller;
            (w, h) = next;
        }
    }
}

/// Rec. 709 luma of encoded colours, clamped to [0, 1]; one channel is taken as it is. NaN is 0.
pub fn luminance<T: Real>(pixels: &[T], channels: usize) -> Vec<T> {
    let unit = |v: T| if v > T::zero() { v.min(T::one()) } else { T::zero() };
    let luma = |p: &[T]| match p {
        [r, g, b, ..] => {
            T::of(0.2126) * unit(*r) + T::of(0.7152) * unit(*g) + T::of(0.0722) * unit(*b)
        }
        [y, ..] => unit(*y),
        [] => T::zero(),
    };
    pixels.chunks_exact(channels).map(luma).collect()
}

/// Half the size, rounded up: the binomial filter (1 3 3 1)/8 along both axes, edges repeated.
pub fn halve<T: Real>(luma: &[T], width: usize, height: usize) -> Vec<T> {
    let weights = [0.125, 0.375, 0.375, 0.125].map(T::of);
    let mut out = Vec::with_capacity(width.div_ceil(2) * height.div_ceil(2));
    for y in 0..height.div_ceil(2) {
        for x in 0..width.div_ceil(2) {
            let mut sum = T::zero();
            for j in 0..4 {
                for i in 0..4 {
                    let sx = clamp(2 * x as isize + i as isize - 1, width);
                    let sy = clamp(2 * y as isize + j as isize - 1, height);
                    sum += weights[i] * weights[j] * luma[sy * width + sx];
                }
            }
            out.push(sum);
        }
    }
    out
}

/// ∂x, ∂y (five-point), ∂xx, ∂xy, ∂yy (three-point) of the luminance, edges repeated.
pub fn derivatives<T: Real>(luma: &[T], width: usize, height: usize) -> Vec<[T; 5]> {
    let mut out = Vec::with_capacity(luma.len());
    for y in 0..height as isize {
        for x in 0..width as isize {
            let at = |i: isize, j: isize| luma[clamp(y + j, height) * width + clamp(x + i, width)];
            let first = |a: T, b: T, c: T, d: T| (T::of(8.0) * (c - b) - (d - a)) / T::of(12.0);
            out.push([
                first(at(-2, 0), at(-1, 0), at(1, 0), at(2, 0)),
                first(at(0, -2), at(0, -1), at(0, 1), at(0, 2)),
                at(1, 0) - T::of(2.0) * at(0, 0) + at(-1, 0),
                (at(1, 1) - at(-1, 1) - at(1, -1) + at(-1, -1)) * T::of(0.25),
                at(0, 1) - T::of(2.0) * at(0, 0) + at(0, -1),
            ]);
        }
    }
    out
}

/// A flow brought to the next finer level: bilinear, displacements doubled.
pub fn upsample<T: Real>(
    flow: &[[T; 2]],
    width: usize,
    height: usize,
    fine_width: usize,
    fine_height: usize,
) -> Vec<[T; 2]> {
    let half = |i: usize| (T::of(i as f64) + T::of(0.5)) * T::of(0.5) - T::of(0.5);
    let mut out = Vec::with_capacity(fine_width * fine_height);
    for y in 0..fine_height {
        for x in 0..fine_width {
            let f = super::sample(|i, j| flow[j * width + i], width, height, half(x), half(y));
            out.push(f.map(|c| c * T::of(2.0)));
        }
    }
    out
}

/// `i` moved into [0, n).
pub(super) fn clamp(i: isize, n: usize) -> usize {
    i.clamp(0, n as isize - 1) as usize
}
