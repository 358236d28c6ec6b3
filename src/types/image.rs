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
}
