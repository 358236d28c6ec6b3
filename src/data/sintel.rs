//! Sequences of MPI Sintel.
//!
//! A pass (`clean`, `final`) holds an image folder for each sequence, `frame_0001.png`, …; beside the
//! passes are `camdata_left` ([`cam`]), `depth` ([`dpt`](super::dpt)) and `flow` ([`flo`](super::flo), one
//! field fewer), each with a folder of the sequence's name and files of the images' names. The focal length
//! also varies between frames; world units are Sintel's.
//!
//! Source: the readme of MPI-Sintel-depth-training; `eval_metadata.py` of junyi42/monst3r for the 14
//! sequences.

use std::path::{Path, PathBuf};

use super::{Dataset, Frame, cam, images};
use crate::types::Camera;
use crate::{Error, Result};

/// The sequences of pass `final` that are commonly used to evaluate camera poses.
pub const SEQUENCES: [&str; 14] = [
    "alley_2",
    "ambush_4",
    "ambush_5",
    "ambush_6",
    "cave_2",
    "cave_4",
    "market_2",
    "market_5",
    "market_6",
    "shaman_3",
    "sleeping_1",
    "sleeping_2",
    "temple_2",
    "temple_3",
];

/// The folder of cameras beside the passes.
const CAMERAS: &str = "camdata_left";

/// The camera folder of a sequence, from its image folder.
pub fn cameras_of(pictures: &Path) -> Option<PathBuf> {
    beside(pictures, CAMERAS)
}

/// The depth folder of a sequence, from its image folder.
pub fn depth_of(pictures: &Path) -> Option<PathBuf> {
    beside(pictures, "depth")
}

/// The flow folder of a sequence, from its image folder.
pub fn flow_of(pictures: &Path) -> Option<PathBuf> {
    beside(pictures, "flow")
}

fn beside(pictures: &Path, what: &str) -> Option<PathBuf> {
    let root = pictures.parent()?.parent()?;
    Some(root.join(what).join(pictures.file_name()?)).filter(|folder| folder.is_dir())
}

/// The message about a folder that contains passes or sequences but is not a sequence itself.
pub(super) fn root(folder: &Path) -> Option<String> {
    let root = [folder.to_path_buf(), folder.join("training"), folder.join("..")];
    let root = root.into_iter().find(|root| root.join(CAMERAS).is_dir())?;
    Some(format!(
        "holds several sequences of MPI Sintel; give the images of one, such as {}",
        root.join("final").join(SEQUENCES[0]).display()
    ))
}

/// Reads a sequence: its images, and the cameras of the same names. Times run from 0 to 1.
///
/// # Errors
/// [`Error::Io`]; [`Error::Format`]: there are no images, one has no camera, or a camera does not fit its
/// size.
pub fn read(pictures: &Path, cameras: &Path) -> Result<Dataset> {
    let files = images::list(pictures)?;
    if files.is_empty() {
        return Err(Error::format(pictures, "holds no images"));
    }
    let mut set = Dataset { timed: true, ..Dataset::default() };
    let last = files.len().saturating_sub(1).max(1) as f64;
    for (i, file) in files.into_iter().enumerate() {
        let stem = file.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let path = cameras.join(format!("{stem}.cam"));
        if !path.is_file() {
            let what =
                format!("has no {stem}.cam, and {} is an image of the sequence", file.display());
            return Err(Error::format(cameras, what));
        }
        let found = cam::read(&path)?;
        let (width, height) = images::dimensions(&file, images::Orientation::Stored)?;
        let intrinsics =
            found.intrinsics(width, height).map_err(|what| Error::format(&path, what))?;
        let camera = Camera { intrinsics, view_from_world: found.pose };
        set.frames.push(Frame::of_image(stem, file, i as f64 / last, camera));
        set.sources.push(path);
    }
    Ok(set)
}
