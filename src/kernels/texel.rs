//! Pictures in the formats of textures.

use crate::gpu::kernel;

kernel! {
    /// Eight bits a channel.
    pub struct Unorm8("texel/unorm8"), workgroup: [64, 1, 1],
    params: Unorm8Params {
        /// Pixels.
        pixels: u32,
        /// Not 0 for blue, green, red, alpha.
        blue_first: u32,
        /// Of what lies behind, premultiplied.
        red: f32,
        /// As red.
        green: f32,
        /// As red.
        blue: f32,
        /// As red.
        alpha: f32,
    },
    args: Unorm8Args {
        /// Premultiplied.
        rgba: Read<[f32; 4]>,
        /// A byte for each channel, the first the lowest.
        texels: Write<u32>,
    }
}

kernel! {
    /// 16-bit floats.
    pub struct Half("texel/half"), workgroup: [64, 1, 1],
    params: HalfParams {
        /// Pixels.
        pixels: u32,
        /// Of what lies behind, premultiplied.
        red: f32,
        /// As red.
        green: f32,
        /// As red.
        blue: f32,
        /// As red.
        alpha: f32,
    },
    args: HalfArgs {
        /// Premultiplied.
        rgba: Read<[f32; 4]>,
        /// Red and green, blue and alpha; the first of each in the lower half.
        texels: Write<[u32; 2]>,
    }
}
