//! Reader of SOG, the web format of PlayCanvas: images with one pixel per Gaussian and a
//! `meta.json`, in a zip archive (`.sog`) or in a folder, which is opened by its `meta.json`.
//!
//! The format is version 2. Positions: sign(v) ln(1 + |v|) between bounds, 16 bits per coordinate
//! in two images. Rotations: the three smaller components of (w, x, y, z) in 8 bits between ±1/√2,
//! and 252 + the index of the largest. Log scales, colours (the constant harmonic) and further
//! harmonics: byte indices into a codebook of 256 values. Opacity: a byte. Further harmonics: a
//! palette with 64 entries per row, each with one pixel per coefficient, and a 16-bit label per
//! Gaussian. The axes are those of a PLY.
//!
//! Source: developer.playcanvas.com, "The SOG Format".

use std::io::{Cursor, Read};
use std::path::{Path, PathBuf};

use image::{DynamicImage, ImageDecoder, ImageReader, RgbaImage};
use serde_json::Value;
use zip::ZipArchive;

use super::{packing, without_bad};
use crate::error::excerpt;
use crate::types::{Gaussians, sh_coefficients};
use crate::{Error, Result, io};

/// Number of values in a codebook.
const BOOK: usize = 256;
/// Palette entries per row.
const ROW: usize = 64;
/// Alpha value of the rotation image for index 0 of a quaternion's largest component.
const PLACES: u8 = 252;
/// Largest `meta.json` that is read, bytes; two codebooks take about 10,000.
const MOST_META: u64 = 4 << 20;

/// Whether the bytes are a zip archive, as a `.sog` is.
pub(super) fn is_archive(bytes: &[u8]) -> bool {
    bytes.starts_with(b"PK\x03\x04")
}

/// Reads the Gaussians of a `.sog`, or of the folder that contains a `meta.json`; the second value
/// is the number of those that `drop_bad` left out.
///
/// # Errors
/// The file is not a SOG, is of another version, lacks an image, is damaged, or holds values out of
/// range ([`Gaussians::check`]) and `drop_bad` is false.
pub fn read(path: impl AsRef<Path>, drop_bad: bool) -> Result<(Gaussians, usize)> {
    let path = path.as_ref();
    parse(path, &io::read(path)?, drop_bad)
}

/// [`read`] from the bytes of the archive or of `meta.json`.
pub(super) fn parse(path: &Path, bytes: &[u8], drop_bad: bool) -> Result<(Gaussians, usize)> {
    let mut files = match is_archive(bytes) {
        true => {
            let archive = ZipArchive::new(Cursor::new(bytes));
            let bad = |e| Error::format(path, format!("is no zip archive that can be read: {e}"));
            Files::Archive { path, archive: archive.map_err(bad)?, size: bytes.len() }
        }
        false => Files::Folder { path, folder: path.parent().unwrap_or(Path::new("")).into() },
    };
    let meta = match &mut files {
        Files::Folder { .. } => bytes.to_vec(),
        archive => archive.file("meta.json", MOST_META)?,
    };
    let json = serde_json::from_slice(&meta).map_err(|e| {
        Error::format(path, format!("its meta.json is not JSON: {}", excerpt(&e.to_string())))
    })?;
    let mut gaussians = Meta { path, json }.gaussians(&mut files)?;
    let dropped = without_bad(path, &mut gaussians, drop_bad)?;
    Ok((gaussians, dropped))
}

/// The source of the images.
enum Files<'a> {
    Archive { path: &'a Path, archive: ZipArchive<Cursor<&'a [u8]>>, size: usize },
    Folder { path: &'a Path, folder: PathBuf },
}

impl Files<'_> {
    fn path(&self) -> &Path {
        match self {
            Files::Archive { path, .. } | Files::Folder { path, .. } => path,
        }
    }

    /// Reads a file of at most `most` bytes.
    fn file(&mut self, name: &str, most: u64) -> Result<Vec<u8>> {
        let bad = |path: &Path, what: String| Error::format(path, what);
        // Only files inside the folder are read.
        if name.is_empty() || name.contains(['/', '\\', ':']) || name == ".." {
            return Err(bad(self.path(), format!("names {} as a file", excerpt(name))));
        }
        match self {
            Files::Folder { folder, .. } => io::read(&folder.join(name)),
            Files::Archive { path, archive, size } => {
                let entry = archive.by_name(name).map_err(|e| {
                    bad(path, format!("its file {} cannot be read: {e}", excerpt(name)))
                })?;
                io::check_unpacked(path, entry.size(), *size)?;
                let mut bytes = Vec::new();
                let read = entry.take(most + 1).read_to_end(&mut bytes);
                read.map_err(|e| packing::unpacking(path, "one of its files", &e))?;
                match bytes.len() as u64 > most {
                    false => Ok(bytes),
                    true => Err(bad(path, format!("its file {} is too large", excerpt(name)))),
                }
            }
        }
    }

    /// Reads an image, which must have at least `pixels` pixels.
    fn picture(&mut self, name: &str, pixels: usize) -> Result<RgbaImage> {
        let bytes = self.file(name, u64::from(u32::MAX))?;
        let path = self.path();
        let bad = |e: image::ImageError| {
            let what = excerpt(&e.to_string());
            Error::format(path, format!("its image {} cannot be read: {what}", excerpt(name)))
        };
        let reader = ImageReader::new(Cursor::new(&bytes)).with_guessed_format();
        let decoder = reader.map_err(Error::io(path))?.into_decoder().map_err(bad)?;
        let (width, height) = decoder.dimensions();
        let size = u64::from(width) * u64::from(height);
        packing::check_room(path, 4 * size, bytes.len())?;
        if size < pixels as u64 {
            return Err(Error::format(
                path,
                format!("its image {} has {size} pixels, fewer than {pixels}", excerpt(name)),
            ));
        }
        Ok(DynamicImage::from_decoder(decoder).map_err(bad)?.into_rgba8())
    }
}

/// `meta.json`.
struct Meta<'a> {
    path: &'a Path,
    json: Value,
}

impl Meta<'_> {
    fn bad(&self, what: &str) -> Error {
        Error::format(self.path, format!("its meta.json has no valid {what}"))
    }

    /// The file name with this index in a part of `meta.json`.
    fn name(&self, part: &str, index: usize) -> Result<&str> {
        self.json[part]["files"][index].as_str().ok_or_else(|| self.bad(&format!("{part}.files")))
    }

    fn numbers<const N: usize>(&self, part: &str, key: &str) -> Result<[f32; N]> {
        let values = self.json[part][key].as_array().filter(|list| list.len() == N);
        let of = |v: &Value| v.as_f64().map(|v| v as f32);
        let values: Option<Vec<f32>> = values.and_then(|list| list.iter().map(of).collect());
        let values = values.and_then(|values| <[f32; N]>::try_from(values).ok());
        values.ok_or_else(|| self.bad(&format!("{part}.{key}")))
    }

    fn whole(&self, value: &Value, name: &str, most: u64) -> Result<usize> {
        let value = value.as_u64().filter(|v| *v <= most);
        value.map(|v| v as usize).ok_or_else(|| self.bad(name))
    }

    fn gaussians(&self, files: &mut Files<'_>) -> Result<Gaussians> {
        if self.json["version"] != 2 {
            let version = &self.json["version"];
            let what = match version.is_null() && self.json["means"]["shape"].is_array() {
                true => "is SOG of version 1; version 2 is read".to_owned(),
                false => format!("is SOG of version {}; 2 is read", excerpt(&version.to_string())),
            };
            return Err(Error::format(self.path, what));
        }
        let count = self.whole(&self.json["count"], "count", u64::from(u32::MAX))?;
        let mut picture = |part: &str, index: usize| {
            let name = self.name(part, index)?;
            files.picture(name, count)
        };
        let (low, high) = (picture("means", 0)?, picture("means", 1)?);
        let (quats, scales, sh0) =
            (picture("quats", 0)?, picture("scales", 0)?, picture("sh0", 0)?);
        let (least, most) =
            (self.numbers::<3>("means", "mins")?, self.numbers::<3>("means", "maxs")?);
        let scale_book = self.numbers::<BOOK>("scales", "codebook")?;
        let colour_book = self.numbers::<BOOK>("sh0", "codebook")?;
        let further = match self.json["shN"].is_null() {
            true => Further::default(),
            false => self.further(files, count)?,
        };
        let (degree, bands) = (further.degree, sh_coefficients(further.degree));
        let mut out = Gaussians { sh_degree: degree, ..Gaussians::default() };
        let mut pixels = [&low, &high, &quats, &scales, &sh0].map(|image| image.pixels());
        for i in 0..count {
            // Each has at least `count` pixels.
            let [low, high, quat, scale, colour] =
                pixels.each_mut().map(|pixels| pixels.next().map_or([0; 4], |pixel| pixel.0));
            out.positions.push(std::array::from_fn(|c| {
                let share = f32::from(u16::from_le_bytes([low[c], high[c]])) / 65535.0;
                let v: f32 = least[c] + share * (most[c] - least[c]);
                v.signum() * v.abs().exp_m1()
            }));
            out.rotations.push(self.rotation(quat)?);
            out.log_scales.push(std::array::from_fn(|c| scale_book[usize::from(scale[c])]));
            out.opacity_logits.push(packing::logit(colour[3]));
            out.sh.push(std::array::from_fn(|c| colour_book[usize::from(colour[c])]));
            out.sh.extend((0..bands - 1).map(|k| further.harmonic(i, k)));
        }
        Ok(out)
    }

    fn rotation(&self, pixel: [u8; 4]) -> Result<[f32; 4]> {
        let largest = pixel[3].checked_sub(PLACES).map(usize::from);
        let largest = largest.ok_or_else(|| {
            let what = format!("has a rotation marked {}, 252 to 255 are valid", pixel[3]);
            Error::format(self.path, what)
        })?;
        let mut parts =
            pixel.iter().map(|&b| (f32::from(b) / 255.0 - 0.5) * std::f32::consts::SQRT_2);
        let mut q: [f32; 4] =
            std::array::from_fn(|c| if c == largest { 0.0 } else { parts.next().unwrap_or(0.0) });
        q[largest] = packing::rest(q);
        Ok(q)
    }

    fn further(&self, files: &mut Files<'_>, count: usize) -> Result<Further> {
        let part = &self.json["shN"];
        let degree = self.whole(&part["bands"], "shN.bands", 3)? as u32;
        let entries = self.whole(&part["count"], "shN.count", 65536)?;
        let book = self.numbers::<BOOK>("shN", "codebook")?;
        let coefficients = sh_coefficients(degree) - 1;
        let rows = entries.div_ceil(ROW);
        let palette = files.picture(self.name("shN", 0)?, rows * ROW * coefficients)?;
        if palette.width() as usize != ROW * coefficients {
            return Err(self.bad("palette of harmonics: its width is another"));
        }
        let labels = files.picture(self.name("shN", 1)?, count)?;
        let labels: Vec<u16> = (labels.pixels().take(count))
            .map(|pixel| u16::from_le_bytes([pixel[0], pixel[1]]))
            .collect();
        if labels.iter().any(|&label| usize::from(label) >= entries) {
            return Err(self.bad("labels of harmonics: one lies beyond the palette"));
        }
        Ok(Further { degree, palette, labels, book: book.to_vec() })
    }
}

/// The spherical harmonics above the constant.
#[derive(Default)]
struct Further {
    degree: u32,
    palette: RgbaImage,
    labels: Vec<u16>,
    book: Vec<f32>,
}

impl Further {
    fn harmonic(&self, gaussian: usize, index: usize) -> [f32; 3] {
        let (label, coefficients) =
            (usize::from(self.labels[gaussian]), sh_coefficients(self.degree) - 1);
        let (x, y) = (label % ROW * coefficients + index, label / ROW);
        let pixel = self.palette.get_pixel(x as u32, y as u32);
        [0, 1, 2].map(|c| self.book[usize::from(pixel[c])])
    }
}
