//! The pipeline cache on disk. A damaged file is ignored and rewritten.

use std::fs;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::path::PathBuf;

const MAGIC: &[u8; 8] = b"s4dcache";

/// A file in the user's cache folder, for one driver and device.
pub(super) struct CacheFile {
    path: PathBuf,
    loaded: Vec<u8>,
}

impl CacheFile {
    /// Reads the file of a device; `None` if the user has no cache folder.
    pub(super) fn of(uuid: &[u8]) -> Option<CacheFile> {
        let name: String = uuid.iter().map(|byte| format!("{byte:02x}")).collect();
        let path = cache_folder()?.join(format!("{name}.pipelines"));
        // Reading a pipe at this path would block.
        let bytes = if path.is_file() { fs::read(&path).unwrap_or_default() } else { Vec::new() };
        let loaded = unwrap(&bytes).map(<[u8]>::to_vec).unwrap_or_default();
        Some(CacheFile { path, loaded })
    }

    /// The content of the file when it was read.
    pub(super) fn loaded(&self) -> &[u8] {
        &self.loaded
    }

    /// Writes the file by rename, if the data has changed.
    pub(super) fn write(&self, data: &[u8]) {
        if data == self.loaded {
            return;
        }
        let Some(folder) = self.path.parent() else { return };
        // Errors are ignored: without the cache the next start compiles again.
        let write = || -> std::io::Result<()> {
            fs::create_dir_all(folder)?;
            let temporary = tempfile::NamedTempFile::new_in(folder)?;
            fs::write(temporary.path(), wrap(data))?;
            temporary.persist(&self.path).map_err(|e| e.error)?;
            Ok(())
        };
        let _ = write();
    }
}

fn cache_folder() -> Option<PathBuf> {
    let base = std::env::var_os("XDG_CACHE_HOME")
        .map(PathBuf::from)
        .filter(|path| path.is_absolute())
        .or_else(|| std::env::var_os("HOME").map(|home| PathBuf::from(home).join(".cache")))?;
    Some(base.join("splat4d"))
}

fn checksum(data: &[u8]) -> [u8; 8] {
    let mut hasher = DefaultHasher::new();
    data.hash(&mut hasher);
    hasher.finish().to_le_bytes()
}

fn wrap(data: &[u8]) -> Vec<u8> {
    [MAGIC.as_slice(), &checksum(data), data].concat()
}

fn unwrap(bytes: &[u8]) -> Option<&[u8]> {
    let rest = bytes.strip_prefix(MAGIC)?;
    let (sum, data) = rest.split_at_checked(8)?;
    (sum == checksum(data)).then_some(data)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_damaged_file_is_ignored() {
        let whole = wrap(b"pipelines");
        assert_eq!(unwrap(&whole), Some(b"pipelines".as_slice()));
        for cut in 0..whole.len() {
            assert_eq!(unwrap(&whole[..cut]), None, "cut at {cut}");
        }
        for at in 0..whole.len() {
            let mut damaged = whole.clone();
            damaged[at] ^= 1;
            assert_eq!(unwrap(&damaged), None, "damaged at {at}");
        }
    }
}
