//! Dense optical flow: the CPU twin of the `flow` kernels.
//!
//! The method is coarse to fine. The coarsest level of an image pyramid starts from semi-global
//! matching (Hirschmüller 2008) over a window of displacements. At each level, overlapping patches look for
//! their displacement (dense inverse search, Kroeger et al. 2016, with zero-mean residuals and with
//! slanted candidates passed between neighbours as in PatchMatch stereo, Bleyer et al. 2011). Their
//! displacements are blended into a dense flow. A variational refinement (Brox et al. 2004, with
//! the normalised data terms of Zimmer et al. 2011) then smooths it along image edges. Both
//! directions of a pair are computed together: where they disagree, the data terms get low weight
//! and smoothness fills in.
//!
//! Smoothness makes a slanted surface, such as the ground, move too evenly. With
//! [`affine_smoothness`](FlowSettings::affine_smoothness) it penalises only the difference from a flow that is
//! affine around each pixel, a kind of second-order regularisation.
//!
//! A displacement (u, v) at pixel (x, y) says that the point seen there is at (x + u, y + v) in the
//! other image, in pixels, x right and y down. Arrays are row-major.

mod coarse;
mod consistency;
mod patches;
mod pyramid;
mod refine;

#[cfg(test)]
mod tests;

pub use coarse::{OUTSIDE, PATHS, accumulate, census, cheapest, coarse};
pub use consistency::{confidence, trust};
pub use patches::{PATCH, Patch, STRIDE, densify, patch_grid, propagate, search};
pub use pyramid::{Level, Pyramid, derivatives, halve, luminance, upsample};
pub use refine::{Equation, linearise, median, relax, slant, slopes};

use super::Real;
use crate::types::FlowSettings;

/// A displacement, (u, v) in pixels.
pub type Flow<T> = Vec<[T; 2]>;

/// The flow of an image pair in both directions.
pub struct FlowPair<T> {
    /// From the first image to the second.
    pub forward: Flow<T>,
    /// From the second image to the first.
    pub backward: Flow<T>,
    /// Confidence of the forward flow, in [0, 1].
    pub forward_confidence: Vec<T>,
    /// Confidence of the backward flow, in [0, 1].
    pub backward_confidence: Vec<T>,
}

/// The whole method: the flow between two images, given their pyramids.
///
/// `guess` holds a displacement per pixel of the full image for each direction, tried as a
/// candidate by every patch at every level.
pub fn flow<T: Real>(
    first: &Pyramid<T>,
    second: &Pyramid<T>,
    guess: Option<[&[[T; 2]]; 2]>,
    settings: &FlowSettings,
) -> FlowPair<T> {
    let levels = first.levels.len();
    let mut flows: [Flow<T>; 2] = [Vec::new(), Vec::new()];
    for l in (0..levels).rev() {
        let (a, b) = (&first.levels[l], &second.levels[l]);
        let coarser = first.levels.get(l + 1);
        let dense = both(|d| {
            let (a, b) = if d == 0 { (a, b) } else { (b, a) };
            let start = match coarser {
                Some(c) => upsample(&flows[d], c.width, c.height, a.width, a.height),
                None => coarse(&a.luma, &b.luma, a.width, a.height, settings),
            };
            let guess = guess.map(|g| (g[d], first.levels[0].width, first.levels[0].height, l));
            let mut patches = search(a, b, &start, guess, settings);
            for pass in 0..settings.propagations {
                patches = propagate(a, b, &patches, pass, settings);
            }
            densify(a, b, &patches)
        });
        let trusts = both(|d| trust(&dense[d], &dense[1 - d], a.width, a.height));
        flows = both(|d| {
            let (a, b) = if d == 0 { (a, b) } else { (b, a) };
            let mut flow = median(&dense[d], a.width, a.height);
            for _ in 0..settings.warps {
                let slopes = match settings.is_affine(l) {
                    true => slopes(&flow, &trusts[d], a.width, a.height),
                    false => vec![[T::zero(); 4]; flow.len()],
                };
                let smoothness = settings.smoothness_at(l);
                let mut equations =
                    linearise(a, b, &flow, &trusts[d], &slopes, smoothness, settings);
                slant(&mut equations, &slopes, a.width, a.height);
                for _ in 0..settings.sweeps {
                    relax(&mut flow, &equations, a.width, a.height, 0, settings);
                    relax(&mut flow, &equations, a.width, a.height, 1, settings);
                }
                flow = median(&flow, a.width, a.height);
            }
            flow
        });
    }
    let (a, b) = (&first.levels[0], &second.levels[0]);
    let [forward_confidence, backward_confidence] = both(|d| {
        let (a, b) = if d == 0 { (a, b) } else { (b, a) };
        confidence(a, b, &flows[d], &flows[1 - d])
    });
    let [forward, backward] = flows;
    FlowPair { forward, backward, forward_confidence, backward_confidence }
}

/// Runs the two directions side by side.
fn both<R: Send>(run: impl Fn(usize) -> R + Sync) -> [R; 2] {
    let (a, b) = rayon::join(|| run(0), || run(1));
    [a, b]
}

/// The value of `field` at (x, y), in pixels from the centre of the first; clamped to the edges,
/// bilinear in between.
pub(crate) fn sample<T: Real, const N: usize>(
    field: impl Fn(usize, usize) -> [T; N],
    width: usize,
    height: usize,
    x: T,
    y: T,
) -> [T; N] {
    let x = x.max(T::zero()).min(T::of((width - 1) as f64));
    let y = y.max(T::zero()).min(T::of((height - 1) as f64));
    let (x0, y0) = (x.floor(), y.floor());
    let (fx, fy) = (x - x0, y - y0);
    let (x0, y0) = (x0.f64() as usize, y0.f64() as usize);
    let (x1, y1) = ((x0 + 1).min(width - 1), (y0 + 1).min(height - 1));
    let (a, b, c, d) = (field(x0, y0), field(x1, y0), field(x0, y1), field(x1, y1));
    std::array::from_fn(|i| {
        let top = a[i] + (b[i] - a[i]) * fx;
        let bottom = c[i] + (d[i] - c[i]) * fx;
        top + (bottom - top) * fy
    })
}
