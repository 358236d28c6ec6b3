//! The device of the host.

use crate::Result;
use crate::gpu::Device;
use crate::vk::{Context, HostDevice};
use std::sync::Arc;

impl Device {
    /// Wraps a Vulkan device that a host has created. Everything that
    /// [`Requirements`](super::Requirements) lists must be supported and enabled. Nothing is
    /// written to disk: compiled pipelines last as long as the device. Messages of a validation
    /// layer go to the host.
    ///
    /// # Errors
    /// [`Error::Input`](crate::Error::Input) for a null handle or a queue family that does not exist;
    /// [`Error::Unsupported`](crate::Error::Unsupported) for a family without compute, a required
    /// feature that was not enabled, and a requirement that the physical device lacks. `on_drop` is
    /// called in these cases too.
    ///
    /// # Safety
    /// - The handles belong together: the instance is of that loader, the physical device of that
    ///   instance, the device of that physical device, the queue of that device and family.
    /// - Instance and device were created for Vulkan 1.3 or newer. The device was created with
    ///   every feature that `features` claims, and with the extension if `external_memory_fd` is
    ///   set.
    /// - The loader stays loaded, and instance and device stay alive, until `on_drop` is called.
    ///   Without `on_drop`, they do so until every clone of the device and every object created
    ///   from it is dropped.
    /// - No other code uses the queue while the engine does: either only the engine uses the queue,
    ///   or every other use takes the same lock as `queue_lock`. `vkDeviceWaitIdle` uses all
    ///   queues.
    pub unsafe fn adopt(host: HostDevice) -> Result<Device> {
        // SAFETY: the caller guarantees it.
        let context = Arc::new(unsafe { Context::adopt(host) }?);
        Ok(Device::adopted(context))
    }

    /// The same device with another SPIR-V module for one kernel (`family/stem`); for tests that a
    /// fault in a kernel is detected.
    ///
    /// # Safety
    /// The module is valid SPIR-V for the features of the device. It has the kernel's bindings,
    /// push constants and workgroup size, and accesses no memory outside its bindings for any
    /// input.
    pub unsafe fn with_module(&self, kernel: &'static str, spirv: Vec<u8>) -> Device {
        self.replacing(kernel, spirv)
    }
}
