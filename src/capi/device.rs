//! Devices: opened by the engine, or adopted from the host.

use super::call::{
    Outcome, call, claim, destroy, give, grows, input, read, read_or_zero, shared, splat4d_result,
    text, write, write_text,
};
use super::vulkan::{PFN_vkGetInstanceProcAddr, VkDevice, VkInstance, VkPhysicalDevice, VkQueue};
use crate::embed::{Features, HostDevice, QueueLock, Requirements};
use crate::gpu::{Device, DeviceKind, Request, Selector};
use std::ffi::{c_char, c_void};
use std::sync::{Mutex, PoisonError};

/// A Vulkan device. Objects made from it keep the underlying device alive, so handles may be
/// destroyed in any order. Any number of threads may use a device at once.
pub struct splat4d_device {
    device: Device,
    /// Messages of the validation layer that were not taken yet, one per line.
    messages: Mutex<String>,
}

impl splat4d_device {
    fn new(device: Device) -> splat4d_device {
        splat4d_device { device, messages: Mutex::default() }
    }
}

/// Which device to open.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct splat4d_request {
    /// sizeof(splat4d_request).
    pub struct_size: usize,
    /// A number is an index; "best", "gpu", "discrete", "integrated", "virtual" and "software" are kinds;
    /// anything else is part of a name. Null for "best".
    pub selector: *const c_char,
    /// Not 0 turns the Khronos validation layer on, with synchronization validation.
    pub validation: u32,
}
grows!(splat4d_request, validation: u32);

/// timelineSemaphore of Vulkan 1.2, in a mask of features.
pub const SPLAT4D_FEATURE_TIMELINE_SEMAPHORE: u32 = 1;
/// scalarBlockLayout of Vulkan 1.2.
pub const SPLAT4D_FEATURE_SCALAR_BLOCK_LAYOUT: u32 = 2;
/// synchronization2 of Vulkan 1.3.
pub const SPLAT4D_FEATURE_SYNCHRONIZATION2: u32 = 4;
/// subgroupSizeControl of Vulkan 1.3.
pub const SPLAT4D_FEATURE_SUBGROUP_SIZE_CONTROL: u32 = 8;
/// computeFullSubgroups of Vulkan 1.3.
pub const SPLAT4D_FEATURE_COMPUTE_FULL_SUBGROUPS: u32 = 16;

/// A function of the host, called with the pointer registered with it. It must not throw and must
/// not call splat4d with the handle of the running call.
pub type splat4d_callback = Option<unsafe extern "C" fn(user: *mut c_void)>;

/// A Vulkan device that the host has created.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct splat4d_host_device {
    /// sizeof(splat4d_host_device).
    pub struct_size: usize,
    /// The loader's.
    pub get_instance_proc_addr: PFN_vkGetInstanceProcAddr,
    /// The instance, created for Vulkan 1.3 or newer.
    pub instance: VkInstance,
    /// A physical device of the instance.
    pub physical_device: VkPhysicalDevice,
    /// The device, created for Vulkan 1.3 or newer with everything that splat4d_requirements lists.
    pub device: VkDevice,
    /// A queue of the device, for the engine's own submissions.
    pub queue: VkQueue,
    /// The queue's family, which must offer compute.
    pub queue_family: u32,
    /// SPLAT4D_FEATURE_*: the features that the device was created with.
    pub features: u32,
    /// Locks the queue. Required if other code uses the queue while the engine may submit; called
    /// before each submission on the submitting thread. queue_lock and queue_unlock must both be
    /// set or both be null.
    pub queue_lock: splat4d_callback,
    /// As above.
    pub queue_unlock: splat4d_callback,
    /// Given to queue_lock and queue_unlock.
    pub queue_user: *mut c_void,
    /// Called once when no object of the engine uses the device any more, on the thread that
    /// destroys the last one. It is also called if splat4d_device_adopt fails, except with
    /// SPLAT4D_ERROR_POINTER or SPLAT4D_ERROR_STRUCT_SIZE.
    pub on_drop: splat4d_callback,
    /// Given to on_drop.
    pub on_drop_user: *mut c_void,
}
grows!(splat4d_host_device, on_drop_user: *mut c_void);

/// The requirements on a device.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct splat4d_requirements {
    /// sizeof(splat4d_requirements).
    pub struct_size: usize,
    /// Minimum Vulkan version of instance and device, in Vulkan's packed encoding.
    pub api_version: u32,
    /// SPLAT4D_FEATURE_*: the features that must be enabled. No extension is required.
    pub features: u32,
    /// VkQueueFlags that the queue's family must have.
    pub queue_flags: u32,
    /// VkSubgroupFeatureFlags that compute shaders must support.
    pub subgroup_operations: u32,
    /// Minimum of maxComputeWorkGroupInvocations and `maxComputeWorkGroupSize[0]`.
    pub workgroup_invocations: u32,
    /// Minimum of maxComputeSharedMemorySize, bytes.
    pub shared_memory: u32,
    /// Minimum of maxPushConstantsSize, bytes.
    pub push_constants: u32,
    /// Minimum of maxPerStageDescriptorStorageBuffers and maxDescriptorSetStorageBuffers.
    pub storage_buffers: u32,
}
grows!(splat4d_requirements, storage_buffers: u32);

/// Properties of a device and its memory use.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct splat4d_device_info {
    /// sizeof(splat4d_device_info).
    pub struct_size: usize,
    /// The device's name, zero-terminated; truncated if it is longer.
    pub name: [c_char; 256],
    /// VkPhysicalDeviceType.
    pub kind: u32,
    /// Supported Vulkan version, in Vulkan's packed encoding.
    pub api_version: u32,
    /// Offsets of adopted buffers must be multiples of this many bytes.
    pub storage_alignment: u64,
    /// The largest buffer that an op may use, bytes.
    pub storage_range: u64,
    /// Bytes of all live buffers of the engine.
    pub bytes: u64,
    /// Number of buffers and pools created so far; constant in steady-state work.
    pub allocations: u64,
}
grows!(splat4d_device_info, allocations: u64);

/// Opens a device. `request` may be null for the best device. `device` gets a handle, to be
/// destroyed.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_device_open(
    request: *const splat4d_request,
    device: *mut *mut splat4d_device,
) -> splat4d_result {
    // SAFETY: guaranteed by the host.
    call(|| unsafe {
        claim("device", device)?;
        let request = read_or_zero("request", request)?;
        let selector = match request.selector.is_null() {
            true => Selector::Best,
            false => Selector::from(text("request.selector", request.selector)?),
        };
        let validation = request.validation != 0;
        let opened = Device::open(&Request { selector, validation, ..Request::default() })?;
        give(device, splat4d_device::new(opened));
        Ok(())
    })
}

/// Gets the requirements on a device, for hosts that create their own.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_requirements_query(
    requirements: *mut splat4d_requirements,
) -> splat4d_result {
    // SAFETY: guaranteed by the host.
    call(|| unsafe {
        let needed = Requirements::query();
        let value = splat4d_requirements {
            struct_size: 0,
            api_version: needed.api_version,
            features: mask(&needed.features),
            queue_flags: needed.queue_flags.as_raw(),
            subgroup_operations: needed.subgroup_operations.as_raw(),
            workgroup_invocations: needed.workgroup_invocations,
            shared_memory: needed.shared_memory,
            push_constants: needed.push_constants,
            storage_buffers: needed.storage_buffers,
        };
        write("requirements", requirements, value)
    })
}

/// Gets descriptions of the requirements that a physical device lacks, separated by ", "; empty if
/// the engine can run on it. As much as fits is written to `text` (`size` bytes, zero-terminated;
/// may be null if size is 0), and the length of the whole text to `length`, which may be null.
///
/// The instance must be alive and of that loader, and the physical device must belong to it.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_requirements_lacking(
    get_instance_proc_addr: PFN_vkGetInstanceProcAddr,
    instance: VkInstance,
    physical_device: VkPhysicalDevice,
    text: *mut c_char,
    size: usize,
    length: *mut usize,
) -> splat4d_result {
    // SAFETY: guaranteed by the host.
    call(|| unsafe {
        let loader = get_instance_proc_addr.ok_or_else(no_loader)?;
        let missing = Requirements::query().lacking(loader, instance, physical_device)?;
        write_text(&missing.join(", "), text, size, length)
    })
}

/// Adopts a device that the host has created. `device` gets a handle, to be destroyed. Nothing is
/// written to disk; messages of a validation layer go to the host.
///
/// The handles must belong together. Instance and device must have been created for Vulkan 1.3 or
/// newer, the device with every feature that `features` claims. The loader must stay loaded, and
/// instance and device alive, until on_drop is called; without on_drop, until everything made from
/// the device is destroyed. No other code may use the queue while the engine does: either only the
/// engine uses it, or every other use takes the same lock as queue_lock. vkDeviceWaitIdle uses all
/// queues.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_device_adopt(
    host: *const splat4d_host_device,
    device: *mut *mut splat4d_device,
) -> splat4d_result {
    // SAFETY: guaranteed by the host.
    call(|| unsafe {
        claim("device", device)?;
        let host = read("host", host)?;
        // From here on on_drop is called on every path.
        let on_drop = Told::new(host.on_drop, host.on_drop_user);
        let queue_lock: Option<Box<QueueLock>> = match (host.queue_lock, host.queue_unlock) {
            (Some(lock), Some(unlock)) => {
                Some(queue_lock(Callback(lock, host.queue_user), Callback(unlock, host.queue_user)))
            }
            (None, None) => None,
            _ => return Err(input("host: queue_lock and queue_unlock go together")),
        };
        let adopted = Device::adopt(HostDevice {
            get_instance_proc_addr: host.get_instance_proc_addr.ok_or_else(no_loader)?,
            instance: host.instance,
            physical_device: host.physical_device,
            device: host.device,
            queue: host.queue,
            queue_family: host.queue_family,
            features: features(host.features),
            external_memory_fd: false,
            queue_lock,
            on_drop: on_drop.into_box(),
        })?;
        give(device, splat4d_device::new(adopted));
        Ok(())
    })
}

/// Gets the properties of the device and the engine's memory use.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_device_get_info(
    device: *const splat4d_device,
    info: *mut splat4d_device_info,
) -> splat4d_result {
    // SAFETY: guaranteed by the host.
    call(|| unsafe {
        let device = &shared("device", device)?.device;
        let (facts, limits) = (device.info(), device.limits());
        let mut name = [0; 256];
        write_text(&facts.name, name.as_mut_ptr(), name.len(), std::ptr::null_mut())?;
        let value = splat4d_device_info {
            struct_size: 0,
            name,
            kind: match facts.kind {
                DeviceKind::Other => 0,
                DeviceKind::Integrated => 1,
                DeviceKind::Discrete => 2,
                DeviceKind::Virtual => 3,
                DeviceKind::Software => 4,
            },
            api_version: facts.api_version,
            storage_alignment: limits.storage_alignment,
            storage_range: limits.storage_range,
            bytes: device.memory().0,
            allocations: device.allocations(),
        };
        write("info", info, value)
    })
}

/// Takes the messages of the validation layer since the last call, one per line: empty without
/// messages, without the layer, and on a host's device. `text`, `size` and `length` are as for
/// splat4d_requirements_lacking; the messages are kept if not all of the text fits.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_device_take_validation_messages(
    device: *const splat4d_device,
    text: *mut c_char,
    size: usize,
    length: *mut usize,
) -> splat4d_result {
    // SAFETY: guaranteed by the host.
    call(|| unsafe {
        let splat4d_device { device, messages } = shared("device", device)?;
        let mut messages = messages.lock().unwrap_or_else(PoisonError::into_inner);
        for message in device.take_validation_messages() {
            if !messages.is_empty() {
                messages.push('\n');
            }
            messages.push_str(&message);
        }
        hand_over(&mut messages, text, size, length)
    })
}

/// Destroys the handle; null is allowed. The device is destroyed with the last object made from it.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_device_destroy(device: *mut splat4d_device) {
    // SAFETY: guaranteed by the host.
    unsafe { destroy(device) };
}

/// Writes a text and clears it if all of it fits.
unsafe fn hand_over(
    kept: &mut String,
    to: *mut c_char,
    size: usize,
    length: *mut usize,
) -> Outcome {
    // SAFETY: guaranteed by the host.
    unsafe { write_text(kept, to, size, length) }?;
    if kept.len() < size {
        kept.clear();
    }
    Ok(())
}

fn no_loader() -> super::call::Fault {
    input("get_instance_proc_addr is null")
}

fn mask(features: &Features) -> u32 {
    let bit = |has: bool, bit: u32| if has { bit } else { 0 };
    bit(features.timeline_semaphore, SPLAT4D_FEATURE_TIMELINE_SEMAPHORE)
        | bit(features.scalar_block_layout, SPLAT4D_FEATURE_SCALAR_BLOCK_LAYOUT)
        | bit(features.synchronization2, SPLAT4D_FEATURE_SYNCHRONIZATION2)
        | bit(features.subgroup_size_control, SPLAT4D_FEATURE_SUBGROUP_SIZE_CONTROL)
        | bit(features.compute_full_subgroups, SPLAT4D_FEATURE_COMPUTE_FULL_SUBGROUPS)
}

fn features(mask: u32) -> Features {
    let has = |bit: u32| mask & bit != 0;
    Features {
        timeline_semaphore: has(SPLAT4D_FEATURE_TIMELINE_SEMAPHORE),
        scalar_block_layout: has(SPLAT4D_FEATURE_SCALAR_BLOCK_LAYOUT),
        synchronization2: has(SPLAT4D_FEATURE_SYNCHRONIZATION2),
        subgroup_size_control: has(SPLAT4D_FEATURE_SUBGROUP_SIZE_CONTROL),
        compute_full_subgroups: has(SPLAT4D_FEATURE_COMPUTE_FULL_SUBGROUPS),
    }
}

/// A host's callback with its pointer.
#[derive(Clone, Copy)]
struct Callback(unsafe extern "C" fn(user: *mut c_void), *mut c_void);

// SAFETY: the host guarantees that its functions may be called on any thread.
unsafe impl Send for Callback {}
// SAFETY: as above.
unsafe impl Sync for Callback {}

impl Callback {
    fn call(&self) {
        // SAFETY: the host's function, with the host's pointer.
        unsafe { (self.0)(self.1) };
    }
}

/// Calls the host's callback once, when it is dropped.
pub(super) struct Told(Option<Callback>);

impl Told {
    pub(super) fn new(function: splat4d_callback, user: *mut c_void) -> Told {
        Told(function.map(|function| Callback(function, user)))
    }

    /// The callback as the closure type of the engine.
    pub(super) fn into_box(self) -> Option<Box<dyn FnOnce() + Send + Sync>> {
        self.0?;
        Some(Box::new(move || drop(self)))
    }
}

impl Drop for Told {
    fn drop(&mut self) {
        if let Some(callback) = self.0.take() {
            callback.call();
        }
    }
}

fn queue_lock(lock: Callback, unlock: Callback) -> Box<QueueLock> {
    Box::new(move |work| {
        lock.call();
        // Unlocks even if the work panics.
        let unlock = Told(Some(unlock));
        work();
        drop(unlock);
    })
}

/// The device of a handle.
pub(super) unsafe fn device_of<'a>(device: *const splat4d_device) -> Outcome<&'a Device> {
    // SAFETY: guaranteed by the host.
    Ok(&unsafe { shared("device", device) }?.device)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_stay_until_all_of_them_fit() {
        let mut kept = String::from("one\ntwo");
        let (mut text, mut length) = ([b'x'; 8], 0);
        // SAFETY: so many bytes are there.
        let mut ask = |kept: &mut String, size| unsafe {
            assert!(hand_over(kept, text.as_mut_ptr().cast(), size, &raw mut length).is_ok());
            (length, text)
        };
        assert_eq!(ask(&mut kept, 0), (7, *b"xxxxxxxx"));
        assert_eq!(ask(&mut kept, 7), (7, *b"one\ntw\0x"));
        assert_eq!(ask(&mut kept, 8), (7, *b"one\ntwo\0"));
        assert_eq!(ask(&mut kept, 8), (0, [0; 8]));
    }
}
