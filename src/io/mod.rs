//! What every reader and writer of files needs: whole-file reads with the path in the error, writes
//! by rename, a bounds-checked cursor over bytes, the PLY container, zip archives, files of state, and how much
//! memory there is.

mod archive;
mod bytes;
mod folder;
mod memory;
pub mod ply;
mod state;
mod write;

pub use archive::Archive;
pub use bytes::Bytes;
pub use folder::{check_new_folder, write_folder};
pub(crate) use memory::gibibytes;
pub use memory::{available_memory, check_limits, check_memory};
pub use state::{Identity, checksum, difference, read_state, write_state};
pub use write::{Sink, follow_links, write_atomically, write_json};

use std::fs::File;
use std::io::Read;
use std::path::Path;

use crate::error::excerpt;
use crate::{Error, Result};

/// Bytes that are there without asking.
const SMALL: u64 = 16 << 20;
/// Bytes of the largest JSON file that is read: the cameras of some 300,000 pictures.
const MOST_JSON: u64 = 256 << 20;
/// Memory that JSON takes when it is read, in units of its size.
const JSON_SHARE: u64 = 12;
/// Bytes of the largest text file that is read: COLMAP lists every observation of a point.
const MOST_TEXT: u64 = 4 << 30;

/// Opens an input file. Only a regular file is one: a pipe may never be written to, a device may
/// never end. Every input of the crate is opened here.
///
/// # Errors
/// [`Error::Io`] where it cannot be opened, [`Error::Format`] where it is no regular file.
pub fn open(path: &Path) -> Result<File> {
    let check = |found: &std::fs::Metadata| {
        if found.is_dir() {
            return Err(Error::format(path, "is a folder, a file was expected"));
        }
        if !found.is_file() {
            let what = "is no regular file but a pipe, a device or a socket; copy what it gives \
                        into a file, and name that";
            return Err(Error::format(path, what));
        }
        Ok(())
    };
    // Opening a pipe waits already.
    check(&std::fs::metadata(path).map_err(Error::io(path))?)?;
    let file = File::open(path).map_err(Error::io(path))?;
    check(&file.metadata().map_err(Error::io(path))?)?;
    Ok(file)
}

/// Reads a whole file, as large as there is memory for; the error names it.
pub fn read(path: &Path) -> Result<Vec<u8>> {
    read_at_most(path, u64::MAX, 1)
}

/// Reads a file of at most so many bytes, each of which takes `share` bytes of memory in the end.
fn read_at_most(path: &Path, most: u64, share: u64) -> Result<Vec<u8>> {
    let file = open(path)?;
    let size = file.metadata().map_err(Error::io(path))?.len();
    if size > most {
        let what = format!("has {size} bytes; a file of its kind has at most {most}");
        return Err(Error::format(path, what));
    }
    let taken = size.saturating_mul(share);
    if taken > SMALL {
        check_memory(taken, &format!("reading {}", path.display()))?;
    }
    let mut bytes = Vec::new();
    let reserved = usize::try_from(size).is_ok_and(|size| bytes.try_reserve_exact(size).is_ok());
    if !reserved {
        return Err(Error::io(path)(std::io::ErrorKind::OutOfMemory.into()));
    }
    // Some files of the system announce nothing and give much.
    let most = size.max(SMALL);
    file.take(most + 1).read_to_end(&mut bytes).map_err(Error::io(path))?;
    if bytes.len() as u64 > most {
        let what = format!("gives more than the {size} bytes that it announces");
        return Err(Error::format(path, what));
    }
    Ok(bytes)
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
    String::from_utf8(read_at_most(path, MOST_TEXT, 2)?).map_err(|e| {
        Error::format(path, format!("is not a text file (byte {})", e.utf8_error().valid_up_to()))
    })
}

/// Reads a JSON file; the error names the file, the line and the column.
pub fn read_json(path: &Path) -> Result<serde_json::Value> {
    let text = read_at_most(path, MOST_JSON, JSON_SHARE)?;
    serde_json::from_slice(&text)
        .map_err(|e| Error::format(path, format!("is not valid JSON: {}", excerpt(&e.to_string()))))
}
