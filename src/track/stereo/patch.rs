//! The weights of a pixel's neighbours in its patch. Neighbours of a similar colour count more, so that a
//! patch ends where another surface begins (adaptive support weights: Yoon and Kweon 2006).

use crate::types::Image;

/// Radius of a patch, pixels.
pub(super) const RADIUS: usize = 2;
/// Colour difference at which a neighbour's weight is 1/e.
const ALIKE: f32 = 0.08;

/// Every second pixel of a patch, as offsets in x and y from its centre.
pub(super) fn neighbours() -> [(isize, isize); 13] {
    const SIDE: isize = 2 * RADIUS as isize + 1;
    std::array::from_fn(|k| {
        let k = 2 * k as isize;
        (k % SIDE - RADIUS as isize, k / SIDE - RADIUS as isize)
    })
}

/// The weight of a neighbour in a pixel's patch, up to 1.
pub(super) fn weight(frame: &Image, pixel: usize, neighbour: usize) -> f32 {
    (-difference(frame, pixel, neighbour) / ALIKE).exp()
}

/// The colour difference of two pixels, the mean over the channels of its absolute values.
pub(super) fn difference(frame: &Image, a: usize, b: usize) -> f32 {
    let channels = frame.channels as usize;
    let at = |i: usize| &frame.pixels[i * channels..][..channels];
    let sum: f32 = at(a).iter().zip(at(b)).map(|(a, b)| (a - b).abs()).sum();
    sum / channels as f32
}
