//! What counts of a pixel's surroundings: neighbours of its own colour, so that a patch ends where another
//! surface begins (adaptive support weights: Yoon and Kweon 2006).

use crate::types::Image;

/// A patch reaches so many pixels to each side.
pub(super) const RADIUS: usize = 2;
/// A neighbour whose colour differs by so much counts 1/e.
const ALIKE: f32 = 0.08;

/// Every second pixel of a patch, as offsets in x and y from its middle.
pub(super) fn neighbours() -> [(isize, isize); 13] {
    const SIDE: isize = 2 * RADIUS as isize + 1;
    std::array::from_fn(|k| {
        let k = 2 * k as isize;
        (k % SIDE - RADIUS as isize, k / SIDE - RADIUS as isize)
    })
}

/// How much a neighbour counts in a pixel's patch, up to 1.
pub(super) fn weight(frame: &Image, pixel: usize, neighbour: usize) -> f32 {
    (-difference(frame, pixel, neighbour) / ALIKE).exp()
}

/// By how much two pixels' colours differ, mean over the channels.
pub(super) fn difference(frame: &Image, a: usize, b: usize) -> f32 {
    let channels = frame.channels as usize;
    let at = |i: usize| &frame.pixels[i * channels..][..channels];
    let sum: f32 = at(a).iter().zip(at(b)).map(|(a, b)| (a - b).abs()).sum();
    sum / channels as f32
}
