//! Image files: decoding, resizing, PNG, masks.

use std::io::Cursor;
use std::path::Path;

use image::{DynamicImage, ImageDecoder, ImageReader};

use crate::io::{
    available_memory, check_memory, check_unpacked, gibibytes, open, read, write_atomically,
};
use crate::types::{Image, range};
use crate::{Error, Result};

/// Supported image file extensions, in the order in which a missing extension is guessed.
pub const EXTENSIONS: [&str; 7] = ["png", "jpg", "jpeg", "webp", "bmp", "tif", "tiff"];

/// Whether the file name has one of [`EXTENSIONS`], in upper or lower case.
pub fn has_image_extension(path: &Path) -> bool {
    path.extension()
        .and_then(|e| e.to_str())
        .is_some_and(|e| EXTENSIONS.contains(&e.to_ascii_lowercase().as_str()))
}

/// Whether to apply an image's EXIF orientation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Orientation {
    /// Upright, as a viewer shows it: for images whose cameras are unknown.
    Upright,
    /// As stored: COLMAP's and nerfstudio's cameras refer to the pixels as they lie in the file.
    Stored,
}

/// Target size of an image.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Resize {
    /// The original size.
    #[default]
    Keep,
    /// Exactly this width and height.
    To(u32, u32),
    /// At most this width; the proportions are kept, and a narrower image is unchanged.
    Width(u32),
    /// At most this many pixels on the longer side; the proportions are kept, and a smaller image is
    /// unchanged.
    Longest(u32),
}

impl Resize {
    /// Resulting size of an image of `width` × `height` pixels, at least 1×1.
    pub fn target(self, width: u32, height: u32) -> (u32, u32) {
        let scaled = |side: u32, to: u32, from: u32| {
            ((f64::from(side) * f64::from(to) / f64::from(from.max(1))).round() as u32).max(1)
        };
        match self {
            Resize::Keep => (width, height),
            Resize::To(w, h) => (w.max(1), h.max(1)),
            Resize::Width(most) if width <= most => (width, height),
            Resize::Width(w) => (w.max(1), scaled(height, w.max(1), width)),
            Resize::Longest(most) if width.max(height) <= most => (width, height),
            Resize::Longest(most) => {
                let longest = width.max(height);
                (scaled(width, most, longest), scaled(height, most, longest))
            }
        }
    }
}

/// Width and height of an image file, from its header.
pub fn dimensions(path: &Path, orientation: Orientation) -> Result<(u32, u32)> {
    let file = open(path)?;
    let reader = ImageReader::new(std::io::BufReader::new(file));
    let reader = reader.with_guessed_format().map_err(Error::io(path))?;
    let mut decoder = reader.into_decoder().map_err(|e| undecodable(path, &e))?;
    let (width, height) = decoder.dimensions();
    let turned = orientation == Orientation::Upright && turns(&mut decoder);
    Ok(if turned { (height, width) } else { (width, height) })
}

/// Whether an image file has an alpha channel, from its header.
pub fn has_alpha(path: &Path) -> Result<bool> {
    let file = open(path)?;
    let reader = ImageReader::new(std::io::BufReader::new(file));
    let reader = reader.with_guessed_format().map_err(Error::io(path))?;
    let decoder = reader.into_decoder().map_err(|e| undecodable(path, &e))?;
    Ok(decoder.color_type().has_alpha())
}

/// Whether the EXIF orientation swaps width and height.
fn turns(decoder: &mut impl ImageDecoder) -> bool {
    use image::metadata::Orientation::*;
    matches!(decoder.orientation(), Ok(Rotate90 | Rotate270 | Rotate90FlipH | Rotate270FlipH))
}

/// Decodes an image file to RGB in [0, 1]; the encoded values are kept (no gamma conversion). An image with
/// an alpha channel is composited over `background`. Grey becomes RGB.
///
/// # Errors
/// [`Error::Io`] where the file cannot be read, [`Error::Format`] where it is not an image.
pub fn decode_rgb(path: &Path, background: [f32; 3], orientation: Orientation) -> Result<Image> {
    rgb_over(decode(path, orientation)?, background)
}

/// Decodes an image file as stored: RGB in [0, 1], and, where there is an alpha channel, a one-channel mask
/// that is 1 where it is opaque, else 0.
///
/// # Errors
/// Those of [`decode_rgb`].
pub(super) fn decode_rgb_and_alpha(path: &Path) -> Result<(Image, Option<Image>)> {
    let image = decode(path, Orientation::Stored)?;
    let (width, height) = (image.width(), image.height());
    let alpha = image.color().has_alpha().then(|| {
        let rgba = image.to_rgba8();
        let pixels = rgba.pixels().map(|p| f32::from(u8::from(p.0[3] == 255))).collect();
        Image { width, height, channels: 1, pixels }
    });
    let pixels = image.into_rgb32f().into_raw();
    Ok((Image { width, height, channels: 3, pixels }, alpha))
}

/// Memory per pixel while an image is read, bytes: decoded with four 8-bit channels, and as three floats.
const READING_BYTES: u64 = 16;

/// Memory that an image needs while it is read, before it is resized, bytes.
fn reading_bytes((width, height): (u32, u32)) -> u64 {
    (u64::from(width) * u64::from(height)).saturating_mul(READING_BYTES)
}

/// Number of images of a size to read concurrently: one per core, fewer where memory is short.
pub(super) fn at_a_time(size: (u32, u32)) -> usize {
    let cores = rayon::current_num_threads();
    let room = available_memory().map_or(u64::MAX, |bytes| bytes / reading_bytes(size).max(1));
    usize::try_from(room).unwrap_or(usize::MAX).clamp(1, cores)
}

/// A note about images that need much memory while they are read, even if their files are small.
pub(super) fn large_note(size: (u32, u32)) -> Option<String> {
    const MUCH: u64 = 1 << 30;
    let bytes = Some(reading_bytes(size)).filter(|bytes| *bytes >= MUCH)?;
    Some(format!(
        "images of {}×{} take {} of memory each while they are read",
        size.0,
        size.1,
        gibibytes(bytes)
    ))
}

/// Decodes a file. A truncated file is an error, even where a decoder would fill in the rest.
fn decode(path: &Path, orientation: Orientation) -> Result<DynamicImage> {
    let bytes = read(path)?;
    if bytes.starts_with(&[0xff, 0xd8]) && !jpeg_ends(&bytes) {
        return Err(Error::format(path, "is cut short: a JPEG image without its end"));
    }
    let reader = ImageReader::new(Cursor::new(&bytes)).with_guessed_format();
    let mut decoder =
        reader.map_err(Error::io(path))?.into_decoder().map_err(|e| undecodable(path, &e))?;
    check_unpacked(path, decoder.total_bytes(), bytes.len())?;
    let (width, height) = decoder.dimensions();
    let what = format!("{}: an image of {width}×{height}", path.display());
    // The decoded image, and the floats.
    let floats = (u64::from(width) * u64::from(height)).saturating_mul(12);
    check_memory(decoder.total_bytes().saturating_add(floats), &what)?;
    let turn = decoder.orientation();
    let mut image = DynamicImage::from_decoder(decoder).map_err(|e| undecodable(path, &e))?;
    if let (Orientation::Upright, Ok(turn)) = (orientation, turn) {
        image.apply_orientation(turn);
    }
    Ok(image)
}

/// Whether a JPEG file contains its image to the end. Decoders fill in missing data with grey.
fn jpeg_ends(bytes: &[u8]) -> bool {
    let mut at = 2;
    while let Some(&marker) = bytes.get(at + 1).filter(|_| bytes[at] == 0xff) {
        match marker {
            0xd9 => return true,
            // Fill bytes and markers without a length.
            0xff => at += 1,
            0x01 | 0xd0..=0xd8 => at += 2,
            _ => {
                let Some(&[high, low]) = bytes.get(at + 2..at + 4) else { return false };
                at += 2 + usize::from(u16::from_be_bytes([high, low]));
                if marker == 0xda {
                    // Compressed data, up to a marker that is neither a restart nor a stuffed 0xff.
                    let pairs = bytes.get(at..).unwrap_or_default().windows(2);
                    let ends = |p: &[u8]| p[0] == 0xff && !matches!(p[1], 0 | 0xd0..=0xd7 | 0xff);
                    match pairs.into_iter().position(ends) {
                        Some(length) => at += length,
                        None => return false,
                    }
                }
            }
        }
    }
    // Data that is not a marker where one is expected is left to the decoder.
    at < bytes.len()
}

fn undecodable(path: &Path, error: &image::ImageError) -> Error {
    Error::format(path, format!("cannot be read as an image: {error}"))
}

fn rgb_over(image: DynamicImage, background: [f32; 3]) -> Result<Image> {
    let (width, height) = (image.width(), image.height());
    let pixels = if image.color().has_alpha() {
        let over = |rgba: &[f32]| {
            let alpha = rgba[3];
            std::array::from_fn::<f32, 3, _>(|c| rgba[c] * alpha + background[c] * (1.0 - alpha))
        };
        image.into_rgba32f().as_raw().chunks_exact(4).flat_map(over).collect()
    } else {
        image.into_rgb32f().into_raw()
    };
    Ok(Image { width, height, channels: 3, pixels })
}

/// Resizes an image of 1 or 3 channels with an antialiased Catmull–Rom filter, whose support is widened
/// when shrinking; the result is clamped to [0, 1].
pub fn resize(image: &Image, width: u32, height: u32) -> Image {
    use image::{ImageBuffer, Luma, Rgb, imageops};
    if (image.width, image.height) == (width, height) {
        return image.clone();
    }
    let filter = imageops::FilterType::CatmullRom;
    let mut pixels = match image.channels {
        3 => {
            let buffer: ImageBuffer<Rgb<f32>, &[f32]> =
                ImageBuffer::from_raw(image.width, image.height, &image.pixels[..])
                    .expect("an Image holds width × height × channels values");
            imageops::resize(&buffer, width, height, filter).into_raw()
        }
        1 => {
            let buffer: ImageBuffer<Luma<f32>, &[f32]> =
                ImageBuffer::from_raw(image.width, image.height, &image.pixels[..])
                    .expect("an Image holds width × height × channels values");
            imageops::resize(&buffer, width, height, filter).into_raw()
        }
        channels => panic!("resize takes 1 or 3 channels, not {channels}"),
    };
    pixels.iter_mut().for_each(|v| *v = v.clamp(0.0, 1.0));
    Image { width, height, channels: image.channels, pixels }
}

/// Writes an 8-bit PNG of 1 (grey), 3 (RGB) or 4 (RGBA, not premultiplied) channels by rename.
/// Values are clamped to [0, 1] and rounded, without any gamma; NaN becomes 0.
pub fn write_png(path: impl AsRef<Path>, image: &Image) -> Result<()> {
    let bytes: Vec<u8> = image.pixels.iter().map(|&v| (v * 255.0).round() as u8).collect();
    let colours = [image::ColorType::L8, image::ColorType::Rgb8, image::ColorType::Rgba8];
    write_bytes(path.as_ref(), image, &bytes, colours)
}

/// Writes a 16-bit PNG, otherwise like [`write_png`].
pub fn write_png_16(path: impl AsRef<Path>, image: &Image) -> Result<()> {
    let values = image.pixels.iter().map(|&v| (v * 65535.0).round() as u16);
    // The encoder takes values in native byte order.
    let bytes: Vec<u8> = values.flat_map(u16::to_ne_bytes).collect();
    let colours = [image::ColorType::L16, image::ColorType::Rgb16, image::ColorType::Rgba16];
    write_bytes(path.as_ref(), image, &bytes, colours)
}

/// Writes encoded pixels as a PNG; `colours` are the colour types for 1, 3 and 4 channels.
fn write_bytes(
    path: &Path,
    image: &Image,
    bytes: &[u8],
    [grey, rgb, rgba]: [image::ColorType; 3],
) -> Result<()> {
    let colour = match image.channels {
        1 => grey,
        3 => rgb,
        4 => rgba,
        n => {
            return Err(Error::Shape {
                op: "write_png",
                arg: "channels",
                expected: "1, 3 or 4".into(),
                actual: n as usize,
            });
        }
    };
    write_atomically(path, |sink| {
        use image::ImageEncoder;
        image::codecs::png::PngEncoder::new(sink)
            .write_image(bytes, image.width, image.height, colour.into())
            .map_err(std::io::Error::other)
    })
}

/// Reads a mask: one channel of 0 and 1. For a grey file, the mask is 1 at values of at least half of
/// white; for a file that holds only the values 0 and 1, where the value is 1. A coloured file is a label
/// map, as in DAVIS 2017: the mask is 1 where it is not black.
pub fn read_mask(path: impl AsRef<Path>) -> Result<Image> {
    let image = decode(path.as_ref(), Orientation::Stored)?;
    let (width, height) = (image.width(), image.height());
    // Compression adds a slight tint to grey.
    const COLOURED: u8 = 32;
    let coloured = image.color().has_color() && {
        let span = |p: &image::Rgb<u8>| p.0.iter().max().zip(p.0.iter().min()).map(|(a, b)| a - b);
        image.to_rgb8().pixels().any(|p| span(p) >= Some(COLOURED))
    };
    let grey = image.into_luma8();
    let binary = grey.as_raw().iter().all(|v| *v <= 1);
    let least = if coloured || binary { 1 } else { 128 };
    let pixels = grey.as_raw().iter().map(|v| f32::from(u8::from(*v >= least))).collect();
    Ok(Image { width, height, channels: 1, pixels })
}

/// Reads a 16-bit grey image: one channel, with the stored values.
pub(super) fn read_grey16(path: &Path) -> Result<Image> {
    match decode(path, Orientation::Stored)? {
        DynamicImage::ImageLuma16(grey) => Ok(Image {
            width: grey.width(),
            height: grey.height(),
            channels: 1,
            pixels: grey.as_raw().iter().map(|&v| f32::from(v)).collect(),
        }),
        other => Err(not_of_16_bits(path, "a grey", &other)),
    }
}

/// Reads a 16-bit colour image: width, height and the stored values.
pub(super) fn read_rgb16(path: &Path) -> Result<(u32, u32, Vec<u16>)> {
    match decode(path, Orientation::Stored)? {
        DynamicImage::ImageRgb16(rgb) => Ok((rgb.width(), rgb.height(), rgb.into_raw())),
        other => Err(not_of_16_bits(path, "a colour", &other)),
    }
}

fn not_of_16_bits(path: &Path, wanted: &str, found: &DynamicImage) -> Error {
    let found = found.color();
    Error::format(path, format!("{wanted} image of 16 bits was expected, this one is {found:?}"))
}

/// Width and height of an array, if an image can have them.
pub(super) fn sides(width: usize, height: usize) -> Option<(u32, u32)> {
    let side = |side: usize| u32::try_from(side).ok().filter(|side| range::SIDE.contains(side));
    side(width).zip(side(height))
}

/// Writes a mask of one channel as a PNG of 0 and 255.
pub fn write_mask(path: impl AsRef<Path>, mask: &Image) -> Result<()> {
    let pixels = mask.pixels.iter().map(|&v| if v >= 0.5 { 1.0 } else { 0.0 }).collect();
    write_png(path, &Image { pixels, ..*mask })
}

/// Image files directly in a folder, in natural order (2 before 10); hidden files are left out. A dangling
/// link is listed, so that a missing file is noticed.
pub fn list(folder: &Path) -> Result<Vec<std::path::PathBuf>> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(Error::io(folder))? {
        let path = entry.map_err(Error::io(folder))?.path();
        let hidden = path.file_name().is_some_and(|n| n.to_string_lossy().starts_with('.'));
        if !hidden && has_image_extension(&path) && !path.is_dir() {
            found.push(path);
        }
    }
    // Names that are not UTF-8 may be equal after conversion to text.
    found.sort_by(|a, b| natural(&a.to_string_lossy(), &b.to_string_lossy()).then(a.cmp(b)));
    Ok(found)
}

/// Natural order: runs of digits compare as numbers.
pub fn natural(a: &str, b: &str) -> std::cmp::Ordering {
    let (mut x, mut y) = (a.as_bytes(), b.as_bytes());
    while let (Some(&p), Some(&q)) = (x.first(), y.first()) {
        let order = if p.is_ascii_digit() && q.is_ascii_digit() {
            let (m, n) = (number(&mut x), number(&mut y));
            m.len().cmp(&n.len()).then_with(|| m.cmp(n))
        } else {
            (x, y) = (&x[1..], &y[1..]);
            p.cmp(&q)
        };
        if order.is_ne() {
            return order;
        }
    }
    // Names that are equal but for leading zeros still need a defined order.
    x.len().cmp(&y.len()).then_with(|| a.cmp(b))
}

/// Removes the run of digits from the front and returns it without leading zeros.
fn number<'a>(text: &mut &'a [u8]) -> &'a [u8] {
    let length = text.iter().position(|b| !b.is_ascii_digit()).unwrap_or(text.len());
    let (digits, rest) = text.split_at(length);
    *text = rest;
    &digits[digits.iter().position(|&d| d != b'0').unwrap_or(length)..]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn large_pictures_are_read_a_few_at_a_time() {
        assert!(at_a_time((0, 0)) >= 1 && at_a_time((640, 360)) >= 1);
        if available_memory().is_some() {
            assert_eq!(at_a_time((u32::MAX, u32::MAX)), 1);
        }
        assert!(large_note((6000, 4000)).is_none());
        let note = large_note((12_000, 12_000)).unwrap();
        assert!(note.contains("12000×12000 take 2197.3 MiB"), "{note}");
    }
}
