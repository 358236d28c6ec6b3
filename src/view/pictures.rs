//! The input images, shown beside the scene.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::painter::pack;
use super::protocol::Format;
use crate::Result;
use crate::data::Resize;
use crate::data::images::{Orientation, decode_rgb, resize};
use crate::data::video::{self, GoOn};
use crate::io::check_memory;
use crate::types::Image;

/// Maximum side of a displayed image, pixels.
const LONGEST: u32 = 1280;
/// The same of images that are all encoded beforehand during other work.
const LONGEST_BEFOREHAND: u32 = 640;
/// JPEG quality.
const QUALITY: u8 = 90;
/// Upper bound in practice of the size of such a JPEG, bytes per pixel.
const JPEG_BYTES: f64 = 0.6;

/// The input images in the order of their times; the page requests them by index.
///
/// If there are as many as the scene has cameras, each belongs to one of them; otherwise their times are
/// evenly spaced from 0 to 1.
#[derive(Clone, Debug)]
pub struct Pictures(Kept);

#[derive(Clone, Debug)]
enum Kept {
    /// Image files, decoded on request.
    Files(Vec<PathBuf>),
    /// Encoded images.
    Packed(Arc<Vec<Vec<u8>>>),
}

impl Default for Pictures {
    fn default() -> Pictures {
        Pictures::files(Vec::new())
    }
}

impl Pictures {
    /// Makes a list of image files.
    pub fn files(files: Vec<PathBuf>) -> Pictures {
        Pictures(Kept::Files(files))
    }

    /// Frames of a video with the given ascending numbers. All are decoded now by `ffmpeg` and kept in
    /// encoded form, because seeking to one frame takes long. `go_on` is called at each frame; its error
    /// ends the work.
    ///
    /// # Errors
    /// Those of [`video::extent`] and [`video::frames`]; [`Error::OutOfMemory`](crate::Error::OutOfMemory)
    /// where they do not fit into host memory.
    pub fn of_video(path: &Path, numbers: &[usize], go_on: GoOn) -> Result<Pictures> {
        let (width, height) = video::extent(path)?.size;
        let (width, height) = Resize::Longest(LONGEST).target(width, height);
        let bytes = f64::from(width) * f64::from(height) * JPEG_BYTES;
        let what = format!("{} images of {width}×{height} beside the scene", numbers.len());
        check_memory((numbers.len() as f64 * bytes) as u64, &what)?;
        let mut packed = Vec::with_capacity(numbers.len());
        video::frames(path, numbers, &mut |_, picture| {
            packed.push(jpeg(&picture, LONGEST)?);
            go_on()
        })?;
        Ok(Pictures(Kept::Packed(Arc::new(packed))))
    }

    /// Images that are in memory, encoded now with at most 640 pixels per side.
    ///
    /// # Errors
    /// [`Error::Failed`](crate::Error::Failed): an image cannot be encoded.
    pub fn of_images<'a>(images: impl IntoIterator<Item = &'a Image>) -> Result<Pictures> {
        let packed = images.into_iter().map(|image| jpeg(image, LONGEST_BEFOREHAND));
        Ok(Pictures(Kept::Packed(Arc::new(packed.collect::<Result<_>>()?))))
    }

    /// Number of images.
    pub fn len(&self) -> usize {
        match &self.0 {
            Kept::Files(files) => files.len(),
            Kept::Packed(pictures) => pictures.len(),
        }
    }

    /// Whether there are no images.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// An image as a JPEG of at most 1280 pixels per side; `None` beyond the last.
    ///
    /// # Errors
    /// Those of [`decode_rgb`].
    pub fn jpeg(&self, index: usize) -> Result<Option<Vec<u8>>> {
        match &self.0 {
            Kept::Packed(pictures) => Ok(pictures.get(index).cloned()),
            Kept::Files(files) => {
                let Some(path) = files.get(index) else { return Ok(None) };
                let picture = decode_rgb(path, [0.0; 3], Orientation::Upright)?;
                jpeg(&picture, LONGEST).map(Some)
            }
        }
    }
}

/// Encodes an image as it is sent, with at most `longest` pixels per side.
fn jpeg(picture: &Image, longest: u32) -> Result<Vec<u8>> {
    let (width, height) = Resize::Longest(longest).target(picture.width, picture.height);
    let mut bytes = Vec::new();
    pack(&resize(picture, width, height), Format::Jpeg, QUALITY, &mut bytes)?;
    Ok(bytes)
}
