//! Readers and writers of what comes from outside: datasets with known cameras
//! ([`Dataset`]: COLMAP, nerfstudio / instant-ngp `transforms.json`, D-NeRF), clips without
//! ([`Clip`]: a video or a folder of images), and the small files that go with them.
//!
//! Cameras are the crate's own everywhere (OpenCV axes, `view_from_world`, pinhole); each reader
//! converts on its way in.

pub mod cam;
pub mod clip;
pub mod colmap;
pub mod depth;
pub mod distortion;
pub mod exif;
pub mod exr;
pub mod flo;
pub mod flow;
pub mod images;
pub mod intrinsics;
pub mod lens;
pub mod monst3r;
pub mod npy;
pub mod points;
mod shots;
pub mod synth;
pub mod tracks;
pub mod trajectory;
pub mod transforms;
pub mod video;

pub use clip::{Clip, ClipFrame, ClipOptions};
pub use distortion::Distortion;
pub use images::{Resize, read_mask, write_mask, write_png};
pub use lens::Lens;
pub use points::Point;
pub use shots::{Shot, ShotChoice};

use std::path::{Path, PathBuf};

use rayon::prelude::*;

use crate::error::excerpt;
use crate::types::{Camera, Image};
use crate::{Error, Result, io};

/// One picture of a dataset, not decoded yet.
#[derive(Clone, Debug)]
pub struct Frame {
    /// Its name in the dataset: unique, and what messages call it.
    pub name: String,
    /// Where the picture lies.
    pub path: PathBuf,
    /// In [0, 1].
    pub time: f64,
    /// The camera at the picture's own size; a pinhole once the distortion is removed.
    pub camera: Camera,
    /// What [`Frame::load`] removes.
    pub distortion: Distortion,
}

/// A picture with its camera, ready to train on.
#[derive(Clone, Debug)]
pub struct View {
    /// As [`Frame::name`].
    pub name: String,
    /// In [0, 1].
    pub time: f64,
    /// A pinhole; its size is the picture's.
    pub camera: Camera,
    /// RGB in [0, 1].
    pub image: Image,
    /// One channel, 1 where the picture is real and 0 where undistortion had nothing to put; `None`
    /// where all of it is real.
    pub valid: Option<Image>,
}

impl Frame {
    /// Decodes the picture, lays it over the background where it has an alpha channel, removes the
    /// distortion, then resizes; the camera follows.
    pub fn load(&self, background: [f32; 3], size: Resize) -> Result<View> {
        let mut image = images::decode_rgb(&self.path, background, images::Orientation::Stored)?;
        let mut camera = self.camera;
        let k = &camera.intrinsics;
        if (image.width, image.height) != (k.width, k.height) {
            let what = format!(
                "is {}×{}, and was {}×{} when the dataset was opened",
                image.width, image.height, k.width, k.height
            );
            return Err(Error::format(&self.path, what));
        }
        let mut valid = None;
        if !self.distortion.is_none() {
            let lens = Lens { intrinsics: camera.intrinsics, distortion: self.distortion };
            (image, valid) = lens.undistort(&image, &camera.intrinsics);
        }
        let (width, height) = size.target(image.width, image.height);
        if (width, height) != (image.width, image.height) {
            image = images::resize(&image, width, height);
            // A shrunken pixel is real only where all that it averages is.
            valid = valid.map(|v| {
                let mut v = images::resize(&v, width, height);
                v.pixels.iter_mut().for_each(|p| *p = if *p > 0.999 { 1.0 } else { 0.0 });
                v
            });
            camera.intrinsics = camera.intrinsics.resized(width, height);
        }
        Ok(View { name: self.name.clone(), time: self.time, camera, image, valid })
    }
}

/// Pictures with known cameras.
#[derive(Clone, Debug, Default)]
pub struct Dataset {
    /// All frames, training and test: of a split set the training frames first, each part in the
    /// order of its file or of its names.
    pub frames: Vec<Frame>,
    /// The coloured points that came along; empty where there are none.
    pub points: Vec<Point>,
    /// What the set's own split holds out, as indices into `frames`; `None` where it has no split.
    pub test: Option<Vec<usize>>,
    /// Whether the set gave times; if not, they run from 0 to 1 in the order of the frames.
    pub timed: bool,
    /// What lies behind everything: white where the pictures have an alpha channel, as D-NeRF and
    /// NeRF-synthetic have it, else black.
    pub background: [f32; 3],
    /// Whether the pictures have an alpha channel, as far as the first of them tells.
    pub alpha: bool,
    /// Lines to show: what was skipped or assumed.
    pub notes: Vec<String>,
    /// The files that were read beside the pictures.
    pub sources: Vec<PathBuf>,
}

impl Dataset {
    /// Opens a dataset: a folder, or a `transforms*.json` itself. Which kind it is shows in the files:
    /// `transforms.json`, or `transforms_train.json` (D-NeRF and its kin), or a COLMAP model
    /// (`cameras.bin` or `.txt`) in `sparse/0`, `sparse`, `colmap/sparse/0` or the folder itself.
    /// Only the pictures' headers are read here.
    ///
    /// # Errors
    /// The folder is missing or of no known kind, a file is damaged, or no picture exists.
    pub fn open(path: impl AsRef<Path>) -> Result<Dataset> {
        let path = path.as_ref();
        let found = std::fs::metadata(path).map_err(Error::io(path))?;
        let mut set = if !found.is_dir() {
            if path.extension().is_none_or(|e| e != "json") {
                return Err(Error::format(
                    path,
                    "is not a dataset; give its folder or its transforms.json. \
                     A video whose poses are unknown goes to `splat4d reconstruct`",
                ));
            }
            transforms::read(path)?
        } else if path.join("transforms.json").is_file() {
            transforms::read(&path.join("transforms.json"))?
        } else if path.join("transforms_train.json").is_file() {
            transforms::read_split(path)?
        } else if let Some(model) = colmap::find(path) {
            colmap::read(path, &model)?
        } else {
            return Err(Error::format(
                path,
                "holds no transforms.json, transforms_train.json or COLMAP model \
                 (sparse/0/cameras.bin). Images or a video whose poses are unknown go to \
                 `splat4d reconstruct`",
            ));
        };
        if let Some(first) = set.frames.first()
            && images::has_alpha(&first.path)?
        {
            (set.background, set.alpha) = ([1.0; 3], true);
        }
        set.notes.extend(images::large_note(largest(&set.frames)));
        if !set.timed {
            let last = set.frames.len().saturating_sub(1).max(1) as f64;
            for (i, frame) in set.frames.iter_mut().enumerate() {
                frame.time = i as f64 / last;
            }
        }
        Ok(set)
    }

    /// Which frames to train on and which to hold out, in that order: the set's own split where it
    /// has one, else every `every`-th frame is held out, beginning with the first; 0 holds out none.
    pub fn split(&self, every: usize) -> (Vec<usize>, Vec<usize>) {
        let held = |i: &usize| match &self.test {
            Some(test) => test.contains(i),
            None => every > 0 && i.is_multiple_of(every),
        };
        let (test, train) = (0..self.frames.len()).partition(held);
        (train, test)
    }

    /// Loads frames, decoding on all cores; the order is that of `indices`. That there is memory for
    /// all of them is checked first.
    pub fn load(&self, indices: &[usize], size: Resize) -> Result<Vec<View>> {
        let bytes = |&i: &usize| {
            let frame = &self.frames[i];
            let k = frame.camera.intrinsics;
            let (width, height) = size.target(k.width, k.height);
            // Three floats a pixel, and one that tells where an undistorted picture is real.
            let floats = if frame.distortion.is_none() { 3 } else { 4 };
            4 * floats * u64::from(width) * u64::from(height)
        };
        let bytes = indices.iter().map(bytes).fold(0, u64::saturating_add);
        io::check_memory(bytes, &format!("loading {} pictures", indices.len()))?;
        let at_a_time = images::at_a_time(largest(indices.iter().map(|&i| &self.frames[i])));
        let load = |&i: &usize| self.frames[i].load(self.background, size);
        let mut views = Vec::with_capacity(indices.len());
        for indices in indices.chunks(at_a_time) {
            let loaded: Result<Vec<View>> = indices.par_iter().map(load).collect();
            views.extend(loaded?);
        }
        Ok(views)
    }
}

/// Width and height of the picture with the most pixels; zeros of none.
fn largest<'a>(frames: impl IntoIterator<Item = &'a Frame>) -> (u32, u32) {
    let size = |frame: &Frame| (frame.camera.intrinsics.width, frame.camera.intrinsics.height);
    let sizes = frames.into_iter().map(size);
    sizes.max_by_key(|&(w, h)| u64::from(w) * u64::from(h)).unwrap_or_default()
}

/// Brings a camera to the size that its picture has: sets are often kept at a fraction of the size
/// they were calibrated at.
fn fit_to_image(camera: &mut Camera, path: &Path) -> Result<()> {
    let (width, height) = images::dimensions(path, images::Orientation::Stored)?;
    let k = camera.intrinsics;
    let (sx, sy) = (f64::from(width) / f64::from(k.width), f64::from(height) / f64::from(k.height));
    // Halving an odd side rounds: one pixel is allowed beyond equal proportions.
    let off = (sx / sy - 1.0).abs() - 1.0 / f64::from(width.min(height));
    if off > 0.01 {
        return Err(Error::format(
            path,
            format!(
                "is {width}×{height}, but its camera is of {}×{}: other proportions",
                k.width, k.height
            ),
        ));
    }
    camera.intrinsics = k.resized(width, height);
    Ok(())
}

/// The one line about pictures that a set lists and does not have.
fn missing_note(missing: &[String], listed: usize) -> Option<String> {
    let first = missing.first()?;
    Some(format!(
        "skipped {} of {listed} listed images that do not exist ({} …)",
        missing.len(),
        excerpt(first)
    ))
}
