//! Atomic writing of files: a reader sees the complete file or nothing.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use crate::{Error, Result};

/// The output of [`write_atomically`]: buffered and seekable.
pub type Sink<'a> = BufWriter<&'a File>;

/// Maximum length of a chain of symbolic links before it counts as a cycle; the limit of Linux.
const MOST_LINKS: usize = 40;

/// Writes a file atomically: a reader sees the old content or the complete new content. `write`
/// fills a temporary file in the same folder, which is flushed to disk and then renamed. Missing
/// folders are created. On any error, a full disk included, nothing is left behind.
///
/// If `path` is a symbolic link, its target is written and the link stays. An existing path that is
/// not a regular file (a pipe, a device) is written in place, since a rename would replace the
/// device itself.
pub fn write_atomically(
    path: impl AsRef<Path>,
    write: impl FnOnce(&mut Sink) -> std::io::Result<()>,
) -> Result<()> {
    let path = path.as_ref();
    let fill = |file: &File| {
        let mut sink = BufWriter::with_capacity(1 << 16, file);
        write(&mut sink)?;
        sink.flush()
    };
    if let Ok(found) = std::fs::metadata(path) {
        if found.is_dir() {
            return Err(Error::format(path, "is a folder; name the file to write"));
        }
        if !found.is_file() {
            let file = File::options().write(true).open(path).map_err(Error::io(path))?;
            return fill(&file).map_err(Error::io(path));
        }
    }
    let target = follow_links(path).map_err(Error::io(path))?;
    let folder = match target.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    };
    std::fs::create_dir_all(folder).map_err(Error::io(folder))?;
    let mut builder = tempfile::Builder::new();
    builder.prefix(".splat4d-").suffix(".part");
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        // The default mode of new files, before the process's umask.
        builder.permissions(std::fs::Permissions::from_mode(0o666));
    }
    let temporary = builder.tempfile_in(folder).map_err(Error::io(path))?;
    fill(temporary.as_file()).map_err(Error::io(path))?;
    temporary.as_file().sync_all().map_err(Error::io(path))?;
    temporary
        .persist(&target)
        .map_err(|e| Error::Io { path: path.to_path_buf(), source: e.error })?;
    Ok(())
}

/// The final path of a file written at `path`: `path` itself, or the end of its chain of symbolic
/// links, which need not exist.
///
/// # Errors
/// The links form a cycle, or a link cannot be read.
pub fn follow_links(path: &Path) -> std::io::Result<PathBuf> {
    let mut target = path.to_path_buf();
    for _ in 0..MOST_LINKS {
        match std::fs::symlink_metadata(&target) {
            Ok(found) if found.is_symlink() => {
                let next = std::fs::read_link(&target)?;
                target = target.parent().unwrap_or(Path::new("")).join(next);
            }
            _ => return Ok(target),
        }
    }
    Err(std::io::Error::other("its symbolic links lead in a circle"))
}

/// Writes indented JSON, atomically by rename.
pub fn write_json(path: impl AsRef<Path>, value: &serde_json::Value) -> Result<()> {
    write_atomically(path, |sink| {
        serde_json::to_writer_pretty(&mut *sink, value)?;
        sink.write_all(b"\n")
    })
}

#[cfg(all(test, unix))]
mod tests {
    use super::*;
    use std::fs;
    use std::os::unix::fs::symlink;

    #[test]
    fn links_stay_and_lead_to_what_is_written() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        let write = |name: &str, text: &str| {
            write_atomically(at(name), |sink| sink.write_all(text.as_bytes()))
        };
        fs::create_dir(at("inner")).unwrap();
        fs::write(at("inner/old"), "old").unwrap();
        symlink("inner/old", at("link")).unwrap();
        symlink("link", at("link to link")).unwrap();
        symlink("inner/new", at("to nothing yet")).unwrap();
        symlink("circle", at("circle")).unwrap();
        write("link to link", "new").unwrap();
        write("to nothing yet", "first").unwrap();
        for link in ["link", "link to link", "to nothing yet"] {
            assert!(at(link).is_symlink(), "{link}");
        }
        assert_eq!(fs::read_to_string(at("inner/old")).unwrap(), "new");
        assert_eq!(fs::read_to_string(at("inner/new")).unwrap(), "first");
        let message = write("circle", "never").unwrap_err().to_string();
        assert!(message.contains("circle"), "{message}");
        assert_eq!(fs::read_dir(at("inner")).unwrap().count(), 2, "nothing else is left");
    }
}
