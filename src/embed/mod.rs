//! Integration into a host program: on its Vulkan device, in its command buffers, with its buffers.
//!
//! There are three levels of integration. Every op, the renderer and the trainer support each of
//! them:
//!
//! | | device | commands | memory |
//! |---|---|---|---|
//! | 1 | ours: [`Device::open`](crate::gpu::Device::open) | ours: [`Stream`](crate::gpu::Stream) | ours |
//! | 2 | the host's: [`Device::adopt`](crate::gpu::Device::adopt) | ours, between its semaphores: [`Stream::submit_between`](crate::gpu::Stream::submit_between) | the host's: [`Buffer::adopt`](crate::gpu::Buffer::adopt), [`Buffer::import_fd`](crate::gpu::Buffer::import_fd) |
//! | 3 | the host's | the host's: [`Recorder::over`](crate::gpu::Recorder::over) | the host's |
//!
//! This module defines every `unsafe` function that a host calls; the *Safety* sections state what
//! the host must guarantee. Handles are those of [`ash`], which is re-exported so that a host can
//! use the same version. Hosts with another Vulkan binding convert raw handles with
//! `ash::vk::Handle::from_raw`.
//!
//! # Barriers
//!
//! The same contract holds for every op. A [`Recorder`](crate::gpu::Recorder) orders conflicting
//! work automatically, on the host's buffers too. A recording into a host's command buffer begins
//! with a barrier after all earlier commands of the queue, and
//! [`finish`](crate::gpu::Recorder::finish) ends it with a barrier before all later commands (all
//! stages, memory reads and writes, host reads). The host therefore needs no buffer barriers of its
//! own. The host manages image layouts. Work on different queues needs semaphores. Scratch memory
//! may be reused by the next recording while the previous one is still in flight, if both are
//! submitted to one queue in the order of recording.
//!
//! # Timestamps
//!
//! [`Recorder::profile`](crate::gpu::Recorder::profile) writes timestamp 0 at the call and
//! timestamp *i* + 1 after the *i*-th following dispatch.
//! [`Stream::times`](crate::gpu::Stream::times) and [`Guard::times`] return the times with the
//! kernels' names. The documentation of an op lists its dispatches in order. A host may write its
//! own timestamps around a recording.
//!
//! # Threads
//!
//! The engine has no global state. Devices, buffers, plans and scratch are `Send` and `Sync`;
//! recorders, streams, renderers and trainers are `Send`. Any number of threads may record at once,
//! on one or several devices. Submissions to one queue are serialised.
//!
//! # Memory
//!
//! A recording allocates nothing if an equal one was made before and its guard was dropped (or, on
//! a stream, its ticket has passed): descriptor pools and the lists of referenced resources are
//! reused. [`Device::allocations`](crate::gpu::Device::allocations) counts the allocations on the
//! device.
//!
//! # A lost device
//!
//! After the device is lost, every call that submits, waits or reads returns
//! [`Error::DeviceLost`](crate::Error::DeviceLost), with the name of the running kernel if it is
//! known. Recording may still succeed. The program can then only drop its objects, in any order;
//! dropping neither blocks forever nor panics. Commands recorded into a host's command buffer fail
//! when the host submits them.
//!
//! # On wgpu
//!
//! A host on wgpu enables the engine's features in wgpu's `VkDeviceCreateInfo` chain
//! ([`Features::enable_in`]), passes the handles to the engine, and lets the engine record into a
//! command encoder that wgpu does not record into. The preceding encoder must leave an image that
//! the engine writes in the state of a copy destination. wgpu must have recorded a write to that
//! image once, or else it clears it. wgpu and the engine share a queue, so both must take
//! [`HostDevice::queue_lock`]. `examples/wgpu-host` in the repository is such a host.

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
