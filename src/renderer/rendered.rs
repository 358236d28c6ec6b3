//! Rendered images on the host.

use crate::types::Image;

/// A rendered image, as blended on the device.
#[derive(Clone, Debug)]
pub struct Rendered {
    /// Premultiplied RGB without background, and alpha: 4 channels.
    pub rgba: Image,
    /// Σ α · T · z, 1 channel; the mean depth is this divided by alpha.
    pub depth: Image,
}

impl Rendered {
    /// The colour composited over a background: 3 channels.
    pub fn over(&self, background: [f32; 3]) -> Image {
        let mut image = Image::new(self.rgba.width, self.rgba.height, 3);
        let pixels = self.rgba.pixels.chunks_exact(4);
        for (out, rgba) in image.pixels.chunks_exact_mut(3).zip(pixels) {
            for k in 0..3 {
                out[k] = rgba[k] + (1.0 - rgba[3]) * background[k];
            }
        }
        image
    }

    /// Mean depth, 1 channel; 0 where alpha is 1e-3 or less.
    pub fn mean_depth(&self) -> Image {
        let mut image = self.depth.clone();
        for (depth, rgba) in image.pixels.iter_mut().zip(self.rgba.pixels.chunks_exact(4)) {
            *depth = if rgba[3] > 1e-3 { *depth / rgba[3] } else { 0.0 };
        }
        image
    }
}
