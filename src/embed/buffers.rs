//! The host's memory.

use crate::gpu::{Buffer, Device, Recorder, View};
#[cfg(unix)]
use crate::vk::ImportedMemory;
use crate::vk::{HostBuffer, HostImage, OnDrop, RawBuffer};
use crate::{Error, Result};
use ash::vk;
use bytemuck::Pod;

impl<T: Pod> Buffer<T> {
    /// A part of a host's buffer, as many elements as fit. It stays the host's; `on_drop` is called
    /// when nothing of the engine's uses it any more, also where this fails.
    ///
    /// # Errors
    /// [`Error::Input`] for a null handle, a part that reaches past the end as far as Vulkan tells,
    /// an offset that the device does not bind
    /// ([`Limits::storage_alignment`](crate::gpu::Limits::storage_alignment)), or a usage without
    /// storage and transfers.
    ///
    /// # Safety
    /// - The buffer is of this device, as long and made for what `host` says, and bound to memory.
    /// - It belongs to the family of the device's queue, or is shared concurrently.
    /// - It stays alive and bound until `on_drop` is called, or without it until the `Buffer` is
    ///   dropped and everything recorded with it is done.
    /// - Others read and write it only in order with the engine's work: in the same queue before or
    ///   after a recording, or behind a semaphore.
    pub unsafe fn adopt(
        device: &Device,
        label: &str,
        host: HostBuffer,
        on_drop: Option<Box<dyn FnOnce() + Send + Sync>>,
    ) -> Result<Buffer<T>> {
        let on_drop = on_drop.map(|call| OnDrop(Some(call)));
        let len = element_count::<T>(label, host.bytes)?;
        let raw = RawBuffer::adopt(&device.inner.context, &host, label, on_drop)?;
        Ok(Buffer::of_raw(raw, len))
    }

    /// `len` elements in memory that another device, process or API has exported.
    ///
    /// # Errors
    /// [`Error::Unsupported`] without `VK_KHR_external_memory_fd`; [`Error::Input`] for a part that
    /// the allocation does not hold, or a memory type without buffers; a failed Vulkan call.
    ///
    /// # Safety
    /// - The descriptor is that of an opaque export of such an allocation, not dedicated to one
    ///   buffer or image, from the same physical device and driver.
    /// - Others read and write the memory only in order with the engine's work.
    #[cfg(unix)]
    pub unsafe fn import_fd(
        device: &Device,
        label: &str,
        memory: ImportedMemory,
        len: usize,
    ) -> Result<Buffer<T>> {
        let bytes = (len * size_of::<T>()) as u64;
        element_count::<T>(label, bytes)?;
        let raw = RawBuffer::import(&device.inner.context, memory, bytes, label)?;
        Ok(Buffer::of_raw(raw, len))
    }

    /// Where it lies, for a host's own commands. Keep the `Buffer` until these are done, and order
    /// them with the engine's work.
    pub fn handle(&self) -> HostBuffer {
        let raw = self.raw();
        HostBuffer {
            buffer: raw.handle(),
            offset: raw.start,
            bytes: (self.len() * size_of::<T>()) as u64,
            usage: raw.usage(),
        }
    }
}

/// Elements of whole words in so many bytes.
fn element_count<T>(label: &str, bytes: u64) -> Result<usize> {
    let element = size_of::<T>();
    if element == 0 || !element.is_multiple_of(4) || !bytes.is_multiple_of(element as u64) {
        return Err(Error::Input(format!(
            "the host's buffer for {label}: {bytes} bytes do not hold whole elements of {element}"
        )));
    }
    usize::try_from(bytes / element as u64)
        .map_err(|_| Error::Input(format!("the host's buffer for {label}: {bytes} bytes")))
}

impl Recorder {
    /// Copies a picture of `width` × `height`, row by row, into a part of a host's image.
    ///
    /// # Errors
    /// [`Error::Shape`] where the view is too short; [`Error::Input`] for a null handle or a layout
    /// that no copy writes.
    ///
    /// # Safety
    /// - The image is of this device, in the layout that `image` says when the commands run, large
    ///   enough, with a texel as large as an element, and made with `TRANSFER_DST`.
    /// - It stays alive until the commands are done.
    /// - In a recording of its own stream, the host orders other uses of the image by semaphores.
    pub unsafe fn copy_to_image<T: Pod>(
        &mut self,
        from: View<'_, T>,
        image: &HostImage,
        width: u32,
        height: u32,
    ) -> Result<()> {
        let needed = width as usize * height as usize;
        if from.len() < needed {
            let (expected, actual) = (format!("at least {needed}"), from.len());
            return Err(Error::Shape { op: "copy to image", arg: "from", expected, actual });
        }
        if vk::Handle::is_null(image.image) {
            return Err(Error::Input("the host's image is a null handle".into()));
        }
        if ![vk::ImageLayout::TRANSFER_DST_OPTIMAL, vk::ImageLayout::GENERAL]
            .contains(&image.layout)
        {
            return Err(Error::Input(format!(
                "the host's image is in layout {:?}: a copy writes TRANSFER_DST_OPTIMAL or GENERAL",
                image.layout
            )));
        }
        if needed > 0 {
            self.copy_picture(&from.bound(), image, [width, height]);
        }
        Ok(())
    }
}
