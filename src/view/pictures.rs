//! The input's pictures, beside the scene.

use std::path::PathBuf;

use super::painter::pack;
use super::protocol::Format;
use crate::Result;
use crate::data::Resize;
use crate::data::images::{Orientation, decode_rgb, resize};

/// Longest side of a picture as it is shown.
const LONGEST: u32 = 1280;
/// A JPEG's quality.
const QUALITY: u8 = 90;

/// Image files in the order of their times. The page asks for them by number.
///
/// Where there are as many as the scene has cameras, each belongs to one of them; else their times run
/// evenly from 0 to 1.
#[derive(Clone, Debug, Default)]
pub struct Pictures(pub Vec<PathBuf>);

impl Pictures {
    /// One of them as a JPEG of at most 1280 pixels a side; `None` beyond the last.
    ///
    /// # Errors
    /// As for [`decode_rgb`].
    pub fn jpeg(&self, index: usize) -> Result<Option<Vec<u8>>> {
        let Some(path) = self.0.get(index) else { return Ok(None) };
        let picture = decode_rgb(path, [0.0; 3], Orientation::Upright)?;
        let (width, height) = Resize::Longest(LONGEST).target(picture.width, picture.height);
        let mut bytes = Vec::new();
        pack(&resize(&picture, width, height), Format::Jpeg, QUALITY, &mut bytes)?;
        Ok(Some(bytes))
    }
}
