//! Vulkan, the only place that names `ash` and the only one with `unsafe`.
//!
//! What this module hands to `gpu` is safe to call from within the crate: handles live in `Arc`s,
//! every wrapper keeps what it needs alive, and each `unsafe` block says why it holds.
#![allow(unsafe_code)]

mod buffer;
mod cache;
mod command;
mod device;
mod instance;
mod pipeline;
mod timeline;

pub(crate) use buffer::{RawBuffer, Residence};
pub use command::BoundRange;
pub(crate) use command::CommandSlot;
pub(crate) use device::Context;
pub use device::Limits;
pub(crate) use instance::Instance;
pub use instance::{DeviceInfo, DeviceKind, enumerate};
pub(crate) use pipeline::{Pipeline, PipelineShape};
pub(crate) use timeline::Timeline;

use crate::error::Error;
use ash::vk;

/// Turns a `VkResult` into the crate's error.
fn vk_error(call: &'static str) -> impl FnOnce(vk::Result) -> Error {
    move |result| match result {
        vk::Result::ERROR_DEVICE_LOST => Error::DeviceLost { last_kernel: String::new() },
        other => Error::Vulkan { call, code: other.as_raw(), meaning: other.to_string() },
    }
}
