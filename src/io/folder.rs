//! Folders of which a reader sees the whole or nothing.

use std::fs;
use std::path::Path;

use crate::{Error, Result};

/// That `folder` can be written by [`write_folder`]: it does not exist yet, or is empty.
///
/// # Errors
/// [`Error::Input`] when it is not empty; [`Error::Io`] when it cannot be read or is no folder.
pub fn check_new_folder(folder: impl AsRef<Path>) -> Result<()> {
    let folder = folder.as_ref();
    if !folder.exists() {
        return Ok(());
    }
    let mut entries = fs::read_dir(folder).map_err(Error::io(folder))?;
    match entries.next() {
        None => Ok(()),
        Some(_) => Err(Error::Input(format!(
            "{} is not empty; name a new folder, or remove it first",
            folder.display()
        ))),
    }
}

/// Makes a new folder, or fills an empty one, with what `fill` writes into the folder that it is given.
/// A new folder appears by rename, whole. In one that is there, `names`, all that `fill` writes, appear
/// by rename one after the other.
///
/// # Errors
/// Those of [`check_new_folder`] and of `fill`; [`Error::Io`] when the disk refuses. Then nothing is left
/// behind.
pub fn write_folder(
    folder: &Path,
    names: &[&str],
    fill: impl FnOnce(&Path) -> Result<()>,
) -> Result<()> {
    check_new_folder(folder)?;
    // A folder that is there stays the same one: it may be a link, or where a disk is mounted.
    let new = !folder.exists();
    let parent = match folder.parent() {
        _ if !new => folder,
        Some(parent) if parent != Path::new("") => parent,
        _ => Path::new("."),
    };
    fs::create_dir_all(parent).map_err(Error::io(parent))?;
    let partial = tempfile::Builder::new()
        .prefix(".splat4d-")
        .tempdir_in(parent)
        .map_err(Error::io(parent))?;
    // Nested, since a temporary folder is its owner's alone and its mode would come along.
    let whole = partial.path().join("whole");
    fill(&whole).map_err(|error| moved(error, &whole, folder))?;
    if new {
        return fs::rename(&whole, folder).map_err(Error::io(folder));
    }
    names
        .iter()
        .try_for_each(|name| fs::rename(whole.join(name), folder.join(name)))
        .map_err(Error::io(folder))
}

/// An error of writing below one folder, told of the folder that is to take its place.
fn moved(error: Error, from: &Path, to: &Path) -> Error {
    match error {
        Error::Io { path, source } => {
            let path = path.strip_prefix(from).map(|rest| to.join(rest)).unwrap_or(path);
            Error::Io { path, source }
        }
        other => other,
    }
}
