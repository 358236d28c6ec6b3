//! Recognition of a dataset's kind from the files in its folder.
//!
//! | kind | recognised by |
//! |---|---|
//! | nerfstudio, instant-ngp | `transforms.json` |
//! | D-NeRF, NeRF-synthetic | `transforms_train.json` |
//! | Nerfies, HyperNeRF, DyCheck | `scene.json`, `dataset.json` and `camera/`; or an image folder `rgb/Nx` |
//! | DyNeRF, NVIDIA dynamic scenes | `poses_bounds.npy` with `cam*.mp4`, `cam*/images` or `mv_images/` |
//! | COLMAP | `cameras.bin` or `.txt` in `sparse/0`, `sparse`, `colmap/sparse/0` or the folder itself |
//! | LLFF | `poses_bounds.npy` with `images/`; or another folder of its images (`images_4`) |
//! | MPI Sintel | a sequence's images (`final/alley_2`), with cameras in `camdata_left/alley_2` beside |
//!
//! A folder that matches several kinds is of the first one in this table; the kinds with more information
//! come first.

use std::path::{Path, PathBuf};

use super::{Dataset, colmap, davis, nerfies, poses_bounds, sintel, transforms};
use crate::{Error, Result};

/// A recognised dataset, with the location of its parts.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Layout {
    /// One `transforms.json`.
    Transforms(PathBuf),
    /// A folder with `transforms_train.json`.
    Split(PathBuf),
    /// The folder with `scene.json`, and the image folder where one was named.
    Nerfies(PathBuf, Option<PathBuf>),
    /// The folder with `poses_bounds.npy`, and the image folder where one was named.
    PosesBounds(PathBuf, Option<PathBuf>),
    /// A folder, and the folder of its COLMAP model.
    Colmap(PathBuf, PathBuf),
    /// The image folder of a sequence, and its camera folder.
    Sintel(PathBuf, PathBuf),
}

impl Layout {
    /// Reads the dataset. Times are those of the dataset; [`Dataset::open`] fills in missing ones.
    pub(super) fn read(&self) -> Result<Dataset> {
        match self {
            Layout::Transforms(file) => transforms::read(file),
            Layout::Split(folder) => transforms::read_split(folder),
            Layout::Nerfies(root, pictures) => nerfies::read(root, pictures.as_deref()),
            Layout::PosesBounds(root, pictures) => poses_bounds::read(root, pictures.as_deref()),
            Layout::Colmap(root, model) => colmap::read(root, model),
            Layout::Sintel(pictures, cameras) => sintel::read(pictures, cameras),
        }
    }
}

/// Recognises a dataset from a folder's files, or a `transforms*.json` from its name.
///
/// # Errors
/// [`Error::Io`] where the path does not exist; [`Error::Format`] for an unknown kind, with a list of what
/// was looked for.
pub fn find(path: &Path) -> Result<Layout> {
    let found = std::fs::metadata(path).map_err(Error::io(path))?;
    if !found.is_dir() {
        return match path.extension().is_some_and(|e| e == "json") {
            true => Ok(Layout::Transforms(path.to_path_buf())),
            false => Err(Error::format(
                path,
                "is not a dataset; give its folder or its transforms.json. \
                 A video whose poses are unknown goes to `splat4d reconstruct`",
            )),
        };
    }
    if let Some(layout) = recognise(path) {
        return Ok(layout);
    }
    if let Some(what) = sintel::root(path).or_else(|| davis::without_cameras(path)) {
        return Err(Error::format(path, what));
    }
    Err(Error::format(
        path,
        "is no dataset that is known. Looked for: transforms.json; transforms_train.json (D-NeRF); \
         scene.json, dataset.json and camera/ (Nerfies, HyperNeRF, DyCheck); poses_bounds.npy (LLFF, \
         DyNeRF, NVIDIA); a COLMAP model (sparse/0/cameras.bin or .txt); camdata_left/ beside a \
         sequence of MPI Sintel. Images or a video whose poses are unknown go to `splat4d reconstruct`",
    ))
}

/// Recognises a folder, in the order of the table above.
pub(super) fn recognise(folder: &Path) -> Option<Layout> {
    let root = || folder.to_path_buf();
    let pictures = Some(root());
    let holds = |name: &str| folder.join(name).is_file();
    if holds("transforms.json") {
        return Some(Layout::Transforms(folder.join("transforms.json")));
    }
    if holds("transforms_train.json") {
        return Some(Layout::Split(root()));
    }
    if nerfies::is_root(folder) {
        return Some(Layout::Nerfies(root(), None));
    }
    if let Some(root) = nerfies::root_of(folder) {
        return Some(Layout::Nerfies(root, pictures));
    }
    if poses_bounds::of_several_cameras(folder) {
        return Some(Layout::PosesBounds(root(), None));
    }
    if let Some(model) = colmap::find(folder) {
        return Some(Layout::Colmap(root(), model));
    }
    if poses_bounds::is_root(folder) {
        return Some(Layout::PosesBounds(root(), None));
    }
    if let Some(root) = poses_bounds::root_of(folder) {
        return Some(Layout::PosesBounds(root, pictures));
    }
    sintel::cameras_of(folder).map(|cameras| Layout::Sintel(root(), cameras))
}
