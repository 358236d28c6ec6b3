//! Buffers, memory and images that belong to a host.

use super::buffer::{Memory, RawBuffer};
use super::device::{Context, OnDrop};
use super::vk_error;
use crate::error::{Error, Result};
use ash::vk;
use ash::vk::Handle;
use std::sync::Arc;

/// The usages that a buffer for kernels must have been created with.
const USAGE: [(vk::BufferUsageFlags, &str); 3] = [
    (vk::BufferUsageFlags::STORAGE_BUFFER, "STORAGE_BUFFER"),
    (vk::BufferUsageFlags::TRANSFER_SRC, "TRANSFER_SRC"),
    (vk::BufferUsageFlags::TRANSFER_DST, "TRANSFER_DST"),
];

/// A part of a host's buffer, as the host describes it.
#[derive(Clone, Copy, Debug)]
pub struct HostBuffer {
    /// The buffer.
    pub buffer: vk::Buffer,
    /// First byte of the part.
    pub offset: u64,
    /// Bytes of the part.
    pub bytes: u64,
    /// The usage that the whole buffer was created with.
    pub usage: vk::BufferUsageFlags,
}

/// A host's image as the destination of a copy.
#[derive(Clone, Copy, Debug)]
pub struct HostImage {
    /// The image, created with `TRANSFER_DST` and one sample. Its format is `R32G32B32A32_SFLOAT`
    /// for colour, `R32_SFLOAT` for depth and mask, or a texel format of `ops::texel`.
    pub image: vk::Image,
    /// The layout of the image before and after the copy: `TRANSFER_DST_OPTIMAL` or `GENERAL`.
    pub layout: vk::ImageLayout,
    /// Mip level to write.
    pub mip_level: u32,
    /// Array layer to write.
    pub array_layer: u32,
    /// Left and upper edge of the destination rectangle, pixels.
    pub offset: [u32; 2],
}

impl RawBuffer {
    /// A part of a host's buffer.
    pub(crate) fn adopt(
        context: &Arc<Context>,
        host: &HostBuffer,
        label: &str,
        on_drop: Option<OnDrop>,
    ) -> Result<RawBuffer> {
        let wrong = |what: String| Error::Input(format!("the host's buffer for {label}: {what}"));
        if host.buffer.is_null() {
            return Err(wrong("the handle is null".into()));
        }
        let lacking: Vec<_> = USAGE
            .iter()
            .filter(|(flag, _)| !host.usage.contains(*flag))
            .map(|(_, name)| *name)
            .collect();
        if !lacking.is_empty() {
            return Err(wrong(format!("it was made without the usage {}", lacking.join(", "))));
        }
        let alignment = context.limits.storage_alignment;
        if !host.offset.is_multiple_of(alignment) {
            let offset = host.offset;
            return Err(wrong(format!("offset {offset} is not a multiple of {alignment} bytes")));
        }
        if host.bytes == 0 || !host.bytes.is_multiple_of(4) {
            return Err(wrong(format!("{} bytes: it must be whole words, and some", host.bytes)));
        }
        // SAFETY: not null; the caller of `Buffer::adopt` guarantees a buffer of this device.
        let most = unsafe { context.raw.get_buffer_memory_requirements(host.buffer) }.size;
        if host.offset.checked_add(host.bytes).is_none_or(|end| end > most) {
            return Err(wrong(format!(
                "{} bytes from byte {} on: the whole has {most} at most",
                host.bytes, host.offset
            )));
        }
        Ok(RawBuffer {
            raw: host.buffer,
            memory: Memory::Host(on_drop),
            start: host.offset,
            bytes: host.bytes,
            usage: host.usage,
            label: label.into(),
            context: context.clone(),
            ledger: context.ledger.clone(),
        })
    }
}

/// Memory that another Vulkan device, process or API has exported as an opaque file descriptor
/// (`VK_EXTERNAL_MEMORY_HANDLE_TYPE_OPAQUE_FD_BIT`).
#[cfg(unix)]
#[derive(Debug)]
pub struct ImportedMemory {
    /// The descriptor. Vulkan owns it after a successful import; after a failure it is closed.
    pub fd: std::os::fd::OwnedFd,
    /// Size of the exported allocation, bytes.
    pub allocation_bytes: u64,
    /// Memory type that it was allocated from.
    pub memory_type: u32,
    /// First byte of the part to use.
    pub offset: u64,
}

#[cfg(unix)]
impl ImportedMemory {
    /// Whether it can hold a buffer; an error says why not.
    fn check(&self, needs: &vk::MemoryRequirements) -> std::result::Result<(), String> {
        // The mask of memory types has 32 bits.
        if self.memory_type >= 32 {
            return Err(format!("memory type {} does not exist", self.memory_type));
        }
        if needs.memory_type_bits & 1 << self.memory_type == 0 {
            return Err(format!("memory type {} holds no buffers", self.memory_type));
        }
        if !self.offset.is_multiple_of(needs.alignment) {
            let (offset, alignment) = (self.offset, needs.alignment);
            return Err(format!("offset {offset} is not a multiple of {alignment} bytes"));
        }
        if self.offset.checked_add(needs.size).is_none_or(|end| end > self.allocation_bytes) {
            return Err(format!(
                "{} bytes from byte {} on: the allocation has {}",
                needs.size, self.offset, self.allocation_bytes
            ));
        }
        Ok(())
    }
}

#[cfg(unix)]
impl RawBuffer {
    /// A buffer of `bytes` in imported memory.
    pub(crate) fn import(
        context: &Arc<Context>,
        memory: ImportedMemory,
        bytes: u64,
        label: &str,
    ) -> Result<RawBuffer> {
        use std::os::fd::{AsRawFd, IntoRawFd};

        if !context.imports_fd {
            return Err(Error::Unsupported {
                kernel: format!("importing memory for {label}"),
                missing: format!(
                    "{} has no VK_KHR_external_memory_fd, or the host has not enabled it",
                    context.info.name
                ),
            });
        }
        let wrong = |what: String| Error::Input(format!("imported memory for {label}: {what}"));
        if bytes == 0 || !bytes.is_multiple_of(4) {
            return Err(wrong(format!("{bytes} bytes: it must be whole words, and some")));
        }
        let device = &context.raw;
        let usage =
            USAGE.iter().fold(vk::BufferUsageFlags::INDIRECT_BUFFER, |all, (f, _)| all | *f);
        let kind = vk::ExternalMemoryHandleTypeFlags::OPAQUE_FD;
        let mut external = vk::ExternalMemoryBufferCreateInfo::default().handle_types(kind);
        let info = vk::BufferCreateInfo::default()
            .size(bytes)
            .usage(usage)
            .sharing_mode(vk::SharingMode::EXCLUSIVE)
            .push_next(&mut external);
        // SAFETY: the device is alive, and the info points at locals.
        let raw =
            unsafe { device.create_buffer(&info, None) }.map_err(vk_error("vkCreateBuffer"))?;
        // Filled step by step, so that `drop` cleans up whatever an early return leaves.
        let mut buffer = RawBuffer {
            raw,
            memory: Memory::Imported(vk::DeviceMemory::null()),
            start: 0,
            bytes,
            usage,
            label: label.into(),
            context: context.clone(),
            ledger: context.ledger.clone(),
        };
        // SAFETY: just created.
        let needs = unsafe { device.get_buffer_memory_requirements(raw) };
        memory.check(&needs).map_err(wrong)?;
        let mut import =
            vk::ImportMemoryFdInfoKHR::default().handle_type(kind).fd(memory.fd.as_raw_fd());
        let info = vk::MemoryAllocateInfo::default()
            .allocation_size(memory.allocation_bytes)
            .memory_type_index(memory.memory_type)
            .push_next(&mut import);
        // SAFETY: the descriptor is open; the caller of `Buffer::import_fd` guarantees that it
        // exports such an allocation.
        let imported = unsafe { device.allocate_memory(&info, None) }
            .map_err(vk_error("vkAllocateMemory (import)"))?;
        // Vulkan has taken the descriptor over.
        let _ = memory.fd.into_raw_fd();
        buffer.memory = Memory::Imported(imported);
        // SAFETY: offset, size and type were checked.
        unsafe { device.bind_buffer_memory(raw, imported, memory.offset) }
            .map_err(vk_error("vkBindBufferMemory"))?;
        Ok(buffer)
    }
}
