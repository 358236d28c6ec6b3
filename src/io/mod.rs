//! What every reader and writer of files needs: whole-file reads with the path in the error, writes
//! by rename, a bounds-checked cursor over bytes, the PLY container, files of state, and how much
//! memory there is.

mod bytes;
mod memory;
pub mod ply;
mod state;

pub use bytes::Bytes;
pub use memory::{available_memory, check_memory};
pub use state::{Identity, checksum, read_state, write_state};

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::Path;

use crate::{Error, Result};

/// What a writer of [`write_atomically`] writes to: buffered, and able to seek.
pub type Sink<'a> = BufWriter<&'a File>;

/// Reads a whole file; the error names it.
pub fn read(path: &Path) -> Result<Vec<u8>> {
    if path.is_dir() {
        return Err(Error::format(path, "is a folder, a file was expected"));
    }
    std::fs::read(path).map_err(Error::io(path))
}

/// Bytes that a compressed file may unpack to whatever its own size.
const UNPACKED: u64 = 64 << 20;
/// Times its size that a larger one may unpack to: beyond deflate's best, 1032.
const UNPACKED_SHARE: u64 = 1100;

/// That a file of `packed` bytes may hold what its header announces, before memory is asked for:
/// damage must not ask for the machine's.
pub fn check_unpacked(path: &Path, unpacked: u64, packed: usize) -> Result<()> {
    if unpacked <= UNPACKED.max(UNPACKED_SHARE.saturating_mul(packed as u64)) {
        return Ok(());
    }
    Err(Error::format(
        path,
        format!("its header announces {unpacked} bytes, which its {packed} bytes cannot hold"),
    ))
}

/// Reads a whole text file; the error names it.
pub fn read_text(path: &Path) -> Result<String> {
    String::from_utf8(read(path)?).map_err(|e| {
        Error::format(path, format!("is not a text file (byte {})", e.utf8_error().valid_up_to()))
    })
}

/// Reads a JSON file; the error names the file, the line and the column.
pub fn read_json(path: &Path) -> Result<serde_json::Value> {
    let text = read(path)?;
    serde_json::from_slice(&text)
        .map_err(|e| Error::format(path, format!("is not valid JSON: {e}")))
}

/// Writes a file so that a reader sees the old content or the whole new one, never a part: `write`
/// fills a temporary file in the same folder, which is flushed to the disk and then renamed. Folders
/// that are missing are made. On any error, a full disk among them, nothing is left behind.
///
/// A path that exists and is no regular file (a pipe, a device) is written in place: renaming over
/// it would replace the device itself.
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
    let folder = match path.parent() {
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
    temporary.persist(path).map_err(|e| Error::Io { path: path.to_path_buf(), source: e.error })?;
    Ok(())
}

/// Writes JSON, indented, by rename.
pub fn write_json(path: impl AsRef<Path>, value: &serde_json::Value) -> Result<()> {
    write_atomically(path, |sink| {
        serde_json::to_writer_pretty(&mut *sink, value)?;
        sink.write_all(b"\n")
    })
}
