//! Devices: ours, and the host's.

use super::call::{
    Outcome, call, claim, destroy, give, grows, input, read, read_or_zero, shared, splat4d_result,
    text, write, write_text,
};
use super::vulkan::{PFN_vkGetInstanceProcAddr, VkDevice, VkInstance, VkPhysicalDevice, VkQueue};
use crate::embed::{Features, HostDevice, QueueLock, Requirements};
use crate::gpu::{Device, DeviceKind, Request, Selector};
use std::ffi::{c_char, c_void};
use std::sync::{Mutex, PoisonError};

/// A Vulkan device. Everything made from it keeps what it needs of it: handles may be destroyed in
/// any order. Any number of threads may use a device at once.
pub struct splat4d_device {
    device: Device,
    /// What the validation layer has said and nobody has taken, line by line.
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

/// A function of a host's that is given the pointer registered with it. It must not throw and not
/// call splat4d with the handle under way.
pub type splat4d_callback = Option<unsafe extern "C" fn(user: *mut c_void)>;

/// A Vulkan device that a host has made.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct splat4d_host_device {
    /// sizeof(splat4d_host_device).
    pub struct_size: usize,
    /// The loader's.
    pub get_instance_proc_addr: PFN_vkGetInstanceProcAddr,
    /// Made for Vulkan 1.3 or newer.
    pub instance: VkInstance,
    /// One of the instance's.
    pub physical_device: VkPhysicalDevice,
    /// Made for Vulkan 1.3 or newer, with what splat4d_requirements lists.
    pub device: VkDevice,
    /// A queue of the device, for the engine's own submissions.
    pub queue: VkQueue,
    /// The queue's family, which must offer compute.
    pub queue_family: u32,
    /// SPLAT4D_FEATURE_*: what the device was made with.
    pub features: u32,
    /// Needed where anybody else uses the queue while the engine may submit: taken before, and given
    /// back after, on the thread that submits. Both or neither.
    pub queue_lock: splat4d_callback,
    /// As above.
    pub queue_unlock: splat4d_callback,
    /// Given to queue_lock and queue_unlock.
    pub queue_user: *mut c_void,
    /// Called once when nothing of the engine's uses the device any more, on whatever thread destroys
    /// the last of it; also where splat4d_device_adopt fails, unless with SPLAT4D_ERROR_POINTER or
    /// SPLAT4D_ERROR_STRUCT_SIZE.
    pub on_drop: splat4d_callback,
    /// Given to on_drop.
    pub on_drop_user: *mut c_void,
}
grows!(splat4d_host_device, on_drop_user: *mut c_void);

/// What a device must offer and be made with.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct splat4d_requirements {
    /// sizeof(splat4d_requirements).
    pub struct_size: usize,
    /// Of instance and device, packed as Vulkan packs it.
    pub api_version: u32,
    /// SPLAT4D_FEATURE_*: what must be enabled. No extension must be.
    pub features: u32,
    /// VkQueueFlags that the queue's family must offer.
    pub queue_flags: u32,
    /// VkSubgroupFeatureFlags in compute shaders.
    pub subgroup_operations: u32,
    /// maxComputeWorkGroupInvocations and `maxComputeWorkGroupSize[0]`, at least.
    pub workgroup_invocations: u32,
    /// maxComputeSharedMemorySize, at least; bytes.
    pub shared_memory: u32,
    /// maxPushConstantsSize, at least; bytes.
    pub push_constants: u32,
    /// maxPerStageDescriptorStorageBuffers and maxDescriptorSetStorageBuffers, at least.
    pub storage_buffers: u32,
}
grows!(splat4d_requirements, storage_buffers: u32);

/// What a device is.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct splat4d_device_info {
    /// sizeof(splat4d_device_info).
    pub struct_size: usize,
    /// Its name, with a zero at the end; cut off where it is longer.
    pub name: [c_char; 256],
    /// VkPhysicalDeviceType.
    pub kind: u32,
    /// Packed as Vulkan packs it.
    pub api_version: u32,
    /// Offsets of buffers that are adopted are multiples of this many bytes.
    pub storage_alignment: u64,
    /// The largest buffer that an op may use, bytes.
    pub storage_range: u64,
    /// Bytes of the engine's buffers alive now.
    pub bytes: u64,
    /// How many buffers and pools were made so far: in steady work it stands still.
    pub allocations: u64,
}
grows!(splat4d_device_info, allocations: u64);

/// Opens a device. `request` may be null for the best. `device` gets a handle, to be destroyed.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_device_open(
    request: *const splat4d_request,
    device: *mut *mut splat4d_device,
) -> splat4d_result {
    // SAFETY: the host's promise.
    call(|| unsafe {
        claim("device", device)?;
        let request = read_or_zero("request", request)?;
        let selector = match request.selector.is_null() {
            true => Selector::Best,
            false => Selector::from(text("request.selector", request.selector)?),
        };
        let validation = request.validation != 0;
        let opened = Device::open(&Request { selector, validation, limits: None })?;
        give(device, splat4d_device::new(opened));
        Ok(())
    })
}

/// What a device must offer and be made with, for hosts that make their own.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_requirements_query(
    requirements: *mut splat4d_requirements,
) -> splat4d_result {
    // SAFETY: the host's promise.
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

/// What a physical device lacks of the requirements, in words, separated by ", "; empty where the
/// engine can run on it. As much as fits goes to `text` (`size` bytes, with a zero at the end; null
/// where size is 0), and the length of all of it to `length`, which may be null.
///
/// The instance must be alive and of that loader, and the physical device one of its own.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_requirements_lacking(
    get_instance_proc_addr: PFN_vkGetInstanceProcAddr,
    instance: VkInstance,
    physical_device: VkPhysicalDevice,
    text: *mut c_char,
    size: usize,
    length: *mut usize,
) -> splat4d_result {
    // SAFETY: the host's promise.
    call(|| unsafe {
        let loader = get_instance_proc_addr.ok_or_else(no_loader)?;
        let missing = Requirements::query().lacking(loader, instance, physical_device)?;
        write_text(&missing.join(", "), text, size, length)
    })
}

/// Works on a device that the host has made. `device` gets a handle, to be destroyed. Nothing is
/// written to disk; messages of a validation layer go to the host.
///
/// The handles must belong together; instance and device must have been made for Vulkan 1.3 or newer,
/// the device with every feature that `features` claims. The loader stays loaded, and instance and
/// device alive, until on_drop is called, or without it until everything made from the device is
/// destroyed. Nobody uses the queue while the engine does: either it is the engine's alone, or every
/// other use takes the lock that queue_lock takes; vkDeviceWaitIdle uses all queues.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_device_adopt(
    host: *const splat4d_host_device,
    device: *mut *mut splat4d_device,
) -> splat4d_result {
    // SAFETY: the host's promise.
    call(|| unsafe {
        claim("device", device)?;
        let host = read("host", host)?;
        // From here on the host is told, however this ends.
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

/// What the device is, and what the engine holds on it.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_device_get_info(
    device: *const splat4d_device,
    info: *mut splat4d_device_info,
) -> splat4d_result {
    // SAFETY: the host's promise.
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

/// Takes what the validation layer has said since it was last taken, line by line: empty where it has
/// said nothing, without the layer, and on a host's device. `text`, `size` and `length` as for
/// splat4d_requirements_lacking; nothing is taken where not all of it fits.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_device_take_validation_messages(
    device: *const splat4d_device,
    text: *mut c_char,
    size: usize,
    length: *mut usize,
) -> splat4d_result {
    // SAFETY: the host's promise.
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

/// Destroys the handle; null is fine. The device goes when the last that was made from it is gone.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_device_destroy(device: *mut splat4d_device) {
    // SAFETY: the host's promise.
    unsafe { destroy(device) };
}

/// Writes a text, which is gone where all of it fits.
unsafe fn hand_over(
    kept: &mut String,
    to: *mut c_char,
    size: usize,
    length: *mut usize,
) -> Outcome {
    // SAFETY: the host's promise.
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

/// A function of the host's with its pointer.
#[derive(Clone, Copy)]
struct Callback(unsafe extern "C" fn(user: *mut c_void), *mut c_void);

// SAFETY: the host has promised that its functions may be called on any thread.
unsafe impl Send for Callback {}
// SAFETY: as above.
unsafe impl Sync for Callback {}

impl Callback {
    fn call(&self) {
        // SAFETY: the host's function, with the host's pointer.
        unsafe { (self.0)(self.1) };
    }
}

/// Calls the host back once, when it is dropped.
pub(super) struct Told(Option<Callback>);

impl Told {
    pub(super) fn new(function: splat4d_callback, user: *mut c_void) -> Told {
        Told(function.map(|function| Callback(function, user)))
    }

    /// As the engine keeps it.
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
        // Given back even if the work panics.
        let unlock = Told(Some(unlock));
        work();
        drop(unlock);
    })
}

/// The device of a handle.
pub(super) unsafe fn device_of<'a>(device: *const splat4d_device) -> Outcome<&'a Device> {
    // SAFETY: the host's promise.
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
