//! Renders and encodes images for the page.

use std::io::Cursor;
use std::time::Instant;

use image::codecs::jpeg::JpegEncoder;
use image::codecs::png::PngEncoder;
use image::{ExtendedColorType, ImageEncoder};

use super::Show;
use super::protocol::{Format, Header, Layer, Request};
use crate::data::shades;
use crate::gpu::Device;
use crate::io::check_memory;
use crate::renderer::Renderer;
use crate::types::{Camera, Image};
use crate::{Error, Result};

/// Host memory per pixel of an image and its intermediate data, bytes.
const BYTES_A_PIXEL: u64 = 64;
/// Share of the pixels at either end of the depth range that does not extend the displayed range.
const OUTLIERS: f64 = 0.02;
/// Minimum flow length that is shown at full saturation, pixels.
const LEAST_FLOW: f64 = 1.0;
/// Assumed number of frames of a scene whose cameras have no times.
const USUAL_FRAMES: f64 = 30.0;

/// Renders and encodes requested images.
pub struct Painter {
    renderer: Renderer,
    background: [f32; 3],
    /// Time between two input frames.
    frame_time: f64,
}

impl Painter {
    /// Loads a scene on a device.
    ///
    /// # Errors
    /// Those of [`Renderer::tuned`].
    pub fn new(device: &Device, show: &Show) -> Result<Painter> {
        let cameras = &show.scene.cameras;
        let mut times: Vec<f64> = cameras.iter().map(|known| known.time).collect();
        times.dedup();
        let frame_time = match times.len() {
            0 | 1 => 1.0 / USUAL_FRAMES,
            n => 1.0 / (n - 1) as f64,
        };
        let renderer = Renderer::tuned(device, &show.scene, &show.tuning)?;
        Ok(Painter { renderer, background: show.scene.background, frame_time })
    }

    /// The answer to a request, see [`super::protocol`].
    ///
    /// # Errors
    /// [`Error::Input`] for an invalid request; those of [`Renderer::render`].
    pub fn paint(&mut self, request: &Request) -> Result<Vec<u8>> {
        let (camera, time) = request.checked().map_err(Error::Input)?;
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        let pixels = u64::from(width) * u64::from(height);
        check_memory(pixels * BYTES_A_PIXEL, &format!("an image of {width}×{height}"))?;
        let begun = Instant::now();
        let (picture, range) = self.picture(request.layer, &camera, time)?;
        let points = match request.points {
            true => self.renderer.control_points(time)?,
            false => Vec::new(),
        };
        let header = Header {
            id: request.id,
            width,
            height,
            time,
            layer: request.layer,
            format: request.format,
            milliseconds: 1e3 * begun.elapsed().as_secs_f64(),
            gaussians: self.renderer.len(),
            range,
            points: points.len(),
        };
        let json = serde_json::to_vec(&header).map_err(|e| Error::Failed(e.to_string()))?;
        let mut message = (json.len() as u32).to_le_bytes().to_vec();
        message.extend(json);
        for point in points {
            let at = point.unwrap_or_default().as_vec3();
            let row = [at.x, at.y, at.z, if point.is_some() { 1.0 } else { 0.0 }];
            message.extend(row.into_iter().flat_map(f32::to_le_bytes));
        }
        pack(&picture, request.format, request.quality, &mut message)?;
        Ok(message)
    }

    /// The image of a layer, with 1 or 3 channels; for depth and flow with its displayed range.
    fn picture(
        &mut self,
        layer: Layer,
        camera: &Camera,
        time: f64,
    ) -> Result<(Image, Option<[f32; 2]>)> {
        let of = |pixels: Vec<f32>| {
            let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
            Image { width, height, channels: 1, pixels }
        };
        Ok(match layer {
            Layer::Colour => {
                let rendered = self.renderer.render(camera, time)?;
                (rendered.over(self.background), None)
            }
            Layer::Alpha => {
                let rgba = self.renderer.render(camera, time)?.rgba;
                (of(rgba.pixels.chunks_exact(4).map(|p| p[3]).collect()), None)
            }
            Layer::Depth => {
                let depth = self.renderer.render(camera, time)?.mean_depth();
                let (pixels, range) = by_nearness(&depth.pixels);
                (of(pixels), range)
            }
            Layer::Motion => {
                self.renderer.render(camera, time)?;
                (self.renderer.moving()?, None)
            }
            Layer::Flow => {
                let seen = self.renderer.render(camera, time)?;
                let later = time + self.frame_time;
                let (to, sign) =
                    if later <= 1.0 { (later, 1.0) } else { (time - self.frame_time, -1.0) };
                let mut flow =
                    self.renderer.flow(&seen, (camera, time), (camera, to.clamp(0.0, 1.0)))?;
                flow.pixels.iter_mut().for_each(|v| *v *= sign);
                let most = shades::brightest([&shades::lengths(&flow)].into_iter(), LEAST_FLOW);
                (shades::flow(&flow, most), Some([0.0, most as f32]))
            }
            Layer::Normal => {
                self.renderer.render(camera, time)?;
                (shades::normals(&self.renderer.normals(camera, time)?), None)
            }
        })
    }
}

/// Inverse depths scaled to [0, 1] over their range in the image, and the depths of 1 and of 0; depths of 0
/// are empty.
fn by_nearness(depths: &[f32]) -> (Vec<f32>, Option<[f32; 2]>) {
    let mut known: Vec<f32> =
        depths.iter().filter(|d| **d > 0.0 && d.is_finite()).map(|d| 1.0 / d).collect();
    if known.is_empty() {
        return (vec![0.0; depths.len()], None);
    }
    let mut at = |share: f64| {
        let place = (share * (known.len() - 1) as f64).round() as usize;
        *known.select_nth_unstable_by(place, f32::total_cmp).1
    };
    let (low, high) = (at(OUTLIERS), at(1.0 - OUTLIERS));
    let span = (high - low).max(1e-6 * high);
    // The farthest depth stays distinguishable from empty pixels.
    let shade = |d: &f32| match *d > 0.0 && d.is_finite() {
        true => 0.1 + 0.9 * ((1.0 / d - low) / span).clamp(0.0, 1.0),
        false => 0.0,
    };
    (depths.iter().map(shade).collect(), Some([1.0 / high, 1.0 / low]))
}

/// Appends an image of 1 or 3 channels as an encoded file.
pub fn pack(picture: &Image, format: Format, quality: u8, into: &mut Vec<u8>) -> Result<()> {
    // `as` clamps values to [0, 255] and converts NaN to 0.
    let bytes: Vec<u8> = picture.pixels.iter().map(|v| (v * 255.0).round() as u8).collect();
    let colour =
        if picture.channels == 1 { ExtendedColorType::L8 } else { ExtendedColorType::Rgb8 };
    let end = into.len() as u64;
    let mut sink = Cursor::new(into);
    sink.set_position(end);
    let packed = match format {
        Format::Jpeg => JpegEncoder::new_with_quality(&mut sink, quality).write_image(
            &bytes,
            picture.width,
            picture.height,
            colour,
        ),
        Format::Png => {
            PngEncoder::new(&mut sink).write_image(&bytes, picture.width, picture.height, colour)
        }
    };
    packed.map_err(|error| Error::Failed(format!("an image cannot be packed: {error}")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nearness_is_white_and_nothing_is_black() {
        let (shades, range) = by_nearness(&[0.0, 1.0, 2.0, 4.0, f32::INFINITY]);
        assert_eq!(range, Some([1.0, 4.0]));
        assert_eq!((shades[0], shades[4]), (0.0, 0.0));
        for (shade, expected) in shades[1..4].iter().zip([1.0, 0.4, 0.1]) {
            assert!((shade - expected).abs() < 1e-6, "{shades:?}");
        }
        assert_eq!(by_nearness(&[0.0; 3]), (vec![0.0; 3], None));
        let (flat, range) = by_nearness(&[3.0; 4]);
        assert!(flat.iter().all(|s| (0.1..=1.0).contains(s)) && range.is_some());
    }

    #[test]
    fn a_png_holds_the_picture_and_what_was_before_it_stays() {
        let picture = Image {
            width: 2,
            height: 1,
            channels: 3,
            pixels: vec![0.0, 0.5, 1.0, 2.0, -1.0, f32::NAN],
        };
        let mut message = b"head".to_vec();
        pack(&picture, Format::Png, 90, &mut message).unwrap();
        assert!(message.starts_with(b"head"));
        let back = image::load_from_memory(&message[4..]).unwrap().into_rgb8();
        assert_eq!(back.into_raw(), [0, 128, 255, 255, 0, 0]);
    }
}
