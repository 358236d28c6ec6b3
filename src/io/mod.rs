//! What every reader and writer of files needs: whole-file reads with the path in the error, writes
//! by rename, a bounds-checked cursor over bytes, the PLY container, files of state, and how much
//! memory there is.

mod bytes;
mod memory;
pub mod ply;
mod state;
mod write;

pub use bytes::Bytes;
pub use memory::{available_memory, check_memory};
pub use state::{Identity, checksum, read_state, write_state};
pub use write::{Sink, follow_links, write_atomically, write_json};

use std::path::Path;

use crate::error::excerpt;
use crate::{Error, Result};

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
        .map_err(|e| Error::format(path, format!("is not valid JSON: {}", excerpt(&e.to_string()))))
}
