//! Check cases of the conversion of rendered images to texture formats.

use super::{Bound, Case, Harness};
use crate::error::Result;
use crate::ops::texel::{self, Packing};
use crate::oracle::texel as oracle;
use rand::RngExt;

/// The family's cases.
pub const CASES: &[Case] =
    &[Case { id: "texel/unorm8", run: unorm8 }, Case { id: "texel/half", run: half }];

/// Backgrounds: empty, opaque and translucent.
const BEHIND: [[f32; 4]; 3] = [[0.0; 4], [0.2, 0.9, 0.4, 1.0], [0.1, 0.0, 0.3, 0.35]];

/// Premultiplied pixels as the engine renders them, and invalid ones.
fn pixels(h: &mut Harness, count: usize, hard: &[f32]) -> Vec<[f32; 4]> {
    let mut pixels: Vec<[f32; 4]> = (0..count)
        .map(|_| {
            let alpha = h.rng.random_range(0.0..1.0f32);
            let [r, g, b] = std::array::from_fn(|_| alpha * h.rng.random_range(-0.1..1.2f32));
            [r, g, b, alpha]
        })
        .collect();
    for (pixel, values) in pixels.iter_mut().zip(hard.chunks(3)) {
        pixel[3] = 1.0;
        pixel[..values.len()].copy_from_slice(values);
    }
    if let [.., a, b, c] = &mut pixels[..] {
        (a[3], b[3], c[3]) = (f32::NAN, f32::INFINITY, 1.5);
    }
    pixels
}

const NOT_FINITE: [f32; 3] = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY];

fn truth(pixels: &[[f32; 4]], behind: [f32; 4]) -> impl Iterator<Item = [f64; 4]> {
    let behind = behind.map(f64::from);
    pixels.iter().map(move |pixel| oracle::over(pixel.map(f64::from), behind))
}

/// Results are within half a step of the exact value, plus the rounding of f32; multiples of 1/255
/// are exact.
fn unorm8(h: &mut Harness) -> Result<()> {
    let mut hard: Vec<f32> = (0..=255).map(|level| level as f32 / 255.0).collect();
    hard.extend(NOT_FINITE);
    hard.extend([-1e30, 1e30, -0.0, 1e-40, 1.0 + 1e-6, -1e-6]);
    for (count, blue_first) in [(0, false), (1, true), (64, false), (1000, true), (1001, false)] {
        let rgba = pixels(h, count, &hard);
        let buffer = h.device.upload("image", &rgba)?;
        for background in BEHIND {
            let mut texels = h.output::<u32>("texels", count)?;
            let mut recorder = h.stream.record()?;
            let packing = Packing { background, blue_first };
            texel::unorm8(&mut recorder, buffer.view(), &packing, texels.view_mut())?;
            h.stream.submit(recorder)?;
            let order = if blue_first { [2, 1, 0, 3] } else { [0, 1, 2, 3] };
            let bytes: Vec<[u8; 4]> =
                h.read(&texels)?.iter().map(|texel| texel.to_le_bytes()).collect();
            let levels: Vec<f32> =
                bytes.iter().flat_map(|texel| order.map(|k| f32::from(texel[k]))).collect();
            let exact: Vec<f64> =
                truth(&rgba, background).flat_map(|pixel| pixel.map(oracle::level)).collect();
            let half_a_step = Bound { absolute: 0.5001, relative: 0.0 };
            h.close("levels", &levels, &exact, None, half_a_step);
            // Opaque pixels on a quantisation level need no rounding.
            let steps = 3 * count.saturating_sub(3).min(85);
            let found: Vec<u8> = (0..steps).map(|i| levels[i / 3 * 4 + i % 3] as u8).collect();
            let wanted: Vec<u8> = (0..steps).map(|i| oracle::unorm8(hard[i])).collect();
            h.exact("steps", &found, &wanted);
        }
    }
    Ok(())
}

/// Results are exact, bit for bit, without a background; else within half an ulp, plus the rounding
/// of f32.
fn half(h: &mut Harness) -> Result<()> {
    let mut hard = vec![0.0, -0.0, 1.0, -1.0, 65504.0, 65519.0, 65520.0, -7e4, 1e30, -1e30];
    // Ties to even and their neighbours, for normal and subnormal values; the smallest value, half
    // of it, and less.
    for step in [2f32.powi(-10), 2f32.powi(-14), 2f32.powi(-24), 2f32.powi(-25), 2f32.powi(-26)] {
        for ulps in [0.5, 1.0, 1.5, 2.5, 3.5] {
            for base in [0.0, 1.0, 2f32.powi(-14), 2f32.powi(-15)] {
                let tie = base + ulps * step;
                hard.extend([tie, tie.next_up(), tie.next_down(), -tie]);
            }
        }
    }
    hard.extend(NOT_FINITE);
    hard.extend([1e-40, 2f32.powi(-126)]);
    for count in [0, 1, 64, 1000] {
        let rgba = pixels(h, count, &hard);
        let buffer = h.device.upload("image", &rgba)?;
        for background in BEHIND {
            let mut texels = h.output::<[u32; 2]>("texels", count)?;
            let mut recorder = h.stream.record()?;
            texel::half(&mut recorder, buffer.view(), background, texels.view_mut())?;
            h.stream.submit(recorder)?;
            let words = h.read(&texels)?;
            let bits =
                words.iter().flat_map(|pair| pair.map(|word| [word as u16, (word >> 16) as u16]));
            let values: Vec<f32> =
                bits.flatten().map(|bits| half::f16::from_bits(bits).to_f32()).collect();
            let exact: Vec<f64> = truth(&rgba, background).flatten().collect();
            let clamped: Vec<f64> = exact.iter().map(|v| v.clamp(-65504.0, 65504.0)).collect();
            let last_place =
                Bound { absolute: 2f64.powi(-25) + 1e-7, relative: 2f64.powi(-11) + 1e-6 };
            h.close("values", &values, &clamped, None, last_place);
            if background == [0.0; 4] {
                let nearest: Vec<f32> = exact.iter().map(|&value| oracle::half(value)).collect();
                h.exact("nearest", &values, &nearest);
            }
        }
    }
    Ok(())
}
