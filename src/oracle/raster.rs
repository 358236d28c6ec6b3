//! Front-to-back blending of splats, and its gradients.

use super::Real;
use super::bin::Bins;
use super::linear::{Vec3, dot};
use super::project::Splat;
use super::project_backward::SplatGradient;
use super::tiles::{TILE, whitened};
use crate::types::RenderSettings;
use rayon::prelude::*;

/// A rendered image, row-major, or the gradient with respect to one.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Pixels<R> {
    /// Colour premultiplied by alpha, without background.
    pub rgb: Vec<Vec3<R>>,
    /// 1 − transmittance.
    pub alpha: Vec<R>,
    /// Σ weight · z, not divided by alpha.
    pub depth: Vec<R>,
}

impl<R: Real> Pixels<R> {
    /// `count` pixels of zeros.
    pub fn zeros(count: usize) -> Pixels<R> {
        Pixels {
            rgb: vec![[R::zero(); 3]; count],
            alpha: vec![R::zero(); count],
            depth: vec![R::zero(); count],
        }
    }
}

/// The contribution of one splat to one pixel.
struct Share<R> {
    splat: usize,
    /// Opacity of the splat here, capped.
    alpha: R,
    /// exp(−power).
    falloff: R,
    capped: bool,
    /// Pixel centre − splat centre, whitened by the conic's factor.
    offset: [R; 2],
    /// Transmittance in front of the splat.
    transmittance: R,
}

/// Calls `visit` for every splat that pixel (x, y) blends, front to back, and returns the
/// transmittance behind the last.
fn blend<R: Real>(
    splats: &[Option<Splat<R>>],
    bins: &Bins,
    settings: &RenderSettings,
    x: u32,
    y: u32,
    mut visit: impl FnMut(&Splat<R>, Share<R>),
) -> R {
    let setting = |v: f32| R::of(f64::from(v));
    let (cut, cap, stop) = (
        setting(settings.alpha_cut),
        setting(settings.alpha_cap),
        setting(settings.transmittance_stop),
    );
    let pixel = [x, y].map(|k| R::of(f64::from(k) + 0.5));
    let tile = (y / TILE) * bins.grid[0] + x / TILE;
    let [begin, end] = bins.ranges[tile as usize];
    let mut transmittance = R::one();
    for &index in &bins.splat_from_sorted[begin as usize..end as usize] {
        let splat = splats[index as usize].as_ref().expect("bins list only drawn splats");
        let offset = whitened(splat.conic, pixel[0] - splat.mean[0], pixel[1] - splat.mean[1]);
        let power = offset[0] * offset[0] + offset[1] * offset[1];
        if power.is_nan() {
            continue;
        }
        let falloff = (-power).exp();
        let full = splat.opacity * falloff;
        let alpha = full.min(cap);
        if alpha < cut {
            continue;
        }
        let behind = transmittance * (R::one() - alpha);
        if behind <= stop {
            break;
        }
        let share = Share {
            splat: index as usize,
            alpha,
            falloff,
            capped: full > cap,
            offset,
            transmittance,
        };
        visit(splat, share);
        transmittance = behind;
    }
    transmittance
}

/// Blends every pixel: α = min(cap, opacity · exp(−power)); splats with α below the cut are
/// skipped, and blending stops before the splat that would bring the transmittance to the stop or
/// below.
pub fn forward<R: Real>(
    splats: &[Option<Splat<R>>],
    bins: &Bins,
    settings: &RenderSettings,
    width: u32,
    height: u32,
) -> Pixels<R> {
    let pixel = |x: u32, y: u32| {
        let (mut rgb, mut depth) = ([R::zero(); 3], R::zero());
        let left = blend(splats, bins, settings, x, y, |splat, share| {
            let weight = share.alpha * share.transmittance;
            for c in 0..3 {
                rgb[c] += weight * splat.colour[c];
            }
            depth += weight * splat.depth;
        });
        (rgb, R::one() - left, depth)
    };
    let mut out = Pixels::zeros(width as usize * height as usize);
    let row = (width as usize).max(1);
    (out.rgb.par_chunks_mut(row), out.alpha.par_chunks_mut(row), out.depth.par_chunks_mut(row))
        .into_par_iter()
        .enumerate()
        .for_each(|(y, (rgb, alpha, depth))| {
            for x in 0..rgb.len() {
                (rgb[x], alpha[x], depth[x]) = pixel(x as u32, y as u32);
            }
        });
    out
}

/// Gradients with respect to the splats, given those with respect to the pixels (`gradient`) and
/// the image (`pixels`).
///
/// With `v = g_rgb · colour + g_depth · z + g_alpha`, a pixel's loss is `Σ αᵢ Tᵢ vᵢ`, and
/// `dL/dαᵢ = Tᵢ vᵢ − (Σ_{j>i} αⱼ Tⱼ vⱼ) / (1 − αᵢ)`. The sum behind a splat is the pixel's total
/// minus the sum up to it, so one front-to-back pass suffices. A capped α passes no gradient to
/// opacity and shape; colour and depth keep theirs.
pub fn backward<R: Real>(
    splats: &[Option<Splat<R>>],
    bins: &Bins,
    settings: &RenderSettings,
    width: u32,
    height: u32,
    pixels: &Pixels<R>,
    gradient: &Pixels<R>,
) -> Vec<SplatGradient<R>> {
    let mut out = vec![SplatGradient::default(); splats.len()];
    for y in 0..height {
        for x in 0..width {
            let at = y as usize * width as usize + x as usize;
            let (g_rgb, g_alpha, g_depth) =
                (gradient.rgb[at], gradient.alpha[at], gradient.depth[at]);
            let total = dot(g_rgb, pixels.rgb[at])
                + g_depth * pixels.depth[at]
                + g_alpha * pixels.alpha[at];
            let mut before = R::zero();
            blend(splats, bins, settings, x, y, |splat, share| {
                let to = &mut out[share.splat];
                let weight = share.alpha * share.transmittance;
                let value = dot(g_rgb, splat.colour) + g_depth * splat.depth + g_alpha;
                for c in 0..3 {
                    to.colour[c] += weight * g_rgb[c];
                }
                to.depth += weight * g_depth;
                before += weight * value;
                if share.capped {
                    return;
                }
                let to_alpha =
                    share.transmittance * value - (total - before) / (R::one() - share.alpha);
                to.opacity += to_alpha * share.falloff;
                let pull = to_alpha * share.alpha;
                let [h, k] = share.offset;
                let [a, b, e] = splat.conic;
                to.covariance[0] += pull * h * h;
                to.covariance[1] += pull * h * k;
                to.covariance[2] += pull * k * k;
                to.mean[0] += R::of(2.0) * pull * a * h;
                to.mean[1] += R::of(2.0) * pull * (b * h + e * k);
            });
        }
    }
    out
}
