//! Conversion of rendered images to texture formats, to be copied into an image of a host application.
//!
//! The values are not converted: they are encoded colours, as in the images that the scene was trained
//! on. An image of 8-bit sRGB takes these bytes just as an image of plain 8-bit values does.
//!
//! ```no_run
//! use splat4d::embed::HostImage;
//! use splat4d::gpu::{Buffer, Recorder};
//! use splat4d::ops::texel;
//! use splat4d::renderer::Renderer;
//!
//! /// After `Renderer::record`, with a buffer of one texel per pixel of the image.
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

/// How a rendered image is packed into eight bits a channel.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Packing {
    /// Background colour, premultiplied; all 0 leaves the image as it is.
    pub background: [f32; 4],
    /// Whether the channel order is blue, green, red, alpha, as in the images of many windows.
    pub blue_first: bool,
}

/// Records `texel/unorm8`: converts a premultiplied image into eight bits a channel, the first channel
/// in the lowest byte, rounded to the nearest of the 255 steps. Values that are not finite become 0.
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

/// Records `texel/half`: composites a premultiplied image over a premultiplied background and converts
/// it to 16-bit floats. Values are rounded to nearest, ties to even, and clamped to the largest where
/// they are out of range. Values that are not finite become 0.
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
