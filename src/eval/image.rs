//! Image metrics. Values are clamped to [0, 1] before comparison and sums are in f64. Images may have any
//! number of channels, which are weighted equally.

use rayon::prelude::*;

use crate::types::Image;
use crate::{Error, Result};

/// Side of SSIM's window.
const WINDOW: usize = 11;
/// Standard deviation of SSIM's window, pixels.
const SIGMA: f64 = 1.5;
const C1: f64 = 0.01 * 0.01;
const C2: f64 = 0.03 * 0.03;

/// Weights of MS-SSIM's scales, finest first (Wang, Simoncelli, Bovik 2003).
const MS_WEIGHTS: [f64; 5] = [0.0448, 0.2856, 0.3001, 0.2363, 0.1333];

fn check(op: &'static str, a: &Image, b: &Image) -> Result<()> {
    let same = (a.width, a.height, a.channels) == (b.width, b.height, b.channels);
    if same && !a.pixels.is_empty() {
        return Ok(());
    }
    Err(Error::Input(format!(
        "{op} compares images of one size with pixels in them, not {}×{}×{} with {}×{}×{}",
        a.width, a.height, a.channels, b.width, b.height, b.channels
    )))
}

fn clamped(value: f32) -> f64 {
    f64::from(value).clamp(0.0, 1.0)
}

fn squared_error(a: &[f32], b: &[f32]) -> f64 {
    a.iter().zip(b).map(|(&x, &y)| (clamped(x) - clamped(y)).powi(2)).sum()
}

/// Peak signal-to-noise ratio in dB; infinite for equal images.
pub fn psnr(a: &Image, b: &Image) -> Result<f64> {
    check("PSNR", a, b)?;
    Ok(-10.0 * (squared_error(&a.pixels, &b.pixels) / a.pixels.len() as f64).log10())
}

/// PSNR over the pixels where `mask` (one channel) is above one half.
///
/// # Errors
/// The mask has another size or selects no pixel.
pub fn masked_psnr(a: &Image, b: &Image, mask: &Image) -> Result<f64> {
    check("PSNR", a, b)?;
    check_mask(a, mask)?;
    let channels = a.channels as usize;
    let (mut sum, mut count) = (0.0, 0usize);
    let pairs = a.pixels.chunks_exact(channels).zip(b.pixels.chunks_exact(channels));
    for ((x, y), _) in pairs.zip(&mask.pixels).filter(|(_, m)| **m > 0.5) {
        sum += squared_error(x, y);
        count += channels;
    }
    if count == 0 {
        return Err(Error::Input("the mask of a masked PSNR chooses no pixel".into()));
    }
    Ok(-10.0 * (sum / count as f64).log10())
}

/// Mean of a map, such as that of [`ssim_map`], over the pixels where `mask` (one channel) is above one
/// half, and over all channels.
///
/// # Errors
/// The mask has another size or selects no pixel.
pub fn masked_mean(map: &Image, mask: &Image) -> Result<f64> {
    check_mask(map, mask)?;
    let pixels = map.pixels.chunks_exact(map.channels as usize).zip(&mask.pixels);
    let (mut sum, mut count) = (0.0, 0usize);
    for (values, _) in pixels.filter(|(_, m)| **m > 0.5) {
        sum += values.iter().map(|v| f64::from(*v)).sum::<f64>();
        count += values.len();
    }
    match count {
        0 => Err(Error::Input("the mask of a masked mean chooses no pixel".into())),
        _ => Ok(sum / count as f64),
    }
}

fn check_mask(a: &Image, mask: &Image) -> Result<()> {
    if (mask.width, mask.height, mask.channels) == (a.width, a.height, 1) {
        return Ok(());
    }
    Err(Error::Input(format!(
        "a mask of {}×{}×{} does not fit images of {}×{}",
        mask.width, mask.height, mask.channels, a.width, a.height
    )))
}

/// Structural similarity as 3DGS and related work report it: Gaussian window 11, σ 1.5, zeros beyond the
/// border (like the training loss), mean over all pixels and channels.
pub fn ssim(a: &Image, b: &Image) -> Result<f64> {
    Ok(mean(&ssim_map(a, b)?.pixels))
}

/// The value of [`ssim`] at every pixel and channel.
pub fn ssim_map(a: &Image, b: &Image) -> Result<Image> {
    check("SSIM", a, b)?;
    let planes: Vec<Vec<f64>> = (0..a.channels as usize)
        .into_par_iter()
        .map(|c| similarity(&Plane::of(a, c), &Plane::of(b, c), Border::Zero).whole)
        .collect();
    let mut map = Image::new(a.width, a.height, a.channels);
    for (i, value) in map.pixels.iter_mut().enumerate() {
        *value = planes[i % planes.len()][i / planes.len()] as f32;
    }
    Ok(map)
}

/// Structural similarity over the pixels whose whole window lies inside the image, as in pytorch-msssim and
/// Wang et al. (2004). Both sides need at least 11 pixels.
pub fn ssim_valid(a: &Image, b: &Image) -> Result<f64> {
    check("SSIM", a, b)?;
    need_side("SSIM without padding", a, WINDOW as u32)?;
    let channels = a.channels as usize;
    let sum: f64 = (0..channels)
        .map(|c| mean64(&similarity(&Plane::of(a, c), &Plane::of(b, c), Border::Valid).whole))
        .sum();
    Ok(sum / channels as f64)
}

/// Multi-scale SSIM over five scales as pytorch-msssim computes it: valid windows, 2×2 means between scales
/// (odd sides padded by zeros), negative terms clamped to 0, the product per channel, then the mean over
/// the channels. The smaller side needs more than 160 pixels.
pub fn ms_ssim(a: &Image, b: &Image) -> Result<f64> {
    check("MS-SSIM", a, b)?;
    need_side("MS-SSIM over five scales", a, 161)?;
    let channels = a.channels as usize;
    let values: Vec<f64> = (0..channels)
        .into_par_iter()
        .map(|c| {
            let (mut x, mut y) = (Plane::of(a, c), Plane::of(b, c));
            let mut product = 1.0;
            for (scale, weight) in MS_WEIGHTS.into_iter().enumerate() {
                let at = similarity(&x, &y, Border::Valid);
                let last = scale + 1 == MS_WEIGHTS.len();
                let term = mean64(if last { &at.whole } else { &at.contrast });
                product *= term.max(0.0).powf(weight);
                if !last {
                    (x, y) = (x.halved(), y.halved());
                }
            }
            product
        })
        .collect();
    Ok(mean64(&values))
}

fn need_side(what: &str, image: &Image, least: u32) -> Result<()> {
    if image.width.min(image.height) >= least {
        return Ok(());
    }
    Err(Error::Input(format!(
        "{what} needs images of at least {least}×{least} pixels, not {}×{}",
        image.width, image.height
    )))
}

/// Median of |estimate·scale − truth| / truth over the pixels where both depths are finite and positive;
/// `scale` converts the estimate to the truth's unit. `None` where there is no such pixel.
///
/// # Errors
/// The maps have different sizes or more than one channel.
pub fn depth_relative_median(estimate: &Image, truth: &Image, scale: f64) -> Result<Option<f64>> {
    check("the depth error", estimate, truth)?;
    check_mask(truth, estimate)?;
    let usable = |d: f64| d.is_finite() && d > 0.0;
    let mut errors: Vec<f64> = estimate
        .pixels
        .iter()
        .zip(&truth.pixels)
        .map(|(&e, &t)| (f64::from(e) * scale, f64::from(t)))
        .filter(|&(e, t)| usable(e) && usable(t))
        .map(|(e, t)| (e - t).abs() / t)
        .collect();
    if errors.is_empty() {
        return Ok(None);
    }
    errors.sort_by(f64::total_cmp);
    let n = errors.len();
    Ok(Some((errors[(n - 1) / 2] + errors[n / 2]) / 2.0))
}

/// Intersection over union of two masks (one channel, set above one half); 1 where both are empty.
pub fn mask_iou(a: &Image, b: &Image) -> Result<f64> {
    check("the mask IoU", a, b)?;
    check_mask(a, b)?;
    let set = |v: &f32| *v > 0.5;
    let (mut both, mut either) = (0u64, 0u64);
    for (x, y) in a.pixels.iter().zip(&b.pixels) {
        both += u64::from(set(x) && set(y));
        either += u64::from(set(x) || set(y));
    }
    Ok(if either == 0 { 1.0 } else { both as f64 / either as f64 })
}

fn mean(values: &[f32]) -> f64 {
    values.iter().map(|&v| f64::from(v)).sum::<f64>() / values.len() as f64
}

fn mean64(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

/// One channel in f64.
struct Plane {
    width: usize,
    height: usize,
    values: Vec<f64>,
}

impl Plane {
    /// A channel of an image, clamped.
    fn of(image: &Image, channel: usize) -> Plane {
        let channels = image.channels as usize;
        let values = image.pixels.iter().skip(channel).step_by(channels).map(|&v| clamped(v));
        Plane {
            width: image.width as usize,
            height: image.height as usize,
            values: values.collect(),
        }
    }

    /// Means of 2×2 pixels; an odd side is padded with a zero on both ends, as in average pooling with
    /// padding.
    fn halved(&self) -> Plane {
        let (px, py) = (self.width % 2, self.height % 2);
        let (width, height) = (self.width.div_ceil(2), self.height.div_ceil(2));
        let at = |x: usize, y: usize| match (x.checked_sub(px), y.checked_sub(py)) {
            (Some(x), Some(y)) if x < self.width && y < self.height => {
                self.values[y * self.width + x]
            }
            _ => 0.0,
        };
        let values = (0..width * height).map(|i| {
            let (x, y) = (2 * (i % width), 2 * (i / width));
            (at(x, y) + at(x + 1, y) + at(x, y + 1) + at(x + 1, y + 1)) / 4.0
        });
        Plane { width, height, values: values.collect() }
    }

    fn product(&self, other: &Plane) -> Plane {
        let values = self.values.iter().zip(&other.values).map(|(x, y)| x * y).collect();
        Plane { values, ..*self }
    }

    /// Gaussian-window means, rows first.
    fn blurred(&self, border: Border, window: &[f64; WINDOW]) -> Plane {
        let (pad, width, height) = match border {
            Border::Zero => (WINDOW / 2, self.width, self.height),
            Border::Valid => (0, self.width + 1 - WINDOW, self.height + 1 - WINDOW),
        };
        let mut across = vec![0.0; width * self.height];
        for (row, out) in self.values.chunks_exact(self.width).zip(across.chunks_exact_mut(width)) {
            for (x, value) in out.iter_mut().enumerate() {
                let inside = |&(k, _): &(usize, &f64)| {
                    (x + k).checked_sub(pad).is_some_and(|at| at < self.width)
                };
                let taps = window.iter().enumerate().filter(inside);
                *value = taps.map(|(k, weight)| weight * row[x + k - pad]).sum();
            }
        }
        let mut values = vec![0.0; width * height];
        for (y, out) in values.chunks_exact_mut(width).enumerate() {
            for (k, weight) in window.iter().enumerate() {
                let Some(from) = (y + k).checked_sub(pad).filter(|&at| at < self.height) else {
                    continue;
                };
                let row = &across[from * width..(from + 1) * width];
                for (value, v) in out.iter_mut().zip(row) {
                    *value += weight * v;
                }
            }
        }
        Plane { width, height, values }
    }
}

/// Border handling of the window.
#[derive(Clone, Copy)]
enum Border {
    /// Zeros; the result has the image's size.
    Zero,
    /// Only windows inside the image are used.
    Valid,
}

/// SSIM at every pixel, and its contrast–structure factor.
struct Similarity {
    whole: Vec<f64>,
    contrast: Vec<f64>,
}

fn similarity(a: &Plane, b: &Plane, border: Border) -> Similarity {
    let mut window = [0.0; WINDOW];
    for (i, weight) in window.iter_mut().enumerate() {
        let d = i as f64 - (WINDOW / 2) as f64;
        *weight = (-d * d / (2.0 * SIGMA * SIGMA)).exp();
    }
    let sum: f64 = window.iter().sum();
    window.iter_mut().for_each(|w| *w /= sum);
    let [ma, mb, aa, bb, ab] = [
        a.blurred(border, &window),
        b.blurred(border, &window),
        a.product(a).blurred(border, &window),
        b.product(b).blurred(border, &window),
        a.product(b).blurred(border, &window),
    ]
    .map(|plane| plane.values);
    let mut result = Similarity { whole: Vec::new(), contrast: Vec::new() };
    for i in 0..ma.len() {
        let (x, y) = (ma[i], mb[i]);
        let (va, vb, cov) = (aa[i] - x * x, bb[i] - y * y, ab[i] - x * y);
        let contrast = (2.0 * cov + C2) / (va + vb + C2);
        result.contrast.push(contrast);
        result.whole.push((2.0 * x * y + C1) / (x * x + y * y + C1) * contrast);
    }
    result
}

#[cfg(test)]
mod tests {
    use super::*;

    fn noise(width: u32, height: u32, seed: u32) -> Image {
        let mut state = seed;
        let mut image = Image::new(width, height, 3);
        for value in &mut image.pixels {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            *value = (state >> 8) as f32 / (1 << 24) as f32;
        }
        image
    }

    fn flat(width: u32, height: u32, value: f32) -> Image {
        let mut image = Image::new(width, height, 3);
        image.pixels.fill(value);
        image
    }

    #[test]
    fn psnr_of_a_constant_offset_is_its_square() {
        let value = psnr(&flat(7, 5, 0.25), &flat(7, 5, 0.35)).unwrap();
        assert!((value - 20.0).abs() < 1e-5, "{value}");
        // 1.7 counts as 1.
        assert!((psnr(&flat(2, 2, 0.9), &flat(2, 2, 1.7)).unwrap() - 20.0).abs() < 1e-5);
        assert_eq!(psnr(&flat(2, 2, 0.3), &flat(2, 2, 0.3)).unwrap(), f64::INFINITY);
        assert!(psnr(&flat(2, 2, 0.3), &flat(2, 3, 0.3)).is_err());
    }

    #[test]
    fn masked_psnr_sees_only_the_mask() {
        let a = flat(4, 1, 0.5);
        let mut b = flat(4, 1, 0.5);
        b.at_mut(0, 0).fill(1.0);
        b.at_mut(3, 0).fill(0.6);
        let mut mask = Image::new(4, 1, 1);
        assert!(masked_psnr(&a, &b, &mask).is_err());
        mask.pixels = vec![0.0, 0.0, 0.0, 1.0];
        assert!((masked_psnr(&a, &b, &mask).unwrap() - 20.0).abs() < 1e-5);
    }

    #[test]
    fn a_masked_mean_sees_only_the_mask() {
        let (a, mut b) = (noise(40, 16, 1), noise(40, 16, 1));
        for y in 0..16 {
            b.at_mut(30, y).fill(0.0);
        }
        let map = ssim_map(&a, &b).unwrap();
        let mut mask = Image::new(40, 16, 1);
        assert!(masked_mean(&map, &mask).is_err());
        for y in 0..16 {
            (0..20).for_each(|x| mask.at_mut(x, y).fill(1.0));
        }
        assert!((masked_mean(&map, &mask).unwrap() - 1.0).abs() < 1e-6, "no window reaches over");
        mask.pixels.fill(1.0);
        assert!((masked_mean(&map, &mask).unwrap() - ssim(&a, &b).unwrap()).abs() < 1e-9);
        assert!(masked_mean(&map, &Image::new(39, 16, 1)).is_err());
    }

    /// SSIM at one pixel directly from its definition, with a two-dimensional window.
    fn direct(a: &Image, b: &Image, cx: i64, cy: i64, channel: usize) -> f64 {
        let (mut weights, mut sums) = (0.0, [0.0; 5]);
        for dy in -5..=5i64 {
            for dx in -5..=5i64 {
                let weight = (-((dx * dx + dy * dy) as f64) / 4.5).exp();
                weights += weight;
                let (x, y) = (cx + dx, cy + dy);
                if x < 0 || y < 0 || x >= i64::from(a.width) || y >= i64::from(a.height) {
                    continue;
                }
                let p = f64::from(a.at(x as u32, y as u32)[channel]);
                let q = f64::from(b.at(x as u32, y as u32)[channel]);
                for (sum, v) in sums.iter_mut().zip([p, q, p * p, q * q, p * q]) {
                    *sum += weight * v;
                }
            }
        }
        let [x, y, xx, yy, xy] = sums.map(|s| s / weights);
        (2.0 * x * y + 1e-4) * (2.0 * (xy - x * y) + 9e-4)
            / ((x * x + y * y + 1e-4) * (xx - x * x + yy - y * y + 9e-4))
    }

    #[test]
    fn ssim_is_its_definition() {
        let (a, mut b) = (noise(23, 17, 1), noise(23, 17, 2));
        for (x, y) in b.pixels.iter_mut().zip(&a.pixels) {
            *x = 0.7 * y + 0.3 * *x;
        }
        let map = ssim_map(&a, &b).unwrap();
        let (mut valid, mut count) = (0.0, 0.0);
        for y in 0..17 {
            for x in 0..23 {
                for c in 0..3 {
                    let expected = direct(&a, &b, x, y, c);
                    let found = f64::from(map.at(x as u32, y as u32)[c]);
                    assert!((found - expected).abs() < 1e-6, "{x} {y} {c}: {found} {expected}");
                    if (5..18).contains(&x) && (5..12).contains(&y) {
                        valid += expected;
                        count += 1.0;
                    }
                }
            }
        }
        assert!((ssim_valid(&a, &b).unwrap() - valid / count).abs() < 1e-9);
        assert!((ssim(&a, &a).unwrap() - 1.0).abs() < 1e-7);
        assert!(ssim_valid(&noise(10, 30, 1), &noise(10, 30, 1)).is_err());
    }

    #[test]
    fn ms_ssim_of_flat_images_is_the_luminance_term() {
        // No structure: every contrast factor is 1, and only the weighted luminance term of the coarsest
        // scale remains. 176 is divisible by 2 four times.
        let value = ms_ssim(&flat(176, 176, 0.4), &flat(176, 176, 0.6)).unwrap();
        let luminance: f64 = (2.0 * 0.24 + 1e-4) / (0.16 + 0.36 + 1e-4);
        assert!((value - luminance.powf(0.1333)).abs() < 1e-6, "{value}");
        let image = noise(177, 163, 3);
        assert!((ms_ssim(&image, &image).unwrap() - 1.0).abs() < 1e-12);
        assert!(ms_ssim(&noise(160, 200, 1), &noise(160, 200, 1)).is_err());
    }

    #[test]
    fn halving_pads_odd_sides_by_zeros() {
        let plane = Plane { width: 3, height: 2, values: vec![1.0, 2.0, 3.0, 5.0, 6.0, 7.0] };
        let half = plane.halved();
        assert_eq!((half.width, half.height), (2, 1));
        assert_eq!(half.values, [6.0 / 4.0, 18.0 / 4.0]);
    }

    #[test]
    fn depth_error_is_a_median_over_what_both_know() {
        let map = |values: &[f32]| Image {
            width: values.len() as u32,
            height: 1,
            channels: 1,
            pixels: values.to_vec(),
        };
        let truth = map(&[1.0, 2.0, 4.0, 0.0, f32::INFINITY, 5.0]);
        let estimate = map(&[0.55, 1.0, 3.0, 1.0, 1.0, f32::NAN]);
        let value = depth_relative_median(&estimate, &truth, 2.0).unwrap().unwrap();
        assert!((value - 0.1).abs() < 1e-6, "{value}");
        assert_eq!(depth_relative_median(&map(&[0.0]), &map(&[1.0]), 1.0).unwrap(), None);
    }

    #[test]
    fn iou_counts_pixels() {
        let mask = |values: &[f32]| Image {
            width: values.len() as u32,
            height: 1,
            channels: 1,
            pixels: values.to_vec(),
        };
        let (a, b) = (mask(&[1.0, 1.0, 0.0, 0.0]), mask(&[1.0, 0.0, 1.0, 0.0]));
        assert_eq!(mask_iou(&a, &b).unwrap(), 1.0 / 3.0);
        assert_eq!(mask_iou(&mask(&[0.0]), &mask(&[0.0])).unwrap(), 1.0);
    }
}
