//! Inside of another program: on its device, in its command buffers, with its buffers.
//!
//! Three depths, each of which goes with every op and with the renderer and the trainer:
//!
//! | | device | commands | memory |
//! |---|---|---|---|
//! | 1 | ours: [`Device::open`](crate::gpu::Device::open) | ours: [`Stream`](crate::gpu::Stream) | ours |
//! | 2 | the host's: [`Device::adopt`](crate::gpu::Device::adopt) | ours, between its semaphores: [`Stream::submit_between`](crate::gpu::Stream::submit_between) | the host's: [`Buffer::adopt`](crate::gpu::Buffer::adopt), [`Buffer::import_fd`](crate::gpu::Buffer::import_fd) |
//! | 3 | the host's | the host's: [`Recorder::over`](crate::gpu::Recorder::over) | the host's |
//!
//! Everything `unsafe` that a host calls is here, and what it must promise stands under *Safety*.
//! Handles are those of [`ash`], which is exported so that a host has the same version; hosts with
//! another binding make them from raw handles (`ash::vk::Handle::from_raw`).
//!
//! # Barriers
//!
//! One contract for every op. Within a [`Recorder`](crate::gpu::Recorder) conflicting work is
//! ordered by itself, on the host's buffers too. A recording into a host's command buffer begins
//! with a barrier from everything that the queue was given before, and
//! [`finish`](crate::gpu::Recorder::finish) ends it with one to everything after (all stages, memory
//! reads and writes, the host's reads): the host adds none for buffers. Layouts of images are the
//! host's. Between queues it takes semaphores. It follows that scratch memory may be used again by
//! the next recording while the last one is still in flight, as long as both go to one queue in the
//! order of recording.
//!
//! # Timestamps
//!
//! [`Recorder::profile`](crate::gpu::Recorder::profile) writes slot 0 where it is called and slot
//! *i* + 1 after the *i*-th dispatch that follows; the kernels' names come with the times
//! ([`Stream::times`](crate::gpu::Stream::times), [`Guard::times`]). Ops document their dispatches in
//! order. A host may write timestamps of its own around whatever it records.
//!
//! # Threads
//!
//! Nothing is global. Devices, buffers, plans and scratch may go to other threads and be shared;
//! recorders, streams, renderers and trainers may go to other threads. Any number of threads record
//! at once, on one device or several; submissions to one queue take turns.
//!
//! # Memory
//!
//! A recording allocates nothing once one like it has been made and its guard dropped (or, on a
//! stream, its ticket passed): descriptor pools, lists of what is kept alive and all else are used
//! again. [`Device::allocations`](crate::gpu::Device::allocations) counts what is made on the device.
//!
//! # A lost device
//!
//! From then on whatever submits, waits or reads is [`Error::DeviceLost`](crate::Error::DeviceLost),
//! with the kernel that was under way where it is known; recording may still succeed. Dropping is all
//! that is left, in any order: it neither waits for ever nor panics. What was recorded into a host's
//! command buffer fails where the host submits it.
//!
//! # On wgpu
//!
//! A host on wgpu makes its device with the engine's features in wgpu's own chain
//! ([`Features::enable_in`]), lends the handles, and has the engine record in a command encoder that
//! wgpu records nothing into. An image that the engine writes leaves the encoder before in the state
//! of a copy's destination, and wgpu must have seen it written once, or it clears it. wgpu and the
//! engine share a queue: both take the turn of [`HostDevice::queue_lock`]. `tools/wgpu-host` in the
//! repository is such a host.

#![allow(unsafe_code, reason = "what a host promises, it promises here")]

mod buffers;
mod device;
mod record;

#[cfg(unix)]
pub use crate::vk::ImportedMemory;
pub use crate::vk::{
    FeatureLinks, Features, HostBuffer, HostDevice, HostImage, QueueLock, Requirements,
    SemaphorePoint,
};
pub use ash;
pub use record::Guard;
