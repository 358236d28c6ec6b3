//! Recording: on a stream of the engine's, or into the host's command buffer.

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

/// Submissions to the device's queue, one after the other.
pub struct splat4d_stream {
    pub(super) stream: Stream,
}

/// A recording under way. Functions named ..._record, and a trainer's forward, backward and update,
/// add to it, ordered by the engine's own barriers. Where one fails, throw the recording away.
pub struct splat4d_recorder {
    pub(super) recorder: Recorder,
}

/// What a recording into the host's command buffer needs while the device works on it.
pub struct splat4d_guard {
    _guard: Guard,
}

/// A value of a timeline semaphore.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct splat4d_semaphore_point {
    /// A timeline semaphore of the device.
    pub semaphore: VkSemaphore,
    /// To wait for, or to signal.
    pub value: u64,
}

/// Makes a stream. `stream` gets a handle, to be destroyed.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_stream_create(
    device: *const splat4d_device,
    stream: *mut *mut splat4d_stream,
) -> splat4d_result {
    // SAFETY: the host's promise.
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
    // SAFETY: the host's promise.
    call(|| unsafe {
        claim("recorder", recorder)?;
        let started = exclusive("stream", stream)?.stream.record()?;
        give(recorder, splat4d_recorder { recorder: started });
        Ok(())
    })
}

/// Submits a recording, which begins when the `waits` have come, runs after everything submitted before
/// on this stream, and brings the `signals` when it is done. The recorder is gone afterwards, also
/// where this fails. `ticket`, which may be null, gets what to wait for.
///
/// The semaphores are timeline semaphores of the device and live until the submission is done; what is
/// waited for comes, else waiting for the ticket and destroying the stream never end; each value
/// signalled is above all that the semaphore had or gets from submissions pending.
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
    // SAFETY: the host's promise.
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
    // SAFETY: the host's promise.
    call(|| unsafe {
        let stream = &mut exclusive("stream", stream)?.stream;
        let known = stream.ticket(ticket);
        let known = known.ok_or_else(|| input(format!("ticket {ticket} is not of this stream")))?;
        Ok(stream.wait(known)?)
    })
}

/// The timeline semaphore that counts the stream's submissions: it reaches a ticket when that is done.
/// It lives as long as the stream.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_stream_get_semaphore(
    stream: *const splat4d_stream,
    semaphore: *mut VkSemaphore,
) -> splat4d_result {
    // SAFETY: the host's promise.
    call(|| unsafe {
        *exclusive("semaphore", semaphore)? = shared("stream", stream)?.stream.semaphore();
        Ok(())
    })
}

/// Writes a buffer from its start: `bytes`, a multiple of 4. `data` is free again on return.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_stream_upload(
    stream: *mut splat4d_stream,
    buffer: *mut splat4d_buffer,
    data: *const c_void,
    bytes: usize,
) -> splat4d_result {
    // SAFETY: the host's promise.
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

/// Waits for everything submitted on the stream so far, and reads a buffer from its start: `bytes`, a
/// multiple of 4.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_stream_download(
    stream: *mut splat4d_stream,
    buffer: *const splat4d_buffer,
    data: *mut c_void,
    bytes: usize,
) -> splat4d_result {
    // SAFETY: the host's promise.
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

/// Waits for what was submitted, and destroys the handle; null is fine.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_stream_destroy(stream: *mut splat4d_stream) {
    // SAFETY: the host's promise.
    unsafe { destroy(stream) };
}

/// Records into the host's command buffer, from where the host is in it; the host goes on with it
/// after splat4d_recorder_finish, and submits it. `recorder` gets a handle, which is finished or
/// destroyed.
///
/// A recording begins with a barrier from everything that the queue was given before and ends with one
/// to everything after: the host adds none for buffers. It binds pipelines, descriptor sets and push
/// constants of its own.
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
    // SAFETY: the host's promise.
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
    // SAFETY: the host's promise.
    call(|| unsafe {
        let recorder = take("recorder", recorder)?.recorder;
        claim("guard", guard)?;
        give(guard, splat4d_guard { _guard: recorder.finish()? });
        Ok(())
    })
}

/// Throws a recording away; null is fine. Into the host's command buffer: the host must reset or free
/// that, since what it binds is gone.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_recorder_destroy(recorder: *mut splat4d_recorder) {
    // SAFETY: the host's promise.
    unsafe { destroy(recorder) };
}

/// Tells that the device is done with a command buffer of the host's, or that it will never be
/// submitted; null is fine.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_guard_destroy(guard: *mut splat4d_guard) {
    // SAFETY: the host's promise.
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
