//! Depth maps: EXR, `.npy`, `.npz`, 16-bit PNG, Sintel's `.dpt`.

use std::path::Path;

use super::npy::{self, Array};
use super::{dpt, exr, images};
use crate::types::{Image, range};
use crate::{Error, Result};

/// Supported file extensions.
pub const EXTENSIONS: [&str; 5] = ["exr", "npy", "npz", "png", "dpt"];

/// Reads a depth map (z), one channel. `.npy` and `.npz` files hold one array, height × width; a 16-bit
/// grey PNG holds integers, with `unit` of them per unit of length (1000: millimetres for metres). Values
/// that are not depths (NaN, not above 0, nearer than [`range::DEPTH`]) are returned as 0, those farther as
/// infinite.
///
/// # Errors
/// [`Error::Io`]; [`Error::Format`] for a file that is not a depth map.
pub fn read(path: impl AsRef<Path>, unit: f64) -> Result<Image> {
    let mut depth = read_stored(path, unit)?;
    depth.pixels.iter_mut().for_each(|z| *z = clean(*z));
    Ok(depth)
}

/// Reads a map like [`read`] with its stored values unchanged; a network's values may be inverse depth, or
/// negative.
///
/// # Errors
/// Those of [`read`].
pub fn read_stored(path: impl AsRef<Path>, unit: f64) -> Result<Image> {
    let path = path.as_ref();
    let extension = path.extension().unwrap_or_default().to_ascii_lowercase();
    match extension.to_str() {
        Some("npy") => of_array(path, npy::read(path)?),
        Some("npz") => of_array(path, npy::read_only(path)?),
        Some("dpt") => dpt::read(path),
        Some("png") => {
            let mut depth = images::read_grey16(path)?;
            depth.pixels.iter_mut().for_each(|z| *z = (f64::from(*z) / unit) as f32);
            Ok(depth)
        }
        _ => exr::read_stored_depth(path),
    }
}

/// Converts a stored depth to the crate's convention, see [`read`].
pub(super) fn clean(z: f32) -> f32 {
    match z {
        z if range::DEPTH.contains(&z) => z,
        z if z > *range::DEPTH.end() => f32::INFINITY,
        _ => 0.0,
    }
}

/// The channel of an array of height × width, with possible further axes of length 1.
fn of_array(path: &Path, Array { shape, values }: Array) -> Result<Image> {
    let sides: Vec<usize> = match shape[..] {
        [height, width] => vec![height, width],
        _ => shape.iter().copied().filter(|side| *side != 1).collect(),
    };
    let bad = || {
        let what = format!("holds an array of shape {shape:?}, and not of height × width");
        Error::format(path, what)
    };
    let [height, width] = sides[..] else { return Err(bad()) };
    let (width, height) = images::sides(width, height).ok_or_else(bad)?;
    let pixels = values.into_iter().map(|z| z as f32).collect();
    Ok(Image { width, height, channels: 1, pixels })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A `.npy` of 32-bit floats.
    fn npy(shape: &str, values: &[f32]) -> Vec<u8> {
        let header = format!("{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}");
        let header = format!("{header:<117}\n");
        let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
        bytes.extend((header.len() as u16).to_le_bytes());
        bytes.extend(header.as_bytes());
        bytes.extend(values.iter().flat_map(|v| v.to_le_bytes()));
        bytes
    }

    #[test]
    fn depth_of_each_format() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        let values = [1.5, f32::NAN, 0.25, 2.0, -1.0, f32::INFINITY];
        let wanted = [1.5, 0.0, 0.25, 2.0, 0.0, f32::INFINITY];
        for (name, shape) in [("a.npy", "(2, 3)"), ("b.npy", "(1, 2, 3)"), ("c.npy", "(2, 3, 1)")] {
            std::fs::write(at(name), npy(shape, &values)).unwrap();
            let depth = read(at(name), 1.0).unwrap();
            assert_eq!((depth.width, depth.height, depth.pixels), (3, 2, wanted.to_vec()));
            let stored = read_stored(at(name), 1.0).unwrap().pixels;
            assert!(stored[1].is_nan());
            assert_eq!((stored[0], &stored[2..]), (1.5, &values[2..]));
        }
        let grey = image::ImageBuffer::<image::Luma<u16>, _>::from_raw(2, 1, vec![1500u16, 0]);
        grey.unwrap().save(at("d.png")).unwrap();
        assert_eq!(read(at("d.png"), 1000.0).unwrap().pixels, [1.5, 0.0]);
        let exr = Image { width: 2, height: 1, channels: 1, pixels: vec![3.0, 0.5] };
        exr::write_depth(at("e.exr"), &exr).unwrap();
        assert_eq!(read(at("e.exr"), 1000.0).unwrap(), exr);
        std::fs::write(at("f.npy"), npy("(6,)", &values)).unwrap();
        image::GrayImage::new(2, 2).save(at("g.png")).unwrap();
        std::fs::write(at("h.npz"), b"PK").unwrap();
        for (name, part) in [("f.npy", "height × width"), ("g.png", "16"), ("h.npz", ".npz")] {
            let said = read(at(name), 1.0).unwrap_err().to_string();
            assert!(said.contains(name) && said.contains(part), "{said}");
        }
    }
}
