//! Error limits for the gradients of blending in f32: a running error analysis along the oracle in
//! f64.
//!
//! A bound relative to the largest gradient is too loose for most splats and too tight for a few:
//! the contribution behind a splat is a difference of sums over the whole pixel, divided by 1 − α,
//! which can be as small as 1e-3. Each splat therefore gets its own limit: the first-order sum of
//! worst-case errors.

use crate::oracle::bin::Bins;
use crate::oracle::project::Splat;
use crate::oracle::project_backward::SplatGradient;
use crate::oracle::raster::Pixels;
use crate::oracle::tiles::whitened;
use crate::types::RenderSettings;

/// Relative spacing of f32.
const EPS: f64 = 1.2e-7;

/// One splat on one pixel, front to back.
struct Layer {
    index: usize,
    /// The whitened offset, and its rounding error.
    offset: [f64; 2],
    spread: [f64; 2],
    falloff: f64,
    alpha: f64,
    capped: bool,
    transmittance: f64,
    /// Relative rounding error of alpha.
    alpha_error: f64,
    /// Relative rounding error of the transmittance.
    drift: f64,
    /// The loss's derivative with respect to the splat's weight, and the sum of the magnitudes of
    /// its terms.
    value: f64,
    magnitude: f64,
}

/// The rounding error limit of each gradient of every splat.
pub fn gradient_limits(
    splats: &[Option<Splat<f64>>],
    bins: &Bins,
    settings: &RenderSettings,
    width: u32,
    height: u32,
    gradient: &Pixels<f64>,
) -> Vec<SplatGradient<f64>> {
    let mut out = vec![SplatGradient::default(); splats.len()];
    for y in 0..height {
        for x in 0..width {
            let at = y as usize * width as usize + x as usize;
            let g = (gradient.rgb[at], gradient.alpha[at], gradient.depth[at]);
            if g != ([0.0; 3], 0.0, 0.0) {
                let [begin, end] = bins.ranges[(y / 16 * bins.grid[0] + x / 16) as usize];
                let listed = &bins.splat_from_sorted[begin as usize..end as usize];
                let layers = layers(splats, listed, settings, [x, y], g);
                add_limits(splats, &layers, g, &mut out);
            }
        }
    }
    out
}

fn layers(
    splats: &[Option<Splat<f64>>],
    listed: &[u32],
    settings: &RenderSettings,
    pixel: [u32; 2],
    (g_rgb, g_alpha, g_depth): ([f64; 3], f64, f64),
) -> Vec<Layer> {
    let (mut transmittance, mut drift) = (1.0, 0.0);
    let mut layers = Vec::new();
    for &index in listed {
        let Some(splat) = &splats[index as usize] else { continue };
        let [x, y] = [0, 1].map(|k| f64::from(pixel[k]) + 0.5 - splat.mean[k]);
        let offset = whitened(splat.conic, x, y);
        let power = offset[0] * offset[0] + offset[1] * offset[1];
        let falloff = (-power).exp();
        let full = splat.opacity * falloff;
        let alpha = full.min(f64::from(settings.alpha_cap));
        if alpha.is_nan() || alpha < f64::from(settings.alpha_cut) {
            continue;
        }
        let behind = transmittance * (1.0 - alpha);
        if behind <= f64::from(settings.transmittance_stop) {
            break;
        }
        // The terms of the whitened offset before they cancel, with the rounding of the offset (of
        // up to a pixel), and the exponential, for which Vulkan allows an error of 3 + 2 |x| ulp.
        let [a, b, e] = splat.conic.map(f64::abs);
        let [dx, dy] = [x, y].map(f64::abs);
        let spread = [2.0 * EPS * (a * (dx + 1.0) + b * (dy + 1.0)), EPS * e * (dy + 2.0)];
        let moved: f64 = (0..2).map(|k| spread[k] * (2.0 * offset[k].abs() + spread[k])).sum();
        let alpha_error = EPS * (6.0 + 4.0 * power) + moved;
        let parts = |rgb: [f64; 3], sign: fn(f64) -> f64| {
            let colour: f64 = (0..3).map(|k| sign(rgb[k] * splat.colour[k])).sum();
            colour + sign(g_depth * splat.depth) + sign(g_alpha)
        };
        layers.push(Layer {
            index: index as usize,
            offset,
            spread,
            falloff,
            alpha,
            capped: full > f64::from(settings.alpha_cap),
            transmittance,
            alpha_error,
            drift,
            value: parts(g_rgb, |v| v),
            magnitude: parts(g_rgb, f64::abs),
        });
        drift += EPS + alpha_error * alpha / (1.0 - alpha);
        transmittance = behind;
    }
    layers
}

fn add_limits(
    splats: &[Option<Splat<f64>>],
    layers: &[Layer],
    (g_rgb, _, g_depth): ([f64; 3], f64, f64),
    out: &mut [SplatGradient<f64>],
) {
    let weight = |l: &Layer| l.alpha * l.transmittance;
    // The pixel's total, and its error from summing this many terms with perturbed weights.
    let summing = EPS * (4.0 + (layers.len() as f64).sqrt());
    let total_error: f64 =
        layers.iter().map(|l| weight(l) * l.magnitude * (summing + l.drift + l.alpha_error)).sum();
    let mut behind: f64 = layers.iter().map(|l| weight(l) * l.value).sum();
    for layer in layers {
        let splat = splats[layer.index].as_ref().expect("only drawn splats are listed");
        let limit = &mut out[layer.index];
        let moved = weight(layer) * (layer.drift + layer.alpha_error + 4.0 * EPS);
        for k in 0..3 {
            limit.colour[k] += moved * g_rgb[k].abs();
        }
        limit.depth += moved * g_depth.abs();
        behind -= weight(layer) * layer.value;
        if layer.capped {
            continue;
        }
        let clear = 1.0 - layer.alpha;
        let by_alpha = (layer.transmittance * layer.value - behind / clear).abs();
        let error = layer.transmittance * layer.magnitude * (layer.drift + 4.0 * EPS)
            + total_error / clear
            + behind.abs() / clear * (layer.alpha * layer.alpha_error / clear + 4.0 * EPS)
            + by_alpha * (layer.alpha_error + 4.0 * EPS);
        limit.opacity += error * layer.falloff;
        let [h, k] = layer.offset.map(f64::abs);
        let [to_h, to_k] = layer.spread;
        let [a, b, e] = splat.conic.map(f64::abs);
        let (by_power, pull) = (error * layer.alpha, by_alpha * layer.alpha);
        limit.covariance[0] += by_power * h * h + pull * to_h * (2.0 * h + to_h);
        limit.covariance[1] += by_power * h * k + pull * (to_h * k + to_k * h + to_h * to_k);
        limit.covariance[2] += by_power * k * k + pull * to_k * (2.0 * k + to_k);
        let (by_h, by_k) = (by_power * h + pull * to_h, by_power * k + pull * to_k);
        limit.mean[0] += 2.0 * a * by_h;
        limit.mean[1] += 2.0 * (b * by_h + e * by_k);
    }
}
