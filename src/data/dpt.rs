//! Depth maps in Sintel's `.dpt` format: the float 202021.25, width and height as `i32`, then depth (z) row
//! by row as floats, all little-endian.

use std::path::Path;

use super::flo::tagged;
use crate::Result;
use crate::types::Image;

/// Reads a depth map with its stored values: one channel, in world units.
///
/// # Errors
/// [`Error::Io`](crate::Error::Io); [`Error::Format`](crate::Error::Format) for a file of another format.
pub fn read(path: impl AsRef<Path>) -> Result<Image> {
    tagged(path.as_ref(), ".dpt", 1)
}
