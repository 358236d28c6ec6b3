//! Optical flow in Middlebury's `.flo` format: the float 202021.25, width and height as `i32`, then u and v
//! interleaved, row by row, all little-endian.

use std::io::Write;
use std::path::Path;

use super::flow::clean;
use crate::io::{self, Bytes};
use crate::types::{Image, range};
use crate::{Error, Result};

const TAG: f32 = 202_021.25;

/// Reads a flow field as an image of two channels (u, v), pixels. Vectors beyond [`range::FLOW`], which
/// mark unknown values in this format, and those that are not finite are returned as NaN.
pub fn read(path: impl AsRef<Path>) -> Result<Image> {
    let mut flow = tagged(path.as_ref(), ".flo", 2)?;
    flow.pixels.chunks_exact_mut(2).for_each(clean);
    Ok(flow)
}

/// Reads the common structure of Sintel's flow and depth files: tag, size, floats per pixel. `kind` is the
/// file extension.
pub(super) fn tagged(path: &Path, kind: &str, channels: u32) -> Result<Image> {
    let bytes = io::read(path)?;
    let mut from = Bytes::new(path, &bytes);
    if from.f32("the tag")? != TAG {
        return Err(Error::format(path, format!("is not a {kind} file (its tag is another)")));
    }
    let (width, height) = (from.i32("the width")?, from.i32("the height")?);
    let side = |side: i32| u32::try_from(side).ok().filter(|side| range::SIDE.contains(side));
    let Some((w, h)) = side(width).zip(side(height)) else {
        return Err(Error::format(path, format!("a size of {width}×{height} makes no sense")));
    };
    let needed = 4 * u64::from(channels) * u64::from(w) * u64::from(h);
    if needed != from.left() as u64 {
        let left = from.left();
        let what = format!("{w}×{h} pixels take {needed} bytes, {left} follow the header");
        return Err(Error::format(path, what));
    }
    let data = from.take(needed as usize, "the pixels")?;
    let value = |b: &[u8]| f32::from_le_bytes([b[0], b[1], b[2], b[3]]);
    let pixels = data.chunks_exact(4).map(value).collect();
    Ok(Image { width: w, height: h, channels, pixels })
}

/// Writes a flow field, an image of two channels, by rename.
pub fn write(path: impl AsRef<Path>, flow: &Image) -> Result<()> {
    if flow.channels != 2 {
        return Err(Error::Shape {
            op: "flo::write",
            arg: "channels",
            expected: "2".into(),
            actual: flow.channels as usize,
        });
    }
    io::write_atomically(path, |sink| {
        sink.write_all(&TAG.to_le_bytes())?;
        sink.write_all(&(flow.width as i32).to_le_bytes())?;
        sink.write_all(&(flow.height as i32).to_le_bytes())?;
        flow.pixels.iter().try_for_each(|v| sink.write_all(&v.to_le_bytes()))
    })
}
