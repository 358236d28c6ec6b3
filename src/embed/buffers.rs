//! Buffers, memory and images of the host.

use crate::gpu::{Buffer, Device, Recorder, View};
#[cfg(unix)]
use crate::vk::ImportedMemory;
use crate::vk::{HostBuffer, HostImage, OnDrop, RawBuffer};
use crate::{Error, Result};
use ash::vk;
use bytemuck::Pod;

impl<T: Pod> Buffer<T> {
    /// A typed buffer over a part of a host's buffer; its length is the size of the part in
    /// elements. The host keeps the ownership. `on_drop` is called when no object of the engine
    /// uses the buffer any more, and also if this function fails.
    ///
    /// # Errors
    /// [`Error::Input`] for a null handle, a part that ends beyond the buffer's memory requirement,
    /// an offset that violates
    /// ([`Limits::storage_alignment`](crate::gpu::Limits::storage_alignment)), a size that is no
    /// multiple of the element size, or a usage without storage and transfers.
    ///
    /// # Safety
    /// - The buffer belongs to this device, has the size and the usage that `host` states, and is
    ///   bound to memory.
    /// - The queue family of the device owns it, or its sharing mode is concurrent.
    /// - It stays alive and bound until `on_drop` is called. Without `on_drop`, it stays so until
    ///   the `Buffer` is dropped and all recorded work that uses it is done.
    /// - Other code accesses it only in order with the engine's work: on the same queue before or
    ///   after a recording, or synchronised by a semaphore.
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

    /// A buffer of `len` elements in memory that another device, process or API has exported.
    ///
    /// # Errors
    /// [`Error::Unsupported`] without `VK_KHR_external_memory_fd`; [`Error::Input`] for a part
    /// outside the allocation, or a memory type that cannot hold the buffer; or a failed Vulkan
    /// call.
    ///
    /// # Safety
    /// - The descriptor is an opaque export of the described allocation, which is not dedicated to
    ///   one buffer or image and comes from the same physical device and driver.
    /// - Other code accesses the memory only in order with the engine's work.
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

    /// The Vulkan handle, offset and size, for a host's own commands. Keep the `Buffer` alive until
    /// these are done, and order them with the engine's work.
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

/// The number of elements in `bytes` bytes; elements must consist of whole 32-bit words.
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
    /// Copies `width` × `height` texels, row-major without padding, into a rectangle of a host's
    /// image.
    ///
    /// # Errors
    /// [`Error::Shape`] where the view is too short; [`Error::Input`] for a null handle or a layout
    /// that a copy cannot write.
    ///
    /// # Safety
    /// - The image belongs to this device and was created with `TRANSFER_DST`. It contains the
    ///   rectangle, its texel is as large as an element `T`, and it is in the layout of `image`
    ///   when the commands run.
    /// - It stays alive until the commands are done.
    /// - If a [`Stream`](crate::gpu::Stream) submits the recording, semaphores order the host's
    ///   other uses of the image.
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
