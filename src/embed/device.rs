//! The host's device.

use crate::Result;
use crate::gpu::Device;
use crate::vk::{Context, HostDevice};
use std::collections::HashMap;
use std::sync::Arc;

impl Device {
    /// Works on a device that a host has made. What [`Requirements`](super::Requirements) lists must
    /// be there and enabled. Nothing is written to disk: compiled pipelines last as long as the
    /// device. Messages of a validation layer go to the host.
    ///
    /// # Errors
    /// [`Error::Input`](crate::Error::Input) for a null handle or a queue family that does not exist;
    /// [`Error::Unsupported`](crate::Error::Unsupported) for a family without compute, a feature
    /// that the device was made without, and what the physical device lacks. `on_drop` is called
    /// then too.
    ///
    /// # Safety
    /// - The handles belong together: the instance is of that loader, the physical device of that
    ///   instance, the device of that physical device, the queue of that device and family.
    /// - Instance and device were made for Vulkan 1.3 or newer, and the device with every feature
    ///   that `features` claims, and with the extension where `external_memory_fd` claims it.
    /// - The loader stays loaded, and instance and device alive, until `on_drop` is called, or
    ///   without it until everything made from the device and every clone of it is dropped.
    /// - Nobody uses the queue while the engine does: either it is the engine's alone, or every other
    ///   use takes the lock that `queue_lock` takes. `vkDeviceWaitIdle` uses all queues.
    pub unsafe fn adopt(host: HostDevice) -> Result<Device> {
        // SAFETY: by the caller's promise.
        let context = Arc::new(unsafe { Context::adopt(host) }?);
        let limits = context.limits;
        Ok(Device::over(context, limits, HashMap::new()))
    }

    /// The same device with another SPIR-V module for one kernel (`family/stem`); for tests that a
    /// fault in it is noticed.
    ///
    /// # Safety
    /// The module is valid SPIR-V for what the device offers, has the kernel's bindings, push
    /// constants and workgroup, and touches nothing outside of what is bound, whatever it is given.
    pub unsafe fn with_module(&self, kernel: &'static str, spirv: Vec<u8>) -> Device {
        self.replacing(kernel, spirv)
    }
}
