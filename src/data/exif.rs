//! Focal length from an image's EXIF data.

use std::path::Path;

use exif::{Exif, In, Reader, Tag, Value};

/// Diagonal of a 36 mm × 24 mm frame, the reference of the "35 mm equivalent" (CIPA DCG-001), mm.
const FULL_FRAME_DIAGONAL_MM: f64 = 43.266_615_305_567_87;

/// Focal length in pixels of an image of `width` × `height`, from its EXIF data: from the 35 mm equivalent,
/// or from the true focal length and the sensor's pixel density. `None` where both are absent or
/// implausible (a missing hint is not an error).
pub fn focal(path: &Path, width: u32, height: u32) -> Option<f64> {
    let file = crate::io::open(path).ok()?;
    let exif = Reader::new().read_from_container(&mut std::io::BufReader::new(file)).ok()?;
    from_exif(&exif, f64::from(width), f64::from(height))
}

fn from_exif(exif: &Exif, width: f64, height: f64) -> Option<f64> {
    let plausible = |focal: f64| {
        // A field of view between 170° and 1°; other values are defaults or mistakes.
        let half_side = width.max(height) / 2.0;
        (focal.is_finite() && (half_side / 12.0..half_side * 115.0).contains(&focal))
            .then_some(focal)
    };
    if let Some(mm) = number(exif, Tag::FocalLengthIn35mmFilm).filter(|&mm| mm > 0.0) {
        let diagonal = width.hypot(height);
        return plausible(mm / FULL_FRAME_DIAGONAL_MM * diagonal);
    }
    let mm = number(exif, Tag::FocalLength)?;
    let unit_mm = match number(exif, Tag::FocalPlaneResolutionUnit).unwrap_or(2.0) as u32 {
        2 => 25.4,
        3 => 10.0,
        4 => 1.0,
        5 => 0.001,
        _ => return None,
    };
    let per_mm = number(exif, Tag::FocalPlaneXResolution)? / unit_mm;
    // The density refers to the image as taken, which may have been downscaled since.
    let taken = number(exif, Tag::PixelXDimension).filter(|&w| w > 0.0).unwrap_or(width);
    let shrunk = width.max(height) / taken.max(number(exif, Tag::PixelYDimension).unwrap_or(0.0));
    plausible(mm * per_mm * shrunk.min(1.0))
}

fn number(exif: &Exif, tag: Tag) -> Option<f64> {
    let field = exif.get_field(tag, In::PRIMARY)?;
    let value = match &field.value {
        Value::Rational(values) => values.first()?.to_f64(),
        other => f64::from(other.get_uint(0)?),
    };
    value.is_finite().then_some(value)
}
