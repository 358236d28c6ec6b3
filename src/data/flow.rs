//! Optical flow files: `.flo`, `.npy`, `.npz`, KITTI's 16-bit PNG.

use std::path::Path;

use super::npy::{self, Array};
use super::{flo, images};
use crate::types::{Image, range};
use crate::{Error, Result};

/// Supported file extensions.
pub const EXTENSIONS: [&str; 4] = ["flo", "npy", "npz", "png"];

/// Reads a flow field as an image of two channels (u, v), pixels; unknown vectors are returned as NaN, as
/// by [`flo::read`]. `.npy` and `.npz` hold one array, height × width × 2 or 2 × height × width. KITTI's
/// PNG holds 64 u + 2¹⁵, 64 v + 2¹⁵ and a validity flag, 16 bits each.
///
/// # Errors
/// [`Error::Io`]; [`Error::Format`] for a file that is not a flow field.
pub fn read(path: impl AsRef<Path>) -> Result<Image> {
    let path = path.as_ref();
    let extension = path.extension().unwrap_or_default().to_ascii_lowercase();
    let mut flow = match extension.to_str() {
        Some("npy") => of_array(path, npy::read(path)?)?,
        Some("npz") => of_array(path, npy::read_only(path)?)?,
        Some("png") => of_png(path)?,
        _ => return flo::read(path),
    };
    flow.pixels.chunks_exact_mut(2).for_each(clean);
    Ok(flow)
}

/// Sets an unknown vector to NaN.
pub(super) fn clean(vector: &mut [f32]) {
    if !vector.iter().all(|v| v.abs() <= range::FLOW) {
        vector.fill(f32::NAN);
    }
}

fn of_png(path: &Path) -> Result<Image> {
    let (width, height, values) = images::read_rgb16(path)?;
    let vector = |rgb: &[u16]| {
        let part = |value: u16| (f32::from(value) - 32_768.0) / 64.0;
        if rgb[2] == 0 { [f32::NAN; 2] } else { [part(rgb[0]), part(rgb[1])] }
    };
    let pixels = values.chunks_exact(3).flat_map(vector).collect();
    Ok(Image { width, height, channels: 2, pixels })
}

fn of_array(path: &Path, Array { shape, values }: Array) -> Result<Image> {
    let bad = || {
        let what = format!("holds an array of shape {shape:?}, and not of height × width × 2");
        Error::format(path, what)
    };
    let (height, width, planes) = match shape[..] {
        [height, width, 2] => (height, width, false),
        [2, height, width] => (height, width, true),
        _ => return Err(bad()),
    };
    let size = height * width;
    let (width, height) = images::sides(width, height).ok_or_else(bad)?;
    let pixels = match planes {
        false => values.into_iter().map(|v| v as f32).collect(),
        true => (0..size).flat_map(|i| [values[i] as f32, values[size + i] as f32]).collect(),
    };
    Ok(Image { width, height, channels: 2, pixels })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn flow_of_kitti_and_of_arrays() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.png");
        // (1.5, -2) and one unknown vector.
        let rgb = vec![32_864u16, 32_640, 1, 32_768, 32_768, 0];
        let png = image::ImageBuffer::<image::Rgb<u16>, _>::from_raw(2, 1, rgb).unwrap();
        png.save(&path).unwrap();
        let flow = read(&path).unwrap();
        assert_eq!((flow.width, flow.height, flow.channels), (2, 1, 2));
        assert_eq!(flow.pixels[..2], [1.5, -2.0]);
        assert!(flow.pixels[2..].iter().all(|v| v.is_nan()));
        image::RgbImage::new(2, 2).save(&path).unwrap();
        assert!(read(&path).unwrap_err().to_string().contains("16 bits"));
        let of = |shape: &[usize], values: &[f64]| {
            of_array(&path, Array { shape: shape.to_vec(), values: values.to_vec() })
        };
        let rows = of(&[2, 1, 2], &[1.0, 2.0, 3.0, 4.0]).unwrap();
        assert_eq!((rows.width, rows.height, &rows.pixels[..]), (1, 2, &[1.0, 2.0, 3.0, 4.0][..]));
        let planes = of(&[2, 1, 3], &[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]).unwrap();
        assert_eq!((planes.width, planes.height), (3, 1));
        assert_eq!(planes.pixels, [1.0, 4.0, 2.0, 5.0, 3.0, 6.0]);
        for shape in [&[4][..], &[1, 4], &[0, 1, 2]] {
            assert!(of(shape, &[0.0; 4]).is_err());
        }
    }
}
