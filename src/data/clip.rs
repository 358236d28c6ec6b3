//! A clip: the frames of one video, in order, cameras unknown.

use std::path::Path;

use rayon::prelude::*;

use super::images::{self, Orientation, Resize};
use super::{exif, video};
use crate::types::Image;
use crate::{Error, Result};

/// What to take of a clip.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ClipOptions {
    /// Every so-manieth frame, beginning with the first; 1 takes all.
    pub every: usize,
    /// At most so many frames, after `every`.
    pub max_frames: Option<usize>,
    /// The size to bring the frames to.
    pub size: Resize,
    /// Leave out images of a folder that cannot be read, with a note, instead of failing.
    pub skip_bad: bool,
}

impl Default for ClipOptions {
    fn default() -> Self {
        ClipOptions { every: 1, max_frames: None, size: Resize::Keep, skip_bad: false }
    }
}

/// One frame.
#[derive(Clone, Debug)]
pub struct ClipFrame {
    /// The file's name without extension, or the frame's number in the video.
    pub name: String,
    /// In [0, 1]: the first frame 0, the last 1.
    pub time: f64,
    /// RGB in [0, 1].
    pub image: Image,
}

/// At least two frames of one size.
#[derive(Clone, Debug)]
pub struct Clip {
    /// In order.
    pub frames: Vec<ClipFrame>,
    /// Width of every frame.
    pub width: u32,
    /// Height of every frame.
    pub height: u32,
    /// Width and height that the frames had before they were brought to this size.
    pub original: (u32, u32),
    /// Frames a second of what was taken, where the file says.
    pub rate: Option<f64>,
    /// Focal length in pixels of the frames as taken, where EXIF says.
    pub focal: Option<f64>,
    /// Lines to show.
    pub notes: Vec<String>,
}

impl Clip {
    /// Opens a video file (through `ffmpeg`), or a folder of images in natural order of their names;
    /// a folder without images but with a folder `frames` or `images` in it stands for that one.
    ///
    /// # Errors
    /// No such file; a folder without images; only one frame; frames of different sizes; an image
    /// that cannot be read (unless `skip_bad`); no `ffmpeg`. Each names the file and says what to do.
    pub fn open(path: impl AsRef<Path>, options: &ClipOptions) -> Result<Clip> {
        let path = path.as_ref();
        if options.every == 0 || options.max_frames.is_some_and(|most| most < 2) {
            let what = "take every 1st frame or more, and at least 2 frames";
            return Err(Error::Input(what.into()));
        }
        let found = std::fs::metadata(path).map_err(Error::io(path))?;
        if found.is_dir() {
            return open_folder(path, options);
        }
        if images::has_image_extension(path) {
            return Err(one_frame(path));
        }
        let decoded = video::decode(path, options)?;
        let mut clip = assemble(path, decoded.frames, options)?;
        clip.original = decoded.original;
        clip.rate = decoded.rate.map(|rate| rate / options.every as f64);
        Ok(clip)
    }
}

fn one_frame(path: &Path) -> Error {
    Error::format(
        path,
        "has one frame only; a reconstruction needs a moving camera's video, two frames at least",
    )
}

fn assemble(path: &Path, frames: Vec<(String, Image)>, options: &ClipOptions) -> Result<Clip> {
    if frames.len() < 2 {
        let what =
            if options.every > 1 { " (of those taken; take more with a smaller step)" } else { "" };
        return Err(match frames.len() {
            0 => Error::format(path, format!("has no frames{what}")),
            _ if options.every > 1 => Error::format(path, format!("has one frame only{what}")),
            _ => one_frame(path),
        });
    }
    let last = (frames.len() - 1) as f64;
    let (width, height) = (frames[0].1.width, frames[0].1.height);
    let frames = frames
        .into_iter()
        .enumerate()
        .map(|(i, (name, image))| ClipFrame { name, time: i as f64 / last, image })
        .collect();
    let original = (width, height);
    Ok(Clip { frames, width, height, original, rate: None, focal: None, notes: Vec::new() })
}

fn open_folder(folder: &Path, options: &ClipOptions) -> Result<Clip> {
    let mut files = images::list(folder)?;
    for inner in ["frames", "images"] {
        let inner = folder.join(inner);
        if files.is_empty() && inner.is_dir() {
            files = images::list(&inner)?;
        }
    }
    if files.is_empty() {
        let known = images::EXTENSIONS.join(", ");
        return Err(Error::format(folder, format!("holds no images ({known})")));
    }
    let total = files.len();
    if total == 1 {
        return Err(one_frame(folder));
    }
    // Bad files are looked for among the frames that are taken: what lies between is of no concern.
    let files: Vec<_> = files
        .into_iter()
        .step_by(options.every)
        .take(options.max_frames.unwrap_or(usize::MAX))
        .collect();
    let decoded: Vec<_> = files
        .par_iter()
        .map(|file| {
            let image = images::decode_rgb(file, [0.0; 3], Orientation::Upright)?;
            let size = (image.width, image.height);
            let (width, height) = options.size.target(size.0, size.1);
            Ok((file, size, images::resize(&image, width, height)))
        })
        .collect();
    let (mut frames, mut bad) = (Vec::new(), Vec::new());
    let mut first = None;
    for (result, file) in decoded.into_iter().zip(&files) {
        match result {
            Ok((file, size, image)) => {
                let (of, expected) = *first.get_or_insert((file, size));
                if size != expected {
                    return Err(Error::format(
                        file,
                        format!(
                            "is {}×{}, but {} is {}×{}; all frames must have one size",
                            size.0,
                            size.1,
                            of.file_name().unwrap_or_default().to_string_lossy(),
                            expected.0,
                            expected.1
                        ),
                    ));
                }
                let stem = file.file_stem().unwrap_or_default().to_string_lossy().into_owned();
                frames.push((stem, image));
            }
            Err(error) if !options.skip_bad => return Err(hint_skip(error)),
            Err(_) => bad.push(file.file_name().unwrap_or_default().to_string_lossy()),
        }
    }
    let mut clip = assemble(folder, frames, options)?;
    if let Some(name) = bad.first() {
        let (n, all) = (bad.len(), files.len());
        clip.notes.push(format!("skipped {n} of {all} images that cannot be read ({name} …)"));
    }
    if let Some((file, (width, height))) = first {
        clip.original = (width, height);
        let scale = f64::from(clip.width) / f64::from(width);
        clip.focal = exif::focal(file, width, height).map(|focal| focal * scale);
    }
    Ok(clip)
}

/// Says how to go on where one image of a folder is damaged.
fn hint_skip(error: Error) -> Error {
    match error {
        Error::Format { path, what } => {
            Error::Format { path, what: format!("{what}; --skip-bad leaves such images out") }
        }
        other => other,
    }
}
