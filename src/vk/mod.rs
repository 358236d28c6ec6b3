//! The wrapper of Vulkan. Only this module and `embed` use `ash` and `unsafe`.
//!
//! The functions that `gpu` calls are safe within the crate: handles live in `Arc`s, every wrapper
//! keeps what it depends on alive, and each `unsafe` block states why it is sound.
#![allow(unsafe_code)]

mod adopt;
mod buffer;
mod cache;
#[cfg(feature = "files")]
mod cache_file;
mod command;
mod device;
mod foreign;
mod instance;
mod ledger;
mod pipeline;
mod queue;
mod requirements;
mod timeline;

pub use adopt::HostDevice;
pub(crate) use buffer::{RawBuffer, Residence};
pub use command::BoundRange;
pub(crate) use command::CommandSlot;
pub use device::Limits;
pub(crate) use device::{Context, OnDrop};
#[cfg(unix)]
pub use foreign::ImportedMemory;
pub use foreign::{HostBuffer, HostImage};
pub(crate) use instance::Instance;
pub use instance::{Candidate, DeviceInfo, DeviceKind, candidates, enumerate, loader_version};
pub(crate) use ledger::Ledger;
pub(crate) use pipeline::{Pipeline, PipelineShape};
pub use queue::QueueLock;
pub use requirements::{FeatureLinks, Features, Requirements};
pub use timeline::SemaphorePoint;
pub(crate) use timeline::Timeline;

use crate::error::Error;
use ash::vk;

/// Turns a `VkResult` into the crate's error.
fn vk_error(call: &'static str) -> impl FnOnce(vk::Result) -> Error {
    move |result| match result {
        vk::Result::ERROR_DEVICE_LOST => Error::DeviceLost { last_kernel: "unknown".into() },
        other => Error::Vulkan { call, code: other.as_raw(), meaning: other.to_string() },
    }
}
