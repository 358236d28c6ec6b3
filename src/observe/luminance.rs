//! Image luminance as a smooth surface, for sub-pixel alignment.

use glam::DVec2;

use crate::types::Image;

/// The mean of an image's channels, smoothed with a 5 × 5 binomial filter.
#[derive(Debug)]
pub(crate) struct Luminance {
    width: usize,
    height: usize,
    values: Vec<f32>,
}

impl Luminance {
    /// The luminance of an image.
    pub fn of(image: &Image) -> Luminance {
        let (width, height) = (image.width as usize, image.height as usize);
        let luminance: Vec<f32> = image
            .pixels
            .chunks_exact(image.channels as usize)
            .map(|p| p.iter().sum::<f32>() / p.len() as f32)
            .collect();
        const TAPS: [f32; 5] = [1.0 / 16.0, 4.0 / 16.0, 6.0 / 16.0, 4.0 / 16.0, 1.0 / 16.0];
        let clamp = |at: usize, k: usize, size: usize| (at + k).saturating_sub(2).min(size - 1);
        let pass = |from: &[f32], across: bool| -> Vec<f32> {
            (0..width * height)
                .map(|i| {
                    let (x, y) = (i % width, i / width);
                    let tap = |k: usize| match across {
                        true => from[y * width + clamp(x, k, width)],
                        false => from[clamp(y, k, height) * width + x],
                    };
                    TAPS.iter().enumerate().map(|(k, t)| t * tap(k)).sum()
                })
                .collect()
        };
        let values = pass(&pass(&luminance, true), false);
        Luminance { width, height, values }
    }

    /// Value and gradient (per pixel) at a position of the Catmull–Rom surface through the pixels; `None`
    /// within two pixels of the border.
    pub fn sample(&self, at: DVec2) -> Option<(f64, DVec2)> {
        let (x, y) = (at.x - 0.5, at.y - 0.5);
        let (x0, y0) = (x.floor(), y.floor());
        let within = |v: f64, size: usize| v >= 1.0 && v + 3.0 <= size as f64;
        if !within(x0, self.width) || !within(y0, self.height) {
            return None;
        }
        let (wx, dx) = cubic(x - x0);
        let (wy, dy) = cubic(y - y0);
        let (mut value, mut gx, mut gy) = (0.0, 0.0, 0.0);
        for j in 0..4 {
            let row = (y0 as usize + j - 1) * self.width + x0 as usize - 1;
            let (mut v, mut g) = (0.0, 0.0);
            for i in 0..4 {
                let c = f64::from(self.values[row + i]);
                v += wx[i] * c;
                g += dx[i] * c;
            }
            value += wy[j] * v;
            gx += wy[j] * g;
            gy += dy[j] * v;
        }
        Some((value, DVec2::new(gx, gy)))
    }
}

/// Catmull–Rom weights of four neighbours, and their derivatives.
fn cubic(t: f64) -> ([f64; 4], [f64; 4]) {
    let (t2, t3) = (t * t, t * t * t);
    (
        [
            0.5 * (-t3 + 2.0 * t2 - t),
            0.5 * (3.0 * t3 - 5.0 * t2 + 2.0),
            0.5 * (-3.0 * t3 + 4.0 * t2 + t),
            0.5 * (t3 - t2),
        ],
        [
            0.5 * (-3.0 * t2 + 4.0 * t - 1.0),
            0.5 * (9.0 * t2 - 10.0 * t),
            0.5 * (-9.0 * t2 + 8.0 * t + 1.0),
            0.5 * (3.0 * t2 - 2.0 * t),
        ],
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_slope_keeps_its_values_and_gradient_and_edges_are_refused() {
        let mut image = Image::new(16, 12, 3);
        for y in 0..12 {
            for x in 0..16 {
                let (x_at, y_at) = (x as f32 + 0.5, y as f32 + 0.5);
                image.at_mut(x, y).fill(0.02 * x_at - 0.03 * y_at + 0.5);
            }
        }
        let luminance = Luminance::of(&image);
        for at in [DVec2::new(6.3, 5.9), DVec2::new(8.0, 6.5), DVec2::new(7.99, 4.51)] {
            let (value, gradient) = luminance.sample(at).unwrap();
            assert!((value - (0.02 * at.x - 0.03 * at.y + 0.5)).abs() < 1e-6, "{at}: {value}");
            assert!(gradient.distance(DVec2::new(0.02, -0.03)) < 1e-6, "{at}: {gradient}");
        }
        let nan = DVec2::splat(f64::NAN);
        for outside in [DVec2::new(1.2, 6.0), DVec2::new(8.0, 11.0), DVec2::new(1e300, 5.0), nan] {
            assert!(luminance.sample(outside).is_none(), "{outside}");
        }
    }

    #[test]
    fn gradients_match_central_differences() {
        let mut image = Image::new(16, 12, 1);
        for (i, v) in image.pixels.iter_mut().enumerate() {
            *v = ((i * i) % 17) as f32 / 17.0;
        }
        let luminance = Luminance::of(&image);
        let (at, h) = (DVec2::new(7.3, 5.8), 1e-5);
        let value = |by: DVec2| luminance.sample(at + by).unwrap().0;
        let (_, gradient) = luminance.sample(at).unwrap();
        let numeric = DVec2::new(
            value(DVec2::X * h) - value(-DVec2::X * h),
            value(DVec2::Y * h) - value(-DVec2::Y * h),
        ) / (2.0 * h);
        assert!(gradient.distance(numeric) < 1e-6, "{gradient} {numeric}");
    }
}
