//! Readers and writers of external data: datasets with known cameras ([`Dataset`]; [`layout`] recognises
//! their kind), clips without cameras ([`Clip`]: a video or a folder of images), and the small files that
//! accompany them.
//!
//! All readers convert cameras to the crate's convention (OpenCV axes, `view_from_world`, pinhole).

pub mod cam;
pub mod clip;
pub mod colmap;
pub mod davis;
pub mod depth;
pub mod distortion;
pub mod dpt;
pub mod exif;
pub mod exr;
pub mod flo;
pub mod flow;
pub mod images;
pub mod intrinsics;
pub mod layout;
pub mod lens;
pub mod monst3r;
pub mod nerfies;
pub mod npy;
pub mod points;
pub mod poses_bounds;
pub mod shades;
mod shots;
pub mod sintel;
pub mod synth;
pub mod tracks;
pub mod trajectory;
pub mod transforms;
pub mod video;

pub use clip::{Clip, ClipFrame, ClipOptions};
pub use distortion::Distortion;
pub use images::{Resize, read_mask, write_mask, write_png, write_png_16};
pub use lens::Lens;
pub use points::Point;
pub use shots::{Shot, ShotChoice};

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use rayon::prelude::*;

use crate::error::excerpt;
use crate::types::{Camera, Image};
use crate::{Error, Result, io};

/// Meaning of an image's alpha channel, where it has one.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Alpha {
    /// Coverage of the pixel by the subject: the image is composited over the background.
    #[default]
    Cover,
    /// Whether the pixel was measured: [`View::valid`] is 1 where alpha is opaque.
    Valid,
}

/// One image of a dataset, not decoded yet.
#[derive(Clone, Debug)]
pub struct Frame {
    /// Unique name in the dataset, used in messages.
    pub name: String,
    /// The image file, or the video that the frame belongs to.
    pub path: PathBuf,
    /// Frame number in the video, from 0; `None` where `path` is an image.
    pub number: Option<usize>,
    /// Time in [0, 1].
    pub time: f64,
    /// Camera at the original size of the image; a pinhole camera once the distortion is removed.
    pub camera: Camera,
    /// Lens distortion, which [`Frame::load`] removes.
    pub distortion: Distortion,
    /// Meaning of the image's alpha channel.
    pub alpha: Alpha,
    /// Mask file of the pixels that other frames also saw; test images are scored on these pixels.
    pub covisible: Option<PathBuf>,
}

/// A decoded image with its camera, ready for training.
#[derive(Clone, Debug)]
pub struct View {
    /// The frame's name, as [`Frame::name`].
    pub name: String,
    /// Time in [0, 1].
    pub time: f64,
    /// Pinhole camera of the image's size.
    pub camera: Camera,
    /// RGB in [0, 1].
    pub image: Image,
    /// One channel: 1 where the pixel is valid, 0 where undistortion had no source or nothing was measured
    /// ([`Alpha::Valid`]); `None` where all pixels are valid.
    pub valid: Option<Image>,
}

impl Frame {
    /// A frame whose image is a file of its own.
    fn of_image(name: String, path: PathBuf, time: f64, camera: Camera) -> Frame {
        Frame {
            name,
            path,
            number: None,
            time,
            camera,
            distortion: Distortion::default(),
            alpha: Alpha::Cover,
            covisible: None,
        }
    }

    /// Decodes the image, composites it over the background where its alpha channel is coverage, removes
    /// the distortion, then resizes; the camera is adapted. For a video, all frames up to this one are
    /// decoded; [`Dataset::load`] decodes several frames in one pass.
    pub fn load(&self, background: [f32; 3], size: Resize) -> Result<View> {
        if let Some(number) = self.number {
            let mut found = None;
            video::frames(&self.path, &[number], &mut |_, image| {
                found = Some(self.view(image, None, size)?);
                Ok(())
            })?;
            return Ok(found.expect("a video gives every frame, or an error"));
        }
        let (image, valid) = match self.alpha {
            Alpha::Cover => {
                (images::decode_rgb(&self.path, background, images::Orientation::Stored)?, None)
            }
            Alpha::Valid => images::decode_rgb_and_alpha(&self.path)?,
        };
        self.view(image, valid, size)
    }

    /// Reads the mask of [`Frame::covisible`], undistorted and resized like the image of [`Frame::load`].
    pub fn load_covisible(&self, size: Resize) -> Result<Option<Image>> {
        let Some(path) = &self.covisible else { return Ok(None) };
        let mask = read_mask(path)?;
        let k = &self.camera.intrinsics;
        if (mask.width, mask.height) != (k.width, k.height) {
            let what = format!(
                "is {}×{}, and the image that it belongs to, {}, is {}×{}",
                mask.width,
                mask.height,
                excerpt(&self.name),
                k.width,
                k.height
            );
            return Err(Error::format(path, what));
        }
        let mask = match self.distortion.is_none() {
            true => mask,
            false => self.lens().undistort(&mask, k).0,
        };
        let (width, height) = size.target(mask.width, mask.height);
        Ok(Some(resized_mask(mask, width, height)))
    }

    fn lens(&self) -> Lens {
        Lens { intrinsics: self.camera.intrinsics, distortion: self.distortion }
    }

    /// Makes the view from the decoded image and the mask of its measured pixels.
    fn view(&self, mut image: Image, mut valid: Option<Image>, size: Resize) -> Result<View> {
        let mut camera = self.camera;
        let k = &camera.intrinsics;
        if (image.width, image.height) != (k.width, k.height) {
            let what = format!(
                "is {}×{}, and was {}×{} when the dataset was opened",
                image.width, image.height, k.width, k.height
            );
            return Err(Error::format(&self.path, what));
        }
        if !self.distortion.is_none() {
            let (pinhole, inside) = self.lens().undistort(&image, k);
            image = pinhole;
            valid = match valid {
                // 0 as well where undistortion had no source.
                Some(valid) => Some(self.lens().undistort(&valid, k).0),
                None => inside,
            };
        }
        let (width, height) = size.target(image.width, image.height);
        valid = valid.map(|valid| resized_mask(valid, width, height));
        if (width, height) != (image.width, image.height) {
            image = images::resize(&image, width, height);
            camera.intrinsics = camera.intrinsics.resized(width, height);
        }
        Ok(View { name: self.name.clone(), time: self.time, camera, image, valid })
    }
}

/// Resizes a mask: a pixel is 1 only where all source pixels are 1.
fn resized_mask(mask: Image, width: u32, height: u32) -> Image {
    let mut mask = images::resize(&mask, width, height);
    mask.pixels.iter_mut().for_each(|p| *p = if *p > 0.999 { 1.0 } else { 0.0 });
    mask
}

/// Images with known cameras.
#[derive(Clone, Debug, Default)]
pub struct Dataset {
    /// All training and test frames. Of a dataset with a split, the training frames come first; each part
    /// is in the order of its file or of its names.
    pub frames: Vec<Frame>,
    /// Coloured points of the dataset; may be empty.
    pub points: Vec<Point>,
    /// Test frames of the dataset's own split, as indices into `frames`; `None` where it has no split.
    pub test: Option<Vec<usize>>,
    /// Whether the dataset gave times. If not, they run from 0 to 1 in the order of the frames.
    pub timed: bool,
    /// Background colour: white where the images have an alpha channel, as in D-NeRF and NeRF-synthetic,
    /// else black.
    pub background: [f32; 3],
    /// Whether the images have an alpha channel, judged by the first one.
    pub alpha: bool,
    /// Notes for the user: what was skipped or assumed.
    pub notes: Vec<String>,
    /// The files that were read besides the images.
    pub sources: Vec<PathBuf>,
}

impl Dataset {
    /// Opens a dataset: a folder, or a `transforms*.json` itself. Its kind is determined from the files,
    /// see [`layout`]. Only the headers of the images are read.
    ///
    /// # Errors
    /// The folder is missing or of no known kind, a file is damaged, or no image exists.
    pub fn open(path: impl AsRef<Path>) -> Result<Dataset> {
        let mut set = layout::find(path.as_ref())?.read()?;
        if let Some(first) = set.frames.first()
            && (first.alpha, first.number) == (Alpha::Cover, None)
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

    /// Training and test frames, in that order, as indices: those of the dataset's own split where it has
    /// one, else every `every`-th frame is a test frame, beginning with the first; 0 holds out none.
    pub fn split(&self, every: usize) -> (Vec<usize>, Vec<usize>) {
        let held = |i: &usize| match &self.test {
            Some(test) => test.contains(i),
            None => every > 0 && i.is_multiple_of(every),
        };
        let (test, train) = (0..self.frames.len()).partition(held);
        (train, test)
    }

    /// Loads frames on all cores, in the order of `indices`. Checks first that memory suffices for all of
    /// them.
    pub fn load(&self, indices: &[usize], size: Resize) -> Result<Vec<View>> {
        let bytes = |&i: &usize| {
            let frame = &self.frames[i];
            let k = frame.camera.intrinsics;
            let (width, height) = size.target(k.width, k.height);
            // Three floats per pixel, and one for the mask of valid pixels.
            let whole = frame.distortion.is_none() && frame.alpha == Alpha::Cover;
            let floats = if whole { 3 } else { 4 };
            4 * floats * u64::from(width) * u64::from(height)
        };
        let bytes = indices.iter().map(bytes).fold(0, u64::saturating_add);
        io::check_memory(bytes, &format!("loading {} images", indices.len()))?;
        let (of_videos, images): (Vec<usize>, Vec<usize>) =
            (0..indices.len()).partition(|&i| self.frames[indices[i]].number.is_some());
        let mut views: Vec<Option<View>> = vec![None; indices.len()];
        let at_a_time =
            images::at_a_time(largest(images.iter().map(|&i| &self.frames[indices[i]])));
        let load = |&i: &usize| self.frames[indices[i]].load(self.background, size);
        for places in images.chunks(at_a_time) {
            let loaded: Vec<View> = places.par_iter().map(load).collect::<Result<_>>()?;
            for (&place, view) in places.iter().zip(loaded) {
                views[place] = Some(view);
            }
        }
        self.load_of_videos(indices, &of_videos, size, &mut views)?;
        Ok(views.into_iter().flatten().collect())
    }

    /// Loads the frames that belong to videos, at `places` among the indices; each video is decoded once.
    fn load_of_videos(
        &self,
        indices: &[usize],
        places: &[usize],
        size: Resize,
        views: &mut [Option<View>],
    ) -> Result<()> {
        let mut videos: BTreeMap<&Path, BTreeMap<usize, Vec<usize>>> = BTreeMap::new();
        for &place in places {
            let frame = &self.frames[indices[place]];
            let Some(number) = frame.number else { continue };
            videos.entry(&frame.path).or_default().entry(number).or_default().push(place);
        }
        for (path, wanted) in videos {
            let numbers: Vec<usize> = wanted.keys().copied().collect();
            video::frames(path, &numbers, &mut |number, image| {
                for &place in &wanted[&number] {
                    let frame = &self.frames[indices[place]];
                    views[place] = Some(frame.view(image.clone(), None, size)?);
                }
                Ok(())
            })?;
        }
        Ok(())
    }

    /// The training images as the clip of one camera, ordered by time.
    ///
    /// # Errors
    /// A message: two images have the same time, or they belong to a video.
    fn as_clip(&self) -> std::result::Result<Vec<PathBuf>, String> {
        let (mut train, _) = self.split(0);
        train.sort_by(|&a, &b| self.frames[a].time.total_cmp(&self.frames[b].time));
        if let Some(two) =
            train.windows(2).find(|w| self.frames[w[0]].time == self.frames[w[1]].time)
        {
            let [a, b] = [two[0], two[1]].map(|i| excerpt(&self.frames[i].name));
            return Err(format!(
                "{a} and {b} were taken at one time, by several cameras; name the folder or the \
                 video of one camera"
            ));
        }
        if let Some(&first) = train.iter().find(|&&i| self.frames[i].number.is_some()) {
            return Err(format!("name the video itself ({})", self.frames[first].path.display()));
        }
        Ok(train.into_iter().map(|i| self.frames[i].path.clone()).collect())
    }
}

/// Width and height of the image with the most pixels; zeros without images.
fn largest<'a>(frames: impl IntoIterator<Item = &'a Frame>) -> (u32, u32) {
    let size = |frame: &Frame| (frame.camera.intrinsics.width, frame.camera.intrinsics.height);
    let sizes = frames.into_iter().map(size);
    sizes.max_by_key(|&(w, h)| u64::from(w) * u64::from(h)).unwrap_or_default()
}

/// Scales a camera to the size of its image, because datasets are often stored at a fraction of the
/// calibrated size.
fn fit_to_image(camera: &mut Camera, path: &Path) -> Result<()> {
    let size = images::dimensions(path, images::Orientation::Stored)?;
    fit_to_size(camera, path, size)
}

/// [`fit_to_image`] for a known size.
fn fit_to_size(camera: &mut Camera, path: &Path, (width, height): (u32, u32)) -> Result<()> {
    let k = camera.intrinsics;
    let (sx, sy) = (f64::from(width) / f64::from(k.width), f64::from(height) / f64::from(k.height));
    // Halving an odd side rounds, so one pixel of difference in proportion is allowed.
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

/// The note about images that a dataset lists but does not contain.
fn missing_note(missing: &[String], listed: usize) -> Option<String> {
    let first = missing.first()?;
    Some(format!(
        "skipped {} of {listed} listed images that do not exist ({} …)",
        missing.len(),
        excerpt(first)
    ))
}
