//! Camera intrinsics as a small JSON file: `{"fx", "fy", "cx", "cy", "width", "height"}`.

use std::path::Path;

use serde_json::{Value, json};

use crate::io;
use crate::types::Intrinsics;
use crate::{Error, Result};

/// Reads intrinsics. nerfstudio's names (`fl_x`, `fl_y`, `w`, `h`) are accepted as well; `focal` sets both
/// focal lengths; a missing principal point is the image centre.
pub fn read(path: impl AsRef<Path>) -> Result<Intrinsics> {
    let path = path.as_ref();
    let value = io::read_json(path)?;
    let number = |keys: &[&str]| match keys.iter().find_map(|key| value.get(key)) {
        None => Ok(None),
        Some(found) => match found.as_f64().filter(|v| v.is_finite()) {
            Some(number) => Ok(Some(number)),
            None => Err(Error::format(path, format!("`{}` is not a number", keys[0]))),
        },
    };
    let positive = |keys: &[&str]| match number(keys)? {
        Some(number) if number > 0.0 => Ok(number),
        Some(number) => {
            Err(Error::format(path, format!("`{}` = {number:?} makes no sense", keys[0])))
        }
        None => Err(Error::format(path, format!("`{}` is missing", keys[0]))),
    };
    let side = |keys: &[&str]| match positive(keys)? {
        side if side >= 1.0 && side < f64::from(u32::MAX) => Ok(side as u32),
        side => Err(Error::format(path, format!("`{}` = {side:?} makes no sense", keys[0]))),
    };
    let fx = positive(&["fx", "fl_x", "focal"])?;
    let fy = match number(&["fy", "fl_y"])? {
        Some(_) => positive(&["fy", "fl_y"])?,
        None => fx,
    };
    let (width, height) = (side(&["width", "w"])?, side(&["height", "h"])?);
    let cx = number(&["cx"])?.unwrap_or(f64::from(width) / 2.0);
    let cy = number(&["cy"])?.unwrap_or(f64::from(height) / 2.0);
    let intrinsics = Intrinsics { fx, fy, cx, cy, width, height };
    intrinsics.check().map_err(|what| Error::format(path, what))?;
    Ok(intrinsics)
}

/// Names of the non-zero distortion coefficients (`k1` …, `p1` …) in such a file. [`read`] ignores them.
pub fn distorted_by(path: impl AsRef<Path>) -> Result<Vec<String>> {
    let value = io::read_json(path.as_ref())?;
    let bends = |key: &&&str| value.get(**key).and_then(Value::as_f64).is_some_and(|v| v != 0.0);
    Ok(["k1", "k2", "k3", "k4", "p1", "p2"].iter().filter(bends).map(|k| k.to_string()).collect())
}

/// Writes intrinsics by rename.
pub fn write(path: impl AsRef<Path>, intrinsics: &Intrinsics) -> Result<()> {
    io::write_json(path, &to_json(intrinsics))
}

/// The JSON object that [`write()`] writes.
pub fn to_json(k: &Intrinsics) -> Value {
    json!({
        "fx": k.fx, "fy": k.fy, "cx": k.cx, "cy": k.cy, "width": k.width, "height": k.height,
    })
}
