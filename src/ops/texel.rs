//! Pictures in the formats of textures, to be copied into a host's image.
//!
//! The values stay what they are, the encoded ones of the pictures that the scene was trained with: an
//! image of 8-bit sRGB takes these bytes as an image of plain 8-bit values does.
//!
//! ```no_run
//! use splat4d::embed::HostImage;
//! use splat4d::gpu::{Buffer, Recorder};
//! use splat4d::ops::texel;
//! use splat4d::renderer::Renderer;
//!
//! /// After `Renderer::record`, with a buffer of as many texels as the picture has pixels.
//! ///
//! /// # Safety
//! /// As for `Recorder::copy_to_image`, the image of 8 bits a channel.
//! unsafe fn show(
//!     recorder: &mut Recorder,
//!     renderer: &Renderer,
//!     texels: &mut Buffer<u32>,
//!     image: &HostImage,
//! ) -> splat4d::Result<()> {
//!     let picture = renderer.pixels().expect("a frame was recorded");
//!     let packing = texel::Packing { background: [0.1, 0.1, 0.1, 1.0], ..Default::default() };
//!     texel::unorm8(recorder, picture.rgba.view(), &packing, texels.view_mut())?;
//!     unsafe { recorder.copy_to_image(texels.view(), image, picture.width, picture.height) }
//! }
//! ```

use super::at_least;
use crate::Result;
use crate::gpu::{Groups, Recorder, View, ViewMut};
use crate::kernels::texel as kernels;

const WORKGROUP: u32 = 64;

/// How a picture is packed into eight bits a channel.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Packing {
    /// Premultiplied, behind the picture; all 0 leaves it as it is.
    pub background: [f32; 4],
    /// Blue, green, red, alpha, as the images of many windows have it.
    pub blue_first: bool,
}

/// Records `texel/unorm8`: a premultiplied picture into eight bits a channel, the first the lowest
/// byte, the nearest of 255 steps. What is not finite counts as 0.
///
/// # Errors
/// [`Error::Shape`](crate::Error::Shape) for fewer texels than pixels.
pub fn unorm8(
    recorder: &mut Recorder,
    rgba: View<'_, [f32; 4]>,
    packing: &Packing,
    texels: ViewMut<'_, u32>,
) -> Result<()> {
    let pixels = rgba.len();
    at_least("texel", &[("texels", pixels, texels.len())])?;
    let [red, green, blue, alpha] = packing.background;
    recorder.dispatch::<kernels::Unorm8>(
        Groups::linear(pixels, WORKGROUP, recorder.device().limits())?,
        kernels::Unorm8Params {
            pixels: pixels as u32,
            blue_first: u32::from(packing.blue_first),
            red,
            green,
            blue,
            alpha,
        },
        kernels::Unorm8Args { rgba, texels },
    )
}

/// Records `texel/half`: a premultiplied picture over a premultiplied background into 16-bit
/// floats, the nearest, ties to even, and the largest where it is out of range. What is not finite
/// counts as 0.
///
/// # Errors
/// [`Error::Shape`](crate::Error::Shape) for fewer texels than pixels.
pub fn half(
    recorder: &mut Recorder,
    rgba: View<'_, [f32; 4]>,
    background: [f32; 4],
    texels: ViewMut<'_, [u32; 2]>,
) -> Result<()> {
    let pixels = rgba.len();
    at_least("texel", &[("texels", pixels, texels.len())])?;
    let [red, green, blue, alpha] = background;
    recorder.dispatch::<kernels::Half>(
        Groups::linear(pixels, WORKGROUP, recorder.device().limits())?,
        kernels::HalfParams { pixels: pixels as u32, red, green, blue, alpha },
        kernels::HalfArgs { rgba, texels },
    )
}
