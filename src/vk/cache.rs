//! The pipeline cache on disk. A damaged file is ignored and rewritten.

use ash::vk;
use std::fs;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::path::PathBuf;

const MAGIC: &[u8; 8] = b"s4dcache";

/// A pipeline cache that is read when a device opens and written when it closes.
pub(super) struct PipelineCache {
    pub(super) raw: vk::PipelineCache,
    /// None where the user has no cache folder: then nothing is kept.
    file: Option<PathBuf>,
    loaded: Vec<u8>,
}

impl PipelineCache {
    pub(super) fn open(device: &ash::Device, properties: &vk::PhysicalDeviceProperties) -> Self {
        let uuid: String =
            properties.pipeline_cache_uuid.iter().map(|byte| format!("{byte:02x}")).collect();
        let file = cache_folder().map(|folder| folder.join(format!("{uuid}.pipelines")));
        let loaded = file
            .as_ref()
            .and_then(|path| fs::read(path).ok())
            .and_then(|bytes| unwrap(&bytes).map(<[u8]>::to_vec))
            .unwrap_or_default();
        let raw = create(device, &loaded).or_else(|| create(device, &[])).unwrap_or_default();
        PipelineCache { raw, file, loaded }
    }

    /// Writes what was added and destroys the cache.
    ///
    /// # Safety
    /// The device is the one it was opened with, and no pipeline is being created.
    pub(super) unsafe fn close(&mut self, device: &ash::Device) {
        // SAFETY: by the caller's promise.
        let data = unsafe { device.get_pipeline_cache_data(self.raw) }.unwrap_or_default();
        if let Some(path) = &self.file
            && data != self.loaded
            && let Some(folder) = path.parent()
        {
            // The cache only saves time: where it cannot be written, the next start compiles again.
            let write = || -> std::io::Result<()> {
                fs::create_dir_all(folder)?;
                let temporary = tempfile::NamedTempFile::new_in(folder)?;
                fs::write(temporary.path(), wrap(&data))?;
                temporary.persist(path).map_err(|e| e.error)?;
                Ok(())
            };
            let _ = write();
        }
        // SAFETY: by the caller's promise.
        unsafe { device.destroy_pipeline_cache(self.raw, None) };
    }
}

fn create(device: &ash::Device, data: &[u8]) -> Option<vk::PipelineCache> {
    let info = vk::PipelineCacheCreateInfo::default().initial_data(data);
    // SAFETY: the driver checks the data's header; ours has checked that no byte changed since the
    // driver wrote it.
    unsafe { device.create_pipeline_cache(&info, None) }.ok()
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
