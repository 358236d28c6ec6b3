//! Recording: on a stream of the engine, or into the host's command buffer.

use super::call::{
    Outcome, array, array_mut, call, claim, destroy, exclusive, give, input, shape, shared,
    splat4d_result, take,
};
use super::device::{device_of, splat4d_device};
use super::memory::splat4d_buffer;
use super::vulkan::{VkCommandBuffer, VkSemaphore};
use crate::embed::{Guard, SemaphorePoint};
use crate::gpu::{Recorder, Stream};
use std::ffi::c_void;

/// An ordered sequence of submissions to the device's queue.
pub struct splat4d_stream {
    pub(super) stream: Stream,
}

/// A recording in progress. Functions named ..._record, and a trainer's forward, backward and
/// update, add to it; the engine's barriers order them. If one fails, destroy the recording.
pub struct splat4d_recorder {
    pub(super) recorder: Recorder,
}

/// Keeps the resources of a recording into the host's command buffer alive while the device works
/// on it.
pub struct splat4d_guard {
    _guard: Guard,
}

/// A value of a timeline semaphore.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct splat4d_semaphore_point {
    /// A timeline semaphore of the device.
    pub semaphore: VkSemaphore,
    /// The value to wait for, or to signal.
    pub value: u64,
}

/// Creates a stream. `stream` gets a handle, to be destroyed.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_stream_create(
    device: *const splat4d_device,
    stream: *mut *mut splat4d_stream,
) -> splat4d_result {
    // SAFETY: guaranteed by the host.
    call(|| unsafe {
        claim("stream", stream)?;
        give(stream, splat4d_stream { stream: device_of(device)?.stream()? });
        Ok(())
    })
}

/// Starts a recording for splat4d_stream_submit. `recorder` gets a handle, which is submitted or
/// destroyed.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_stream_record(
    stream: *mut splat4d_stream,
    recorder: *mut *mut splat4d_recorder,
) -> splat4d_result {
    // SAFETY: guaranteed by the host.
    call(|| unsafe {
        claim("recorder", recorder)?;
        let started = exclusive("stream", stream)?.stream.record()?;
        give(recorder, splat4d_recorder { recorder: started });
        Ok(())
    })
}

/// Submits a recording. It begins when all `waits` are reached, runs after all earlier submissions
/// of this stream, and signals the `signals` when it is done. The recorder is invalid afterwards,
/// also if the call fails. `ticket`, which may be null, receives the value to wait for.
///
/// The semaphores are timeline semaphores of the device and live until the submission is done; the
/// values of `waits` must be reached eventually, or else waiting for the ticket and destroying the
/// stream block forever. Each signalled value must be greater than the semaphore's value and than
/// all values that pending submissions signal.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_stream_submit(
    stream: *mut splat4d_stream,
    recorder: *mut splat4d_recorder,
    waits: *const splat4d_semaphore_point,
    wait_count: usize,
    signals: *const splat4d_semaphore_point,
    signal_count: usize,
    ticket: *mut u64,
) -> splat4d_result {
    // SAFETY: guaranteed by the host.
    call(|| unsafe {
        let recorder = take("recorder", recorder)?.recorder;
        let waits = points(array("waits", waits, wait_count)?);
        let signals = points(array("signals", signals, signal_count)?);
        let ticket = (!ticket.is_null()).then(|| exclusive("ticket", ticket)).transpose()?;
        let stream = &mut exclusive("stream", stream)?.stream;
        let submitted = stream.submit_between(recorder, &waits, &signals)?;
        if let Some(ticket) = ticket {
            *ticket = submitted.value();
        }
        Ok(())
    })
}

/// Waits for a submission and everything before it.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_stream_wait(
    stream: *mut splat4d_stream,
    ticket: u64,
) -> splat4d_result {
    // SAFETY: guaranteed by the host.
    call(|| unsafe {
        let stream = &mut exclusive("stream", stream)?.stream;
        let known = stream.ticket(ticket);
        let known = known.ok_or_else(|| input(format!("ticket {ticket} is not of this stream")))?;
        Ok(stream.wait(known)?)
    })
}

/// Gets the timeline semaphore that counts the stream's submissions: it reaches a ticket's value
/// when that submission is done.
/// It lives as long as the stream.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_stream_get_semaphore(
    stream: *const splat4d_stream,
    semaphore: *mut VkSemaphore,
) -> splat4d_result {
    // SAFETY: guaranteed by the host.
    call(|| unsafe {
        *exclusive("semaphore", semaphore)? = shared("stream", stream)?.stream.semaphore();
        Ok(())
    })
}

/// Writes `bytes` bytes (a multiple of 4) to the start of a buffer. `data` may be freed on return.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_stream_upload(
    stream: *mut splat4d_stream,
    buffer: *mut splat4d_buffer,
    data: *const c_void,
    bytes: usize,
) -> splat4d_result {
    // SAFETY: guaranteed by the host.
    call(|| unsafe {
        let stream = &mut exclusive("stream", stream)?.stream;
        let words = &mut exclusive("buffer", buffer)?.words;
        check_bytes(bytes, words.len())?;
        let data: &[u8] = array("data", data.cast(), bytes)?;
        // The host's memory need not be aligned.
        let mut aligned = vec![0u32; bytes / 4];
        bytemuck::cast_slice_mut(&mut aligned).copy_from_slice(data);
        Ok(stream.upload(words, &aligned)?)
    })
}

/// Waits for all submissions of the stream so far, and reads `bytes` bytes (a multiple of 4) from
/// the start of a buffer.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_stream_download(
    stream: *mut splat4d_stream,
    buffer: *const splat4d_buffer,
    data: *mut c_void,
    bytes: usize,
) -> splat4d_result {
    // SAFETY: guaranteed by the host.
    call(|| unsafe {
        let stream = &mut exclusive("stream", stream)?.stream;
        let words = &shared("buffer", buffer)?.words;
        check_bytes(bytes, words.len())?;
        let data: &mut [u8] = array_mut("data", data.cast(), bytes)?;
        let words = stream.download(words)?;
        data.copy_from_slice(&bytemuck::cast_slice(&words)[..bytes]);
        Ok(())
    })
}

/// Waits for all submissions, and destroys the handle; null is allowed.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_stream_destroy(stream: *mut splat4d_stream) {
    // SAFETY: guaranteed by the host.
    unsafe { destroy(stream) };
}

/// Starts a recording that appends to the host's command buffer. After splat4d_recorder_finish the
/// host may record more, and submits the buffer. `recorder` gets a handle, to be finished or
/// destroyed.
///
/// A recording begins with a barrier after all earlier commands of the queue and ends with a
/// barrier before all later ones: the host needs no buffer barriers. It binds its own pipelines,
/// descriptor sets and push constants.
///
/// The command buffer must be of the device, of a pool for a family with compute, begun, and outside
/// of a render pass; nobody else records into it until splat4d_recorder_finish. It is submitted once
/// at most for each recording. Command buffers that use the same buffers, renderers, trainers or ops
/// go to one queue in the order in which they were recorded, or are ordered by semaphores.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_recorder_over(
    device: *const splat4d_device,
    commands: VkCommandBuffer,
    recorder: *mut *mut splat4d_recorder,
) -> splat4d_result {
    // SAFETY: guaranteed by the host.
    call(|| unsafe {
        claim("recorder", recorder)?;
        let started = Recorder::over(device_of(device)?, commands)?;
        give(recorder, splat4d_recorder { recorder: started });
        Ok(())
    })
}

/// Ends a recording into the host's command buffer. The recorder is gone afterwards, also where this
/// fails. `guard` gets a handle, to be destroyed when the device is done with the command buffer or
/// the host has reset it.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_recorder_finish(
    recorder: *mut splat4d_recorder,
    guard: *mut *mut splat4d_guard,
) -> splat4d_result {
    // SAFETY: guaranteed by the host.
    call(|| unsafe {
        let recorder = take("recorder", recorder)?.recorder;
        claim("guard", guard)?;
        give(guard, splat4d_guard { _guard: recorder.finish()? });
        Ok(())
    })
}

/// Discards a recording; null is allowed. The host must reset or free a command buffer of its own
/// that was recorded into, since the resources that it binds are freed.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_recorder_destroy(recorder: *mut splat4d_recorder) {
    // SAFETY: guaranteed by the host.
    unsafe { destroy(recorder) };
}

/// Destroys the guard; null is allowed. Call it when the device is done with the host's command
/// buffer, or when that will never be submitted.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_guard_destroy(guard: *mut splat4d_guard) {
    // SAFETY: guaranteed by the host.
    unsafe { destroy(guard) };
}

fn points(all: &[splat4d_semaphore_point]) -> Vec<SemaphorePoint> {
    let point = |p: &splat4d_semaphore_point| {
        let splat4d_semaphore_point { semaphore, value } = *p;
        SemaphorePoint { semaphore, value }
    };
    all.iter().map(point).collect()
}

fn check_bytes(bytes: usize, words: usize) -> Outcome {
    match bytes.is_multiple_of(4) && bytes / 4 <= words {
        true => Ok(()),
        false => Err(shape(format!("{bytes} bytes: a multiple of 4, and at most {}", 4 * words))),
    }
}
