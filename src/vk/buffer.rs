//! Vulkan buffers and their memory.

use super::device::{Context, OnDrop};
use super::ledger::Ledger;
use super::vk_error;
use crate::error::{Error, Result};
use ash::vk;
use gpu_allocator::MemoryLocation;
use gpu_allocator::vulkan::{Allocation, AllocationCreateDesc, AllocationScheme};
use std::sync::{Arc, Mutex};

/// The kind of memory of a buffer.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum Residence {
    /// Device memory, used by kernels.
    Device,
    /// Host-visible memory that the host writes and the device copies from.
    Upload,
    /// Host-visible memory that the device copies to and the host reads.
    Readback,
}

/// A buffer with its memory.
pub(crate) struct RawBuffer {
    pub(super) raw: vk::Buffer,
    pub(super) memory: Memory,
    /// Byte offset in `raw`: a host may lend a part of its buffer.
    pub(crate) start: u64,
    pub(crate) bytes: u64,
    pub(super) usage: vk::BufferUsageFlags,
    pub(crate) label: String,
    pub(super) context: Arc<Context>,
    /// The ledger that counts the buffer, if any.
    pub(super) ledger: Arc<Ledger>,
}

/// The owner of a buffer's memory.
pub(super) enum Memory {
    /// Memory of the allocator. Only `drop` takes it out; the mutex allows mapping through a shared
    /// reference.
    Ours(Mutex<Option<Allocation>>),
    /// Buffer and memory belong to a host.
    Host(#[allow(dead_code, reason = "called when it is dropped")] Option<OnDrop>),
    /// No memory: a rehearsal only counts the buffer.
    Imagined,
    /// Memory imported for this buffer alone.
    #[cfg(unix)]
    Imported(vk::DeviceMemory),
}

impl Residence {
    fn usage(self) -> vk::BufferUsageFlags {
        match self {
            Residence::Device => {
                vk::BufferUsageFlags::STORAGE_BUFFER
                    | vk::BufferUsageFlags::INDIRECT_BUFFER
                    | vk::BufferUsageFlags::TRANSFER_SRC
                    | vk::BufferUsageFlags::TRANSFER_DST
            }
            Residence::Upload => vk::BufferUsageFlags::TRANSFER_SRC,
            Residence::Readback => vk::BufferUsageFlags::TRANSFER_DST,
        }
    }
}

/// The size in bytes of a buffer of at least `bytes` bytes: a multiple of 16, not zero.
fn whole(bytes: u64) -> u64 {
    bytes.max(16).next_multiple_of(16)
}

impl RawBuffer {
    /// A buffer of at least `bytes` bytes. A length of zero is legal and gets padding that no
    /// kernel may rely on.
    pub(crate) fn new(
        context: &Arc<Context>,
        bytes: u64,
        residence: Residence,
        label: &str,
    ) -> Result<RawBuffer> {
        let bytes = whole(bytes);
        let usage = residence.usage();
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
        context.count_object();
        context.ledger.add(bytes, label);
        let buffer = RawBuffer {
            raw,
            memory: Memory::Ours(Mutex::new(Some(allocation))),
            start: 0,
            bytes,
            usage,
            label: label.into(),
            context: context.clone(),
            ledger: context.ledger.clone(),
        };
        bound.map_err(vk_error("vkBindBufferMemory"))?;
        Ok(buffer)
    }

    /// A buffer without memory that is only counted in a ledger.
    pub(crate) fn imagined(
        context: &Arc<Context>,
        ledger: &Arc<Ledger>,
        bytes: u64,
        residence: Residence,
        label: &str,
    ) -> RawBuffer {
        let bytes = whole(bytes);
        ledger.add(bytes, label);
        RawBuffer {
            raw: vk::Buffer::null(),
            memory: Memory::Imagined,
            start: 0,
            bytes,
            usage: residence.usage(),
            label: label.into(),
            context: context.clone(),
            ledger: ledger.clone(),
        }
    }

    /// An identifier, unique among live buffers; 0 for buffers without memory.
    pub(crate) fn id(&self) -> u64 {
        ash::vk::Handle::as_raw(self.raw)
    }

    /// The handle, for a host's own commands.
    pub(crate) fn handle(&self) -> vk::Buffer {
        self.raw
    }

    /// The ledger of the device that the buffer was created on.
    pub(crate) fn ledger(&self) -> &Arc<Ledger> {
        &self.ledger
    }

    /// The usage that the buffer was created with.
    pub(crate) fn usage(&self) -> vk::BufferUsageFlags {
        self.usage
    }

    /// Whether the buffer may hold the arguments of indirect dispatches.
    pub(crate) fn is_indirect(&self) -> bool {
        self.usage.contains(vk::BufferUsageFlags::INDIRECT_BUFFER)
    }

    fn mapped(&self) -> std::sync::MutexGuard<'_, Option<Allocation>> {
        match &self.memory {
            Memory::Ours(allocation) => allocation.lock().expect("no holder panics"),
            _ => unreachable!("only buffers of ours are uploaded from and read back"),
        }
    }

    /// Copies host memory into an upload buffer.
    pub(crate) fn write(&self, bytes: &[u8]) {
        if matches!(self.memory, Memory::Imagined) {
            return;
        }
        let mut guard = self.mapped();
        let slice = guard.as_mut().and_then(Allocation::mapped_slice_mut);
        slice.expect("upload buffers are mapped")[..bytes.len()].copy_from_slice(bytes);
    }

    /// Copies a readback buffer into host memory; a buffer without memory leaves `data` unchanged.
    pub(crate) fn read(&self, bytes: &mut [u8]) {
        if matches!(self.memory, Memory::Imagined) {
            return;
        }
        let guard = self.mapped();
        let slice = guard.as_ref().and_then(Allocation::mapped_slice);
        bytes.copy_from_slice(&slice.expect("readback buffers are mapped")[..bytes.len()]);
    }
}

impl Drop for RawBuffer {
    fn drop(&mut self) {
        let device = &self.context.raw;
        match &mut self.memory {
            Memory::Ours(allocation) => {
                // SAFETY: submissions in flight hold an `Arc` of every buffer that they use, and
                // hosts keep the guards of their recordings, so no commands use the buffer.
                unsafe { device.destroy_buffer(self.raw, None) };
                let allocation = allocation.get_mut().ok().and_then(Option::take);
                if let (Some(allocation), Ok(mut allocator)) =
                    (allocation, self.context.allocator.lock())
                {
                    // The allocator only refuses allocations that are not its own.
                    let _ = allocator.free(allocation);
                }
                self.ledger.remove(self.bytes);
            }
            Memory::Imagined => self.ledger.remove(self.bytes),
            // Dropping the callback calls it.
            Memory::Host(_) => {}
            #[cfg(unix)]
            Memory::Imported(memory) => {
                // SAFETY: as above; the memory was allocated for this buffer.
                unsafe {
                    device.destroy_buffer(self.raw, None);
                    device.free_memory(*memory, None);
                }
            }
        }
    }
}
