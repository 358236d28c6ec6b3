//! Atomic writing of folders: a reader sees the complete folder or nothing.

use std::fs;
use std::path::Path;

use crate::{Error, Result};

/// Checks that [`write_folder`] can write `folder`: it does not exist yet, or is empty.
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

/// Creates a folder, or fills an empty one, with the files that `fill` writes into the temporary
/// folder that it is given. A new folder appears complete, by one rename. In an existing folder,
/// the entries `names` (everything that `fill` writes) appear by rename one after the other.
///
/// # Errors
/// Those of [`check_new_folder`] and of `fill`; [`Error::Io`] when a write fails. On an error
/// nothing is left behind.
pub fn write_folder(
    folder: &Path,
    names: &[&str],
    fill: impl FnOnce(&Path) -> Result<()>,
) -> Result<()> {
    check_new_folder(folder)?;
    // An existing folder is not replaced: it may be a link or a mount point.
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
    // A nested folder is renamed, since a temporary folder is accessible to its owner only and
    // would keep that mode.
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

/// Replaces the temporary folder in an error's path by the final folder.
fn moved(error: Error, from: &Path, to: &Path) -> Error {
    match error {
        Error::Io { path, source } => {
            let path = path.strip_prefix(from).map(|rest| to.join(rest)).unwrap_or(path);
            Error::Io { path, source }
        }
        other => other,
    }
}
