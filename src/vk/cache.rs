//! The pipeline cache: in memory, and for the engine's own devices also on disk (feature `files`).

use ash::vk;

/// A pipeline cache, filled from a file when a device opens and written to it when it closes.
pub(super) struct PipelineCache {
    pub(super) raw: vk::PipelineCache,
    #[cfg(feature = "files")]
    file: Option<super::cache_file::CacheFile>,
}

impl PipelineCache {
    /// The cache of a device that the engine created. It is not stored if the user has no cache
    /// folder.
    pub(super) fn open(device: &ash::Device, properties: &vk::PhysicalDeviceProperties) -> Self {
        #[cfg(feature = "files")]
        {
            let file = super::cache_file::CacheFile::of(&properties.pipeline_cache_uuid);
            let loaded = file.as_ref().map_or(&[][..], |file| file.loaded());
            let raw = create(device, loaded).or_else(|| create(device, &[])).unwrap_or_default();
            PipelineCache { raw, file }
        }
        #[cfg(not(feature = "files"))]
        {
            let _ = properties;
            PipelineCache::in_memory(device)
        }
    }

    /// A cache without a file, for a host's device: the engine writes no files on behalf of a host.
    pub(super) fn in_memory(device: &ash::Device) -> Self {
        PipelineCache {
            raw: create(device, &[]).unwrap_or_default(),
            #[cfg(feature = "files")]
            file: None,
        }
    }

    /// Writes the cache to its file and destroys it.
    ///
    /// # Safety
    /// The device is the one it was opened with, and no pipeline is being created.
    pub(super) unsafe fn close(&mut self, device: &ash::Device) {
        #[cfg(feature = "files")]
        if let Some(file) = &self.file {
            // SAFETY: guaranteed by the caller.
            file.write(&unsafe { device.get_pipeline_cache_data(self.raw) }.unwrap_or_default());
        }
        // SAFETY: guaranteed by the caller.
        unsafe { device.destroy_pipeline_cache(self.raw, None) };
    }
}

fn create(device: &ash::Device, data: &[u8]) -> Option<vk::PipelineCache> {
    let info = vk::PipelineCacheCreateInfo::default().initial_data(data);
    // SAFETY: the driver checks the header of the data; the cache file's checksum has shown that no
    // byte changed since the driver wrote it.
    unsafe { device.create_pipeline_cache(&info, None) }.ok()
}
