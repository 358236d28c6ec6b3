//! Writes of which a reader sees the whole or nothing.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use crate::{Error, Result};

/// What a writer of [`write_atomically`] writes to: buffered, and able to seek.
pub type Sink<'a> = BufWriter<&'a File>;

/// Links that lead from one to the next before they count as a circle; Linux's own number.
const MOST_LINKS: usize = 40;

/// Writes a file so that a reader sees the old content or the whole new one, never a part: `write`
/// fills a temporary file in the same folder, which is flushed to the disk and then renamed. Folders
/// that are missing are made. On any error, a full disk among them, nothing is left behind.
///
/// Where `path` is a symbolic link, the file that it leads to is written, and the link stays. A path
/// that exists and is no regular file (a pipe, a device) is written in place: renaming over it would
/// replace the device itself.
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
        // As for any new file: the process's umask has the last word.
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

/// Where a file written at `path` comes to lie: `path` itself, or where its chain of symbolic links
/// ends, whether something lies there or not.
///
/// # Errors
/// The links form a circle, or one cannot be read.
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

/// Writes JSON, indented, by rename.
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
