//! Images on the host.

#[cfg(feature = "files")]
use serde::{Deserialize, Serialize};

/// A float image, row-major, channels interleaved.
#[derive(Clone, Debug, PartialEq)]
#[cfg_attr(feature = "files", derive(Serialize, Deserialize))]
pub struct Image {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// Values per pixel.
    pub channels: u32,
    /// `height · width · channels` values.
    pub pixels: Vec<f32>,
}

impl Image {
    /// An image of zeros.
    pub fn new(width: u32, height: u32, channels: u32) -> Image {
        let pixels = vec![0.0; width as usize * height as usize * channels as usize];
        Image { width, height, channels, pixels }
    }

    /// The values of one pixel.
    pub fn at(&self, x: u32, y: u32) -> &[f32] {
        let c = self.channels as usize;
        let start = (y as usize * self.width as usize + x as usize) * c;
        &self.pixels[start..start + c]
    }

    /// The values of one pixel, to write.
    pub fn at_mut(&mut self, x: u32, y: u32) -> &mut [f32] {
        let c = self.channels as usize;
        let start = (y as usize * self.width as usize + x as usize) * c;
        &mut self.pixels[start..start + c]
    }

    /// The bilinearly interpolated value of a one-channel image at a pixel position. Pixel centres
    /// lie at +0.5; positions outside are clamped to the outermost centres.
    #[cfg(feature = "reconstruct")]
    pub(crate) fn between(&self, x: f64, y: f64) -> f32 {
        let along = |at: f64, side: u32| {
            let at = (at - 0.5).clamp(0.0, f64::from(side - 1));
            let first = (at as u32).min(side.saturating_sub(2));
            (first, (first + 1).min(side - 1), (at - f64::from(first)) as f32)
        };
        let ((x0, x1, fx), (y0, y1, fy)) = (along(x, self.width), along(y, self.height));
        let row = |y: u32| {
            let (a, b) = (self.at(x0, y)[0], self.at(x1, y)[0]);
            a + (b - a) * fx
        };
        let (top, bottom) = (row(y0), row(y1));
        top + (bottom - top) * fy
    }

    /// Dilates a mask (one channel): whether a value above one half lies within `radius` pixels of
    /// each pixel, horizontally and vertically.
    #[cfg(feature = "reconstruct")]
    pub(crate) fn near(&self, reach: usize) -> Vec<bool> {
        let (w, h) = (self.width as usize, self.height as usize);
        let set: Vec<bool> = self.pixels.iter().map(|p| *p > 0.5).collect();
        let across: Vec<bool> = (0..w * h)
            .map(|i| {
                let (x, row) = (i % w, i / w * w);
                set[row + x.saturating_sub(reach)..=row + (x + reach).min(w - 1)].contains(&true)
            })
            .collect();
        (0..w * h)
            .map(|i| {
                let (x, y) = (i % w, i / w);
                (y.saturating_sub(reach)..=(y + reach).min(h - 1)).any(|y| across[y * w + x])
            })
            .collect()
    }
}

#[cfg(all(test, feature = "reconstruct"))]
mod tests {
    use super::*;

    #[test]
    fn between_centres_values_are_bilinear_and_beyond_them_level() {
        let image =
            Image { width: 3, height: 2, channels: 1, pixels: vec![0., 1., 2., 4., 5., 6.] };
        let cases = [
            ((0.5, 0.5), 0.0),
            ((2.5, 1.5), 6.0),
            ((1.0, 0.5), 0.5),
            ((1.5, 1.0), 3.0),
            ((2.25, 0.75), 2.75),
            ((-3.0, 9.0), 4.0),
            ((9.0, 0.0), 2.0),
        ];
        for ((x, y), expected) in cases {
            assert_eq!(image.between(x, y), expected, "{x} {y}");
        }
        let single = Image { width: 1, height: 1, channels: 1, pixels: vec![7.0] };
        assert_eq!(single.between(0.2, 0.9), 7.0);
    }

    #[test]
    fn what_is_near_a_mask_is_a_square_about_each_of_its_pixels() {
        let mut mask = Image::new(9, 7, 1);
        for (x, y) in [(0, 0), (5, 3)] {
            mask.at_mut(x, y)[0] = 1.0;
        }
        // A value of exactly one half is outside the mask.
        mask.at_mut(8, 6)[0] = 0.5;
        for reach in [0u32, 2, 20] {
            let near = mask.near(reach as usize);
            for (i, near) in near.iter().enumerate() {
                let (x, y) = (i as u32 % 9, i as u32 / 9);
                let within = |(px, py)| x.abs_diff(px).max(y.abs_diff(py)) <= reach;
                assert_eq!(*near, [(0, 0), (5, 3)].into_iter().any(within), "{reach}: {x}, {y}");
            }
        }
    }
}
