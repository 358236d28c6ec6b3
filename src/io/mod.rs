//! File input and output shared by all readers and writers: whole-file reads with the path in the
//! error, writes by rename, a bounds-checked cursor over bytes, the PLY container, zip archives,
//! state files, and checks of available memory.

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

/// Size in bytes up to which memory is not checked.
const SMALL: u64 = 16 << 20;
/// Largest JSON file that is read, bytes: the cameras of about 300,000 images.
const MOST_JSON: u64 = 256 << 20;
/// Memory needed to parse JSON, in units of the file's size.
const JSON_SHARE: u64 = 12;
/// Largest text file that is read, bytes. It is large because COLMAP lists every observation of a
/// point.
const MOST_TEXT: u64 = 4 << 30;

/// Opens an input file. It must be a regular file, since reading a pipe may block and a device may
/// never end. Every input of the crate is opened here.
///
/// # Errors
/// [`Error::Io`] if it cannot be opened, [`Error::Format`] if it is not a regular file.
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
    // Checked before opening, since opening a pipe can block.
    check(&std::fs::metadata(path).map_err(Error::io(path))?)?;
    let file = File::open(path).map_err(Error::io(path))?;
    check(&file.metadata().map_err(Error::io(path))?)?;
    Ok(file)
}

/// Reads a whole file, if memory suffices; the error names the file.
pub fn read(path: &Path) -> Result<Vec<u8>> {
    read_at_most(path, u64::MAX, 1)
}

/// Reads a file of at most `most` bytes, each of which takes `share` bytes of memory after parsing.
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
    // Some system files report a size of zero but have content.
    let most = size.max(SMALL);
    file.take(most + 1).read_to_end(&mut bytes).map_err(Error::io(path))?;
    if bytes.len() as u64 > most {
        let what = format!("gives more than the {size} bytes that it announces");
        return Err(Error::format(path, what));
    }
    Ok(bytes)
}

/// Unpacked size in bytes that is accepted for a compressed file of any size.
const UNPACKED: u64 = 64 << 20;
/// Maximum ratio of unpacked to packed size above that; deflate's maximum is 1032.
const UNPACKED_SHARE: u64 = 1100;

/// Checks that a file of `packed` bytes can unpack to the size in its header, before memory is
/// allocated, so that a damaged header cannot exhaust the memory.
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
