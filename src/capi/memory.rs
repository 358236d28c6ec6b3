//! Device memory: the engine's own, and adopted from the host.

use super::call::{
    Outcome, call, claim, destroy, exclusive, give, grows, input, read, shared, splat4d_result,
};
use super::device::{Told, device_of, splat4d_callback, splat4d_device};
use super::vulkan::VkBuffer;
use crate::embed::HostBuffer;
use crate::embed::ash::vk;
use crate::gpu::Buffer;
use bytemuck::Pod;
use std::ffi::c_void;

/// A device buffer of 32-bit words.
pub struct splat4d_buffer {
    pub(super) words: Buffer<u32>,
}

/// A part of a VkBuffer; if absent, buffer is null and bytes is 0.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct splat4d_range {
    /// The buffer.
    pub buffer: VkBuffer,
    /// First byte.
    pub offset: u64,
    /// Bytes.
    pub bytes: u64,
}

/// A part of a host's buffer, to adopt.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct splat4d_host_buffer {
    /// sizeof(splat4d_host_buffer).
    pub struct_size: usize,
    /// The buffer; it must belong to the device and be bound to memory.
    pub buffer: VkBuffer,
    /// First byte of the part; a multiple of splat4d_device_info.storage_alignment.
    pub offset: u64,
    /// Bytes of the part, a multiple of 4.
    pub bytes: u64,
    /// VkBufferUsageFlags that the whole buffer was created with; at least STORAGE_BUFFER,
    /// TRANSFER_SRC and TRANSFER_DST.
    pub usage: u32,
    /// Called once when no object of the engine uses the buffer any more. It is also called if
    /// splat4d_buffer_adopt fails, except with SPLAT4D_ERROR_POINTER or SPLAT4D_ERROR_STRUCT_SIZE.
    pub on_drop: splat4d_callback,
    /// Given to on_drop.
    pub on_drop_user: *mut c_void,
}
grows!(splat4d_host_buffer, on_drop_user: *mut c_void);

/// Creates a buffer of `bytes` bytes (a multiple of 4, above 0) with undefined content. `buffer`
/// gets a handle, to be destroyed.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_buffer_create(
    device: *const splat4d_device,
    bytes: u64,
    buffer: *mut *mut splat4d_buffer,
) -> splat4d_result {
    // SAFETY: guaranteed by the host.
    call(|| unsafe {
        claim("buffer", buffer)?;
        let device = device_of(device)?;
        let words = match usize::try_from(bytes) {
            Ok(bytes) if bytes > 0 && bytes.is_multiple_of(4) => bytes / 4,
            _ => return Err(input(format!("a buffer of {bytes} bytes: a multiple of 4, above 0"))),
        };
        give(buffer, splat4d_buffer { words: device.buffer("a host's", words)? });
        Ok(())
    })
}

/// Adopts a part of a host's buffer; the host keeps the ownership. `buffer` gets a handle, to be
/// destroyed. The VkBuffer must stay alive until on_drop is called, that is, until recorded work no
/// longer uses it.
///
/// The queue family of the device must own the buffer, or its sharing mode must be concurrent.
/// Other code may use it only in order with the engine's work: on the same queue before or after a
/// recording, or synchronised by a semaphore.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_buffer_adopt(
    device: *const splat4d_device,
    host: *const splat4d_host_buffer,
    buffer: *mut *mut splat4d_buffer,
) -> splat4d_result {
    // SAFETY: guaranteed by the host.
    call(|| unsafe {
        claim("buffer", buffer)?;
        let device = device_of(device)?;
        let host = read("host", host)?;
        let on_drop = Told::new(host.on_drop, host.on_drop_user);
        let part = HostBuffer {
            buffer: host.buffer,
            offset: host.offset,
            bytes: host.bytes,
            usage: vk::BufferUsageFlags::from_raw(host.usage),
        };
        let words = Buffer::adopt(device, "a host's", part, on_drop.into_box())?;
        give(buffer, splat4d_buffer { words });
        Ok(())
    })
}

/// Gets the VkBuffer, offset and size of a buffer, for the host's own commands. Keep the handle
/// until these are done, and order them with the engine's work.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_buffer_get_range(
    buffer: *const splat4d_buffer,
    range: *mut splat4d_range,
) -> splat4d_result {
    // SAFETY: guaranteed by the host.
    call(|| unsafe {
        let part = range_of(&shared("buffer", buffer)?.words);
        *exclusive("range", range)? = part;
        Ok(())
    })
}

/// Destroys the handle; null is allowed. Recorded work keeps the memory until it is done.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_buffer_destroy(buffer: *mut splat4d_buffer) {
    // SAFETY: guaranteed by the host.
    unsafe { destroy(buffer) };
}

pub(super) fn range_of<T: Pod>(buffer: &Buffer<T>) -> splat4d_range {
    let HostBuffer { buffer, offset, bytes, .. } = buffer.handle();
    splat4d_range { buffer, offset, bytes }
}

/// Returns an error if an output of an op shares memory with another argument of the op. Null
/// arguments are skipped.
pub(super) unsafe fn check_apart(
    op: &str,
    reads: &[(&str, *const splat4d_buffer)],
    writes: &[(&str, *mut splat4d_buffer)],
) -> Outcome {
    for (i, &(name, written)) in writes.iter().enumerate() {
        let others = writes[i + 1..].iter().map(|&(other, at)| (other, at.cast_const()));
        for (other, at) in others.chain(reads.iter().copied()) {
            if written.is_null() || at.is_null() {
                continue;
            }
            // SAFETY: guaranteed by the host.
            let (a, b) = unsafe { (shared(name, written.cast_const())?, shared(other, at)?) };
            let (a, b) = (range_of(&a.words), range_of(&b.words));
            let overlap = a.offset < b.offset + b.bytes && b.offset < a.offset + a.bytes;
            if a.buffer == b.buffer && overlap {
                return Err(input(format!("{op}: {name} and {other} share memory")));
            }
        }
    }
    Ok(())
}
