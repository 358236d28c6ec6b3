//! DAVIS: clips with a mask per frame, without cameras.
//!
//! `JPEGImages/480p/NAME/00000.jpg`, … are the frames, `Annotations/480p/NAME/00000.png`, … the masks
//! ([`read_mask`](super::read_mask)): white on black in DAVIS 2016, a colour for each object in DAVIS 2017.
//!
//! Source: the readme of DAVIS 2016 and of DAVIS 2017.

use std::path::{Path, PathBuf};

use crate::{Error, Result};

/// Resolutions of the clips; the one that is scored comes first.
const SIZES: [&str; 3] = ["480p", "1080p", "Full-Resolution"];

/// Whether a folder is a DAVIS dataset.
pub(super) fn is_root(folder: &Path) -> bool {
    ["JPEGImages", "Annotations"].iter().all(|name| folder.join(name).is_dir())
}

/// The names of the clips in a folder.
///
/// # Errors
/// [`Error::Io`]; [`Error::Format`] where there are no clips.
pub fn names(root: &Path) -> Result<Vec<String>> {
    let all = clips(root, "JPEGImages");
    let mut names = Vec::new();
    for entry in std::fs::read_dir(&all).map_err(Error::io(&all))? {
        let path = entry.map_err(Error::io(&all))?.path();
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        if path.is_dir() && !name.starts_with('.') {
            names.push(name);
        }
    }
    names.sort();
    match names.is_empty() {
        true => Err(Error::format(all, "holds no clips, which are folders of frames")),
        false => Ok(names),
    }
}

/// The folder of a clip's frames.
pub fn frames(root: &Path, name: &str) -> PathBuf {
    clips(root, "JPEGImages").join(name)
}

/// The folder of a clip's masks.
pub fn masks(root: &Path, name: &str) -> PathBuf {
    clips(root, "Annotations").join(name)
}

fn clips(root: &Path, what: &str) -> PathBuf {
    let folder = root.join(what);
    SIZES.iter().map(|size| folder.join(size)).find(|size| size.is_dir()).unwrap_or(folder)
}

/// The frames of the only clip that a folder holds.
///
/// # Errors
/// Those of [`names`]; [`Error::Format`] where there are several clips.
pub(super) fn only_clip(root: &Path) -> Result<PathBuf> {
    let names = names(root)?;
    if let [first, _, ..] = &names[..] {
        let what = format!(
            "holds {} clips of DAVIS; give the frames of one, such as {}",
            names.len(),
            frames(root, first).display()
        );
        return Err(Error::format(root, what));
    }
    Ok(frames(root, &names[0]))
}

/// The message about a DAVIS folder where cameras are required.
pub(super) fn without_cameras(folder: &Path) -> Option<String> {
    is_root(folder).then(|| {
        "holds clips of DAVIS, which have no cameras: reconstruct one of them, with its masks as motion masks"
            .to_owned()
    })
}
