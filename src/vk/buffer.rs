//! Buffers and their memory.

use super::device::Context;
use super::vk_error;
use crate::error::{Error, Result};
use ash::vk;
use gpu_allocator::MemoryLocation;
use gpu_allocator::vulkan::{Allocation, AllocationCreateDesc, AllocationScheme};
use std::sync::{Arc, Mutex};

/// Where a buffer's memory lies.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum Residence {
    /// For kernels.
    Device,
    /// Written by the host, copied from by the device.
    Upload,
    /// Copied to by the device, read by the host.
    Readback,
}

/// A buffer with its memory.
pub(crate) struct RawBuffer {
    pub(super) raw: vk::Buffer,
    /// Only `drop` takes it; the mutex lets the host map through a shared reference.
    allocation: Mutex<Option<Allocation>>,
    pub(crate) bytes: u64,
    pub(crate) label: String,
    context: Arc<Context>,
}

impl RawBuffer {
    /// A buffer of at least `bytes`; a length of zero is legal and gets a few bytes that no kernel
    /// may count on.
    pub(crate) fn new(
        context: &Arc<Context>,
        bytes: u64,
        residence: Residence,
        label: &str,
    ) -> Result<RawBuffer> {
        let bytes = bytes.max(16).next_multiple_of(16);
        let usage = match residence {
            Residence::Device => {
                vk::BufferUsageFlags::STORAGE_BUFFER
                    | vk::BufferUsageFlags::INDIRECT_BUFFER
                    | vk::BufferUsageFlags::TRANSFER_SRC
                    | vk::BufferUsageFlags::TRANSFER_DST
            }
            Residence::Upload => vk::BufferUsageFlags::TRANSFER_SRC,
            Residence::Readback => vk::BufferUsageFlags::TRANSFER_DST,
        };
        let info = vk::BufferCreateInfo::default()
            .size(bytes)
            .usage(usage)
            .sharing_mode(vk::SharingMode::EXCLUSIVE);
        let out_of_memory = || Error::OutOfMemory { label: label.into(), bytes };
        // SAFETY: the context's device is alive.
        let raw =
            unsafe { context.raw.create_buffer(&info, None) }.map_err(|result| match result {
                vk::Result::ERROR_OUT_OF_DEVICE_MEMORY | vk::Result::ERROR_OUT_OF_HOST_MEMORY => {
                    out_of_memory()
                }
                other => vk_error("vkCreateBuffer")(other),
            })?;
        // SAFETY: just created.
        let requirements = unsafe { context.raw.get_buffer_memory_requirements(raw) };
        let allocation =
            context.allocator.lock().expect("no holder panics").allocate(&AllocationCreateDesc {
                name: label,
                requirements,
                location: match residence {
                    Residence::Device => MemoryLocation::GpuOnly,
                    Residence::Upload => MemoryLocation::CpuToGpu,
                    Residence::Readback => MemoryLocation::GpuToCpu,
                },
                linear: true,
                allocation_scheme: AllocationScheme::GpuAllocatorManaged,
            });
        let Ok(allocation) = allocation else {
            // SAFETY: just created, never used.
            unsafe { context.raw.destroy_buffer(raw, None) };
            return Err(out_of_memory());
        };
        // SAFETY: the allocation was made for this buffer's requirements.
        let bound = unsafe {
            context.raw.bind_buffer_memory(raw, allocation.memory(), allocation.offset())
        };
        context.count_allocation(bytes);
        let buffer = RawBuffer {
            raw,
            allocation: Mutex::new(Some(allocation)),
            bytes,
            label: label.into(),
            context: context.clone(),
        };
        bound.map_err(vk_error("vkBindBufferMemory"))?;
        Ok(buffer)
    }

    /// A number that no other living buffer has.
    pub(crate) fn id(&self) -> u64 {
        ash::vk::Handle::as_raw(self.raw)
    }

    /// Copies host memory into an upload buffer.
    pub(crate) fn write(&self, bytes: &[u8]) {
        let mut guard = self.allocation.lock().expect("no holder panics");
        let slice = guard.as_mut().and_then(Allocation::mapped_slice_mut);
        slice.expect("upload buffers are mapped")[..bytes.len()].copy_from_slice(bytes);
    }

    /// Copies a readback buffer into host memory.
    pub(crate) fn read(&self, bytes: &mut [u8]) {
        let guard = self.allocation.lock().expect("no holder panics");
        let slice = guard.as_ref().and_then(Allocation::mapped_slice);
        bytes.copy_from_slice(&slice.expect("readback buffers are mapped")[..bytes.len()]);
    }
}

impl Drop for RawBuffer {
    fn drop(&mut self) {
        // SAFETY: submissions in flight hold an `Arc` of every buffer they use, so nothing does.
        unsafe { self.context.raw.destroy_buffer(self.raw, None) };
        let allocation = self.allocation.get_mut().ok().and_then(Option::take);
        if let (Some(allocation), Ok(mut allocator)) = (allocation, self.context.allocator.lock()) {
            // The allocator only refuses allocations that are not its own.
            let _ = allocator.free(allocation);
        }
        self.context.count_free(self.bytes);
    }
}
