//! Adoption of a Vulkan device that a host has created.

use super::device::{Context, OnDrop, Opened};
use super::instance::Instance;
use super::queue::{Queue, QueueLock};
use super::requirements::{Features, Requirements, unsupported};
use crate::error::{Error, Result};
use ash::vk;
use ash::vk::Handle;
use std::ffi::CStr;
use std::sync::Arc;

/// A Vulkan device that a host has created, for [`Device::adopt`](crate::gpu::Device::adopt). It
/// consists of raw handles, so that hosts with any Vulkan binding of any version can supply it.
pub struct HostDevice {
    /// The loader's `vkGetInstanceProcAddr`; with `ash`,
    /// `entry.static_fn().get_instance_proc_addr`.
    pub get_instance_proc_addr: vk::PFN_vkGetInstanceProcAddr,
    /// The instance, created for Vulkan 1.3 or newer.
    pub instance: vk::Instance,
    /// The physical device.
    pub physical_device: vk::PhysicalDevice,
    /// The device, created with everything that [`Requirements`] lists.
    pub device: vk::Device,
    /// A queue of the device, for the engine's own submissions.
    pub queue: vk::Queue,
    /// The queue's family, which must offer compute.
    pub queue_family: u32,
    /// The features that the device was created with; [`Features::enabled_by`] reads them from the
    /// host's `VkDeviceCreateInfo`.
    pub features: Features,
    /// Whether the device was created with `VK_KHR_external_memory_fd`.
    pub external_memory_fd: bool,
    /// A lock of the queue; required if other code uses the queue while the engine may submit. It
    /// must call the given function exactly once, while no other code uses the queue.
    pub queue_lock: Option<Box<QueueLock>>,
    /// A callback, called when the engine has dropped every object that uses the device, on the
    /// thread that drops the last one. It is also called if adopting fails.
    pub on_drop: Option<Box<dyn FnOnce() + Send + Sync>>,
}

/// Loads a host's instance.
///
/// # Safety
/// The function is the loader's, and the instance is alive.
unsafe fn load_instance(
    get_instance_proc_addr: vk::PFN_vkGetInstanceProcAddr,
    instance: vk::Instance,
) -> Result<ash::Instance> {
    let functions = ash::StaticFn { get_instance_proc_addr };
    require_handle("instance", instance.is_null())?;
    // SAFETY: guaranteed by the caller.
    let found = unsafe {
        get_instance_proc_addr(instance, c"vkGetPhysicalDeviceFeatures2".as_ptr()).is_some()
    };
    if !found {
        return Err(unsupported("the host's instance was made for a Vulkan below 1.3".into()));
    }
    // SAFETY: guaranteed by the caller.
    Ok(unsafe { ash::Instance::load(&functions, instance) })
}

fn require_handle(what: &str, is_null: bool) -> Result<()> {
    match is_null {
        true => Err(Error::Input(format!("the host's {what} is a null handle"))),
        false => Ok(()),
    }
}

impl Requirements {
    /// Descriptions of the requirements that a physical device of a host's instance lacks; empty if
    /// the engine can run on it.
    ///
    /// # Errors
    /// [`Error::Input`] for a null handle; [`Error::Unsupported`] for an instance below Vulkan 1.3.
    ///
    /// # Safety
    /// The function is the loader's; the instance is alive; the physical device belongs to the
    /// instance.
    pub unsafe fn lacking(
        &self,
        get_instance_proc_addr: vk::PFN_vkGetInstanceProcAddr,
        instance: vk::Instance,
        physical_device: vk::PhysicalDevice,
    ) -> Result<Vec<String>> {
        // SAFETY: guaranteed by the caller.
        let instance = unsafe { load_instance(get_instance_proc_addr, instance) }?;
        require_handle("physical device", physical_device.is_null())?;
        Ok(self.lacked_by(&instance, physical_device))
    }
}

impl Context {
    /// A context around a host's device.
    ///
    /// # Safety
    /// As for `Device::adopt`.
    pub(crate) unsafe fn adopt(host: HostDevice) -> Result<Context> {
        // Wrapped first, so that the host's callback is called even on an early return.
        let on_drop = OnDrop(host.on_drop);
        // SAFETY: guaranteed by the caller.
        let instance = unsafe { load_instance(host.get_instance_proc_addr, host.instance) }?;
        require_handle("physical device", host.physical_device.is_null())?;
        require_handle("device", host.device.is_null())?;
        require_handle("queue", host.queue.is_null())?;
        let requirements = Requirements::query();
        let instance = Instance::adopt(instance);
        let physical = host.physical_device;
        // SAFETY: a plain query; the versions of its structures are part of Vulkan 1.1 and 1.2,
        // which `check` below needs too.
        let version = unsafe { instance.raw.get_physical_device_properties(physical) }.api_version;
        if version < requirements.api_version {
            return Err(unsupported("the host's physical device is below Vulkan 1.3".into()));
        }
        let info = instance.describe(physical);
        requirements.check(&instance.raw, physical, &info.name)?;
        let lacking = host.features.lacking(&requirements.features);
        if !lacking.is_empty() {
            return Err(unsupported(format!(
                "the host's device was made without the feature {}; enable it in \
                 VkDeviceCreateInfo",
                lacking.join(", ")
            )));
        }
        // SAFETY: a plain query.
        let families =
            unsafe { instance.raw.get_physical_device_queue_family_properties(physical) };
        match families.get(host.queue_family as usize) {
            None => {
                let (family, count) = (host.queue_family, families.len());
                return Err(Error::Input(format!("queue family {family}: there are {count}")));
            }
            Some(family) if !family.queue_flags.contains(requirements.queue_flags) => {
                return Err(unsupported(format!(
                    "queue family {} offers no compute; take a queue of another one",
                    host.queue_family
                )));
            }
            Some(_) => {}
        }
        let loads = |name: &CStr| {
            // SAFETY: the caller guarantees that the device is alive.
            unsafe { (instance.raw.fp_v1_0().get_device_proc_addr)(host.device, name.as_ptr()) }
                .is_some()
        };
        if !loads(c"vkQueueSubmit2") {
            return Err(unsupported("the host's device was made for a Vulkan below 1.3".into()));
        }
        // SAFETY: the caller guarantees that the device is alive, and of this instance.
        let raw = unsafe { ash::Device::load(instance.raw.fp_v1_0(), host.device) };
        let opened = Opened {
            raw,
            physical,
            queue: Queue::new(host.queue, host.queue_lock),
            family: host.queue_family,
            imports_fd: host.external_memory_fd,
            host: Some(on_drop),
        };
        Context::around(Arc::new(instance), opened, info)
    }
}
