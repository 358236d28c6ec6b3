//! Colour maps for depth and scalar values, and images embedded in a page.

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use image::codecs::jpeg::JpegEncoder;
use image::{ExtendedColorType, ImageEncoder};
use splat4d::data::images;
pub use splat4d::data::shades::{UNKNOWN, brightest, flow, lengths, normals};
use splat4d::types::Image;
use splat4d::{Error, Result};

/// JPEG quality.
const QUALITY: u8 = 82;

/// Range of inverse depths that depth images map from dark to bright.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DepthScale {
    low: f32,
    high: f32,
}

impl DepthScale {
    /// From the 2nd to the 98th percentile of some maps; `None` where they are empty.
    pub fn of<'a>(maps: impl IntoIterator<Item = &'a Image>) -> Option<DepthScale> {
        let depths = maps.into_iter().flat_map(|map| &map.pixels);
        let mut inverse: Vec<f32> = depths.filter(|d| **d > 0.0).map(|d| 1.0 / d).collect();
        inverse.sort_by(f32::total_cmp);
        let at = |hundredth: usize| inverse.get(inverse.len() * hundredth / 100).copied();
        at(2).zip(at(98)).map(|(low, high)| DepthScale { low, high })
    }

    /// Near is bright, far is dark, empty pixels are black.
    pub fn shade(&self, depth: &Image) -> Image {
        let mut image = Image::new(depth.width, depth.height, 3);
        for (out, depth) in image.pixels.chunks_exact_mut(3).zip(&depth.pixels) {
            if *depth > 0.0 {
                let share =
                    (1.0 / depth - self.low) / (self.high - self.low).max(f32::MIN_POSITIVE);
                out.fill(0.1 + 0.9 * share.clamp(0.0, 1.0));
            }
        }
        image
    }
}

/// Converts one channel to a grey image.
pub fn grey(map: &Image) -> Image {
    let pixels = map.pixels.iter().flat_map(|v| [*v; 3]).collect();
    Image { channels: 3, pixels, ..*map }
}

/// The colours of the heat map in ascending order: of increasing lightness, so that they are
/// distinguishable without hue.
pub const HEAT: [[f32; 3]; 6] = [
    [0.0, 0.0, 0.05],
    [0.26, 0.04, 0.41],
    [0.58, 0.15, 0.40],
    [0.87, 0.32, 0.23],
    [0.99, 0.65, 0.04],
    [0.99, 1.0, 0.64],
];

/// A heat map of values from 0 to `most`; NaN is grey.
pub fn heat(map: &Image, most: f64) -> Image {
    let mut out = Image::new(map.width, map.height, 3);
    for (to, value) in out.pixels.chunks_exact_mut(3).zip(&map.pixels) {
        if value.is_nan() {
            to.copy_from_slice(&UNKNOWN);
            continue;
        }
        let at = (value / most as f32).clamp(0.0, 1.0) * (HEAT.len() - 1) as f32;
        let low = (at as usize).min(HEAT.len() - 2);
        let share = at - low as f32;
        for c in 0..3 {
            to[c] = HEAT[low][c] * (1.0 - share) + HEAT[low + 1][c] * share;
        }
    }
    out
}

/// The legend of a heat map: from 0 to the maximum, with a unit.
pub fn heat_key(most: f64, unit: &str) -> String {
    let colours: Vec<String> = HEAT
        .iter()
        .map(|colour| {
            let [r, g, b] = colour.map(|v| (v * 255.0).round());
            format!("rgb({r},{g},{b})")
        })
        .collect();
    format!(
        "<span>0{unit}</span><i style=\"background:linear-gradient(90deg,{})\"></i>\
         <span>{most}{unit} and more</span>",
        colours.join(",")
    )
}

/// An image downscaled to a maximum width.
pub fn shrunk(image: &Image, widest: u32) -> Image {
    let width = image.width.min(widest);
    let height =
        (u64::from(image.height) * u64::from(width) / u64::from(image.width.max(1))).max(1);
    images::resize(image, width, height as u32)
}

/// A three-channel image as a `data:` URL.
pub fn address(image: &Image) -> Result<String> {
    let bytes: Vec<u8> =
        image.pixels.iter().map(|v| (v.clamp(0.0, 1.0) * 255.0).round() as u8).collect();
    let mut jpeg = Vec::new();
    JpegEncoder::new_with_quality(&mut jpeg, QUALITY)
        .write_image(&bytes, image.width, image.height, ExtendedColorType::Rgb8)
        .map_err(|error| Error::Failed(format!("an image could not be encoded: {error}")))?;
    Ok(format!("data:image/jpeg;base64,{}", STANDARD.encode(jpeg)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nearer_is_brighter() {
        let depth = Image { width: 4, height: 1, channels: 1, pixels: vec![0.0, 1.0, 2.0, 4.0] };
        let shaded = DepthScale::of([&depth]).unwrap().shade(&depth);
        let values: Vec<f32> = shaded.pixels.iter().step_by(3).copied().collect();
        assert!(values[0] == 0.0 && values[1] > values[2] && values[2] > values[3]);
        assert!(values[3] > 0.0);
        assert_eq!(DepthScale::of([&Image::new(3, 2, 1)]), None);
    }

    #[test]
    fn more_is_lighter() {
        let residual =
            Image { width: 5, height: 1, channels: 1, pixels: vec![0.0, 1.0, 3.0, 9.0, f32::NAN] };
        let drawn = heat(&residual, 5.0);
        let light = |x: u32| drawn.at(x, 0).iter().sum::<f32>();
        assert!(light(0) < light(1) && light(1) < light(2) && light(2) < light(3));
        assert_eq!(drawn.at(4, 0), UNKNOWN);
    }

    #[test]
    fn one_channel_is_grey() {
        assert_eq!(
            grey(&Image { width: 1, height: 1, channels: 1, pixels: vec![0.3] }).pixels,
            [0.3; 3]
        );
    }
}
