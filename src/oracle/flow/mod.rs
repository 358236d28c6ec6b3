//! Dense optical flow: the CPU twin of the `flow` kernels.
//!
//! The method is coarse to fine. At each level of an image pyramid, overlapping patches look for
//! their displacement (dense inverse search, Kroeger et al. 2016, with zero-mean residuals and with
//! candidates passed between neighbours as in PatchMatch, Barnes et al. 2009); their displacements
//! are blended into a dense flow; a variational refinement (Brox et al. 2004, with the normalised
//! data terms of Zimmer et al. 2011) then smooths it along image edges. Both directions of a pair
//! are found together: where they disagree the data terms are mistrusted and smoothness fills in.
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

pub use consistency::{confidence, trust};
pub use patches::{PATCH, STRIDE, Patch, densify, patch_grid, propagate, search};
pub use pyramid::{Level, Pyramid, derivatives, halve, luminance, upsample};
pub use refine::{Equation, linearise, median, relax};

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
    /// How far the forward flow is to be believed, in [0, 1].
    pub forward_confidence: Vec<T>,
    /// How far the backward flow is to be believed, in [0, 1].
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
        let coarse = first.levels.get(l + 1);
        let dense = both(|d| {
            let (a, b) = if d == 0 { (a, b) } else { (b, a) };
            let start = match coarse {
                Some(c) => upsample(&flows[d], c.width, c.height, a.width, a.height),
                None if settings.coarse_radius > 0 => {
                    let (p1, p2) = (pyramid::tun::<f64>("P1", 3.0), pyramid::tun::<f64>("P2", 20.0));
                    let f = coarse::coarse(&a.luma, &b.luma, a.width, a.height, settings.coarse_radius as usize, [p1 as u32, p2 as u32]);
                    if let Ok(mut probe) = PROBE.lock() && let Some(g) = probe.as_mut() && d == 0 { g(l, 9, a.width, &to32(&f)); }
                    f
                }
                None => vec![[T::zero(); 2]; a.width * a.height],
            };
            let guess = guess.map(|g| (g[d], first.levels[0].width, first.levels[0].height, l));
            let radius = 0;
            let mut patches = search(a, b, &start, guess, radius, settings);
            for pass in 0..settings.propagations {
                patches = propagate(a, b, &patches, pass, settings);
            }
            densify(a, b, &patches)
        });
        if let Ok(mut probe) = PROBE.lock() && let Some(f) = probe.as_mut() { f(l, 0, a.width, &to32(&dense[0])); }
        let trusts = both(|d| trust(&dense[d], &dense[1 - d], a.width, a.height));
        flows = both(|d| {
            let (a, b) = if d == 0 { (a, b) } else { (b, a) };
            let mut flow = median(&dense[d], a.width, a.height);
            for _ in 0..settings.warps {
                let equations = linearise(a, b, &flow, &trusts[d], settings);
                for _ in 0..settings.sweeps {
                    relax(&mut flow, &equations, a.width, a.height, 0, settings);
                    relax(&mut flow, &equations, a.width, a.height, 1, settings);
                }
                flow = median(&flow, a.width, a.height);
            }
            flow
        });
        if let Ok(mut probe) = PROBE.lock() && let Some(f) = probe.as_mut() { f(l, 1, a.width, &to32(&flows[0])); }
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

pub(crate) type Probe = Box<dyn FnMut(usize, usize, usize, &[[f32; 2]]) + Send>;
pub(crate) static PROBE: std::sync::Mutex<Option<Probe>> = std::sync::Mutex::new(None);
fn to32<T: Real>(f: &[[T; 2]]) -> Vec<[f32; 2]> {
    f.iter().map(|v| v.map(|c| c.f64() as f32)).collect()
}
