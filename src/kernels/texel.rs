//! Conversion of rendered images to texture formats.

use crate::gpu::kernel;

kernel! {
    /// Converts to eight bits a channel.
    pub struct Unorm8("texel/unorm8"), workgroup: [64, 1, 1],
    params: Unorm8Params {
        /// Number of pixels.
        pixels: u32,
        /// Not 0 for the channel order blue, green, red, alpha.
        blue_first: u32,
        /// Red of the background, premultiplied.
        red: f32,
        /// Green of the background, premultiplied.
        green: f32,
        /// Blue of the background, premultiplied.
        blue: f32,
        /// Alpha of the background.
        alpha: f32,
    },
    args: Unorm8Args {
        /// The rendered image, premultiplied.
        rgba: Read<[f32; 4]>,
        /// One word per pixel, a byte for each channel, the first channel in the lowest byte.
        texels: Write<u32>,
    }
}

kernel! {
    /// Converts to 16-bit floats.
    pub struct Half("texel/half"), workgroup: [64, 1, 1],
    params: HalfParams {
        /// Number of pixels.
        pixels: u32,
        /// Red of the background, premultiplied.
        red: f32,
        /// Green of the background, premultiplied.
        green: f32,
        /// Blue of the background, premultiplied.
        blue: f32,
        /// Alpha of the background.
        alpha: f32,
    },
    args: HalfArgs {
        /// The rendered image, premultiplied.
        rgba: Read<[f32; 4]>,
        /// Two words per pixel: red and green, blue and alpha; the first of each pair in the lower half.
        texels: Write<[u32; 2]>,
    }
}
