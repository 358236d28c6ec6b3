//! A minimal Vulkan host on plain `ash`: it creates its own instance, device, queue and memory, and lends
//! them to the engine.
#![allow(dead_code, reason = "each test binary uses its own part")]

use splat4d::embed::ash::{self, ext, khr, vk};
use splat4d::embed::{Features, HostBuffer, HostDevice, Requirements};
use splat4d::types::{Camera, Gaussians, Intrinsics, Pose};
use std::ffi::{CStr, c_void};
use std::sync::{Arc, Mutex};

/// Messages of the validation layer.
type Messages = Mutex<Vec<String>>;

pub struct Host {
    pub device: ash::Device,
    pub physical: vk::PhysicalDevice,
    pub family: u32,
    pub queue: vk::Queue,
    pub features: Features,
    /// Whether the device supports `VK_KHR_external_memory_fd`; if so, the extension is enabled.
    pub external_memory_fd: bool,
    pub instance: ash::Instance,
    pub entry: ash::Entry,
    pool: vk::CommandPool,
    messenger: Option<(ext::debug_utils::Instance, vk::DebugUtilsMessengerEXT)>,
    messages: Arc<Messages>,
}

/// # Safety
/// `data` must point to valid callback data, and the user data to a list of messages that is alive.
unsafe extern "system" fn on_message(
    _: vk::DebugUtilsMessageSeverityFlagsEXT,
    kind: vk::DebugUtilsMessageTypeFlagsEXT,
    data: *const vk::DebugUtilsMessengerCallbackDataEXT<'_>,
    messages: *mut c_void,
) -> vk::Bool32 {
    // SAFETY: the layer passes valid data, and the host keeps the messages alive.
    let (text, messages) =
        unsafe { (CStr::from_ptr((*data).p_message), &*(messages as *const Messages)) };
    if kind != vk::DebugUtilsMessageTypeFlagsEXT::GENERAL {
        messages.lock().unwrap().push(text.to_string_lossy().into_owned());
    }
    vk::FALSE
}

impl Host {
    /// Creates a host with every feature that the engine needs.
    pub fn new() -> Host {
        Host::with(Features::ALL)
    }

    /// Creates a host with these features. The validation layer is enabled if `SPLAT4D_VALIDATION` is 1.
    pub fn with(features: Features) -> Host {
        let validation = std::env::var("SPLAT4D_VALIDATION").is_ok_and(|value| value == "1");
        let messages = Arc::new(Messages::default());
        // SAFETY: valid Vulkan usage; everything that is pointed to lives long enough.
        unsafe {
            let entry = ash::Entry::load().expect("a Vulkan loader");
            let application = vk::ApplicationInfo::default().api_version(vk::API_VERSION_1_3);
            let layers = [c"VK_LAYER_KHRONOS_validation".as_ptr()];
            let extensions =
                [ext::debug_utils::NAME.as_ptr(), ext::validation_features::NAME.as_ptr()];
            let enabled = [vk::ValidationFeatureEnableEXT::SYNCHRONIZATION_VALIDATION];
            let mut synchronization =
                vk::ValidationFeaturesEXT::default().enabled_validation_features(&enabled);
            let mut info = vk::InstanceCreateInfo::default().application_info(&application);
            if validation {
                info = info
                    .enabled_layer_names(&layers)
                    .enabled_extension_names(&extensions)
                    .push_next(&mut synchronization);
            }
            let instance = entry.create_instance(&info, None).expect("an instance");
            let messenger = validation.then(|| {
                let functions = ext::debug_utils::Instance::new(&entry, &instance);
                let info = vk::DebugUtilsMessengerCreateInfoEXT::default()
                    .message_severity(
                        vk::DebugUtilsMessageSeverityFlagsEXT::WARNING
                            | vk::DebugUtilsMessageSeverityFlagsEXT::ERROR,
                    )
                    .message_type(
                        vk::DebugUtilsMessageTypeFlagsEXT::GENERAL
                            | vk::DebugUtilsMessageTypeFlagsEXT::VALIDATION
                            | vk::DebugUtilsMessageTypeFlagsEXT::PERFORMANCE,
                    )
                    .pfn_user_callback(Some(on_message))
                    .user_data(Arc::as_ptr(&messages) as *mut c_void);
                let handle = functions.create_debug_utils_messenger(&info, None).unwrap();
                (functions, handle)
            });
            let software = |device: &vk::PhysicalDevice| {
                let kind = instance.get_physical_device_properties(*device).device_type;
                kind == vk::PhysicalDeviceType::CPU
            };
            let devices = instance.enumerate_physical_devices().expect("devices");
            let physical = devices.into_iter().find(software).expect("a software driver");
            let families = instance.get_physical_device_queue_family_properties(physical);
            let family = families
                .iter()
                .position(|f| f.queue_flags.contains(vk::QueueFlags::COMPUTE))
                .expect("a family with compute") as u32;
            let mut vulkan12 = vk::PhysicalDeviceVulkan12Features::default();
            let mut vulkan13 = vk::PhysicalDeviceVulkan13Features::default();
            features.enable(&mut vulkan12, &mut vulkan13);
            let queues = [vk::DeviceQueueCreateInfo::default()
                .queue_family_index(family)
                .queue_priorities(&[1.0])];
            let offered = instance.enumerate_device_extension_properties(physical).unwrap();
            let fd = khr::external_memory_fd::NAME;
            let external_memory_fd =
                offered.iter().any(|e| e.extension_name_as_c_str().is_ok_and(|name| name == fd));
            let extensions = Vec::from_iter(external_memory_fd.then_some(fd.as_ptr()));
            let create = vk::DeviceCreateInfo::default()
                .queue_create_infos(&queues)
                .enabled_extension_names(&extensions)
                .push_next(&mut vulkan12)
                .push_next(&mut vulkan13);
            let device = instance.create_device(physical, &create, None).expect("a device");
            let features = Features::enabled_by(&create);
            let info = vk::CommandPoolCreateInfo::default()
                .queue_family_index(family)
                .flags(vk::CommandPoolCreateFlags::RESET_COMMAND_BUFFER);
            Host {
                pool: device.create_command_pool(&info, None).unwrap(),
                queue: device.get_device_queue(family, 0),
                device,
                physical,
                family,
                features,
                external_memory_fd,
                instance,
                entry,
                messenger,
                messages,
            }
        }
    }

    /// The handles and features that are lent to the engine.
    pub fn lend(&self) -> HostDevice {
        HostDevice {
            get_instance_proc_addr: self.entry.static_fn().get_instance_proc_addr,
            instance: self.instance.handle(),
            physical_device: self.physical,
            device: self.device.handle(),
            queue: self.queue,
            queue_family: self.family,
            features: self.features,
            external_memory_fd: self.external_memory_fd,
            queue_lock: None,
            on_drop: None,
        }
    }

    pub fn lacking(&self, requirements: &Requirements) -> Vec<String> {
        let loader = self.entry.static_fn().get_instance_proc_addr;
        // SAFETY: the handles belong together and are alive.
        unsafe { requirements.lacking(loader, self.instance.handle(), self.physical) }.unwrap()
    }

    pub fn commands(&self) -> vk::CommandBuffer {
        let info = vk::CommandBufferAllocateInfo::default()
            .command_pool(self.pool)
            .command_buffer_count(1);
        // SAFETY: the device is alive.
        unsafe { self.device.allocate_command_buffers(&info) }.unwrap()[0]
    }

    pub fn begin(&self, commands: vk::CommandBuffer) {
        let info = vk::CommandBufferBeginInfo::default()
            .flags(vk::CommandBufferUsageFlags::ONE_TIME_SUBMIT);
        // SAFETY: the device has finished the commands.
        unsafe { self.device.begin_command_buffer(commands, &info) }.unwrap();
    }

    /// Ends and submits the command buffer; the timeline semaphore reaches `value` when the commands
    /// finish.
    pub fn submit(&self, commands: vk::CommandBuffer, semaphore: vk::Semaphore, value: u64) {
        let buffers = [vk::CommandBufferSubmitInfo::default().command_buffer(commands)];
        let signals = [vk::SemaphoreSubmitInfo::default()
            .semaphore(semaphore)
            .value(value)
            .stage_mask(vk::PipelineStageFlags2::ALL_COMMANDS)];
        let submit = [vk::SubmitInfo2::default()
            .command_buffer_infos(&buffers)
            .signal_semaphore_infos(&signals)];
        // SAFETY: the commands are recorded, and only this thread uses the queue.
        unsafe {
            self.device.end_command_buffer(commands).unwrap();
            self.device.queue_submit2(self.queue, &submit, vk::Fence::null()).unwrap();
        }
    }

    pub fn wait(&self, semaphore: vk::Semaphore, value: u64) {
        let (semaphores, values) = ([semaphore], [value]);
        let info = vk::SemaphoreWaitInfo::default().semaphores(&semaphores).values(&values);
        // SAFETY: the semaphore is alive.
        unsafe { self.device.wait_semaphores(&info, u64::MAX) }.unwrap();
    }

    pub fn semaphore(&self) -> vk::Semaphore {
        let mut kind =
            vk::SemaphoreTypeCreateInfo::default().semaphore_type(vk::SemaphoreType::TIMELINE);
        let info = vk::SemaphoreCreateInfo::default().push_next(&mut kind);
        // SAFETY: the device is alive.
        unsafe { self.device.create_semaphore(&info, None) }.unwrap()
    }

    /// Creates a buffer of `bytes` bytes in a separate, host-visible allocation.
    pub fn buffer(&self, bytes: u64) -> Lent {
        let usage = vk::BufferUsageFlags::STORAGE_BUFFER
            | vk::BufferUsageFlags::TRANSFER_SRC
            | vk::BufferUsageFlags::TRANSFER_DST;
        self.buffer_for(bytes, usage)
    }

    pub fn buffer_for(&self, bytes: u64, usage: vk::BufferUsageFlags) -> Lent {
        let info = vk::BufferCreateInfo::default().size(bytes).usage(usage);
        // SAFETY: valid Vulkan usage.
        unsafe {
            let buffer = self.device.create_buffer(&info, None).unwrap();
            let needs = self.device.get_buffer_memory_requirements(buffer);
            let memory = self.allocate(needs, vk::MemoryPropertyFlags::HOST_VISIBLE);
            self.device.bind_buffer_memory(buffer, memory, 0).unwrap();
            let flags = vk::MemoryMapFlags::empty();
            let mapped = self.device.map_memory(memory, 0, vk::WHOLE_SIZE, flags).unwrap();
            Lent { buffer, memory, bytes, usage, mapped }
        }
    }

    /// Allocates zeroed, host-visible memory that another device can import.
    #[cfg(unix)]
    pub fn export(&self, bytes: u64) -> Exported {
        use std::os::fd::FromRawFd;
        let kind = vk::ExternalMemoryHandleTypeFlags::OPAQUE_FD;
        let mut export = vk::ExportMemoryAllocateInfo::default().handle_types(kind);
        // SAFETY: valid Vulkan usage; the file descriptor is new, and this function owns it.
        unsafe {
            let all = self.instance.get_physical_device_memory_properties(self.physical);
            let memory_type = all.memory_types[..all.memory_type_count as usize]
                .iter()
                .position(|t| t.property_flags.contains(vk::MemoryPropertyFlags::HOST_COHERENT))
                .expect("a memory type") as u32;
            let info = vk::MemoryAllocateInfo::default()
                .allocation_size(bytes)
                .memory_type_index(memory_type)
                .push_next(&mut export);
            let memory = self.device.allocate_memory(&info, None).unwrap();
            let flags = vk::MemoryMapFlags::empty();
            let mapped = self.device.map_memory(memory, 0, vk::WHOLE_SIZE, flags).unwrap();
            mapped.cast::<u8>().write_bytes(0, bytes as usize);
            let functions = khr::external_memory_fd::Device::new(&self.instance, &self.device);
            let info = vk::MemoryGetFdInfoKHR::default().memory(memory).handle_type(kind);
            let fd = functions.get_memory_fd(&info).unwrap();
            let fd = std::os::fd::OwnedFd::from_raw_fd(fd);
            Exported { fd, memory, memory_type, bytes, mapped }
        }
    }

    pub fn allocate(
        &self,
        needs: vk::MemoryRequirements,
        wanted: vk::MemoryPropertyFlags,
    ) -> vk::DeviceMemory {
        // SAFETY: valid Vulkan usage.
        unsafe {
            let all = self.instance.get_physical_device_memory_properties(self.physical);
            let index = (0..all.memory_type_count)
                .find(|&i| {
                    let flags = all.memory_types[i as usize].property_flags;
                    needs.memory_type_bits & 1 << i != 0 && flags.contains(wanted)
                })
                .expect("a memory type");
            let info = vk::MemoryAllocateInfo::default()
                .allocation_size(needs.size)
                .memory_type_index(index);
            self.device.allocate_memory(&info, None).unwrap()
        }
    }

    pub fn free(&self, lent: Lent) {
        // SAFETY: the device no longer uses it.
        unsafe {
            self.device.destroy_buffer(lent.buffer, None);
            self.device.free_memory(lent.memory, None);
        }
    }

    pub fn destroy_semaphore(&self, semaphore: vk::Semaphore) {
        // SAFETY: the device no longer uses it.
        unsafe { self.device.destroy_semaphore(semaphore, None) };
    }

    /// Fails if the validation layer has reported anything.
    pub fn assert_valid(&self) {
        let messages = std::mem::take(&mut *self.messages.lock().unwrap());
        assert!(messages.is_empty(), "the validation layer complains:\n{}", messages.join("\n"));
    }
}

impl Drop for Host {
    fn drop(&mut self) {
        // SAFETY: everything created from them has been destroyed; the validation layer reports what has
        // not.
        unsafe {
            self.device.destroy_command_pool(self.pool, None);
            self.device.destroy_device(None);
            if !std::thread::panicking() {
                self.assert_valid();
            }
            if let Some((functions, messenger)) = self.messenger.take() {
                functions.destroy_debug_utils_messenger(messenger, None);
            }
            self.instance.destroy_instance(None);
        }
    }
}

/// See [`Host::export`].
#[cfg(unix)]
pub struct Exported {
    pub fd: std::os::fd::OwnedFd,
    pub memory: vk::DeviceMemory,
    pub memory_type: u32,
    pub bytes: u64,
    pub mapped: *mut c_void,
}

/// A buffer that the host owns and lends to the engine.
pub struct Lent {
    pub buffer: vk::Buffer,
    pub memory: vk::DeviceMemory,
    pub bytes: u64,
    pub usage: vk::BufferUsageFlags,
    mapped: *mut c_void,
}

impl Lent {
    /// The whole buffer.
    pub fn whole(&self) -> HostBuffer {
        HostBuffer { buffer: self.buffer, offset: 0, bytes: self.bytes, usage: self.usage }
    }

    /// `count` floats of the buffer's content, from byte `offset`. The device must have finished with the
    /// buffer.
    pub fn floats(&self, offset: u64, count: usize) -> Vec<f32> {
        assert!(offset + 4 * count as u64 <= self.bytes);
        // SAFETY: the memory stays mapped, is coherent on software drivers, and the range is within it.
        unsafe {
            let from = self.mapped.cast::<u8>().add(offset as usize).cast::<f32>();
            std::slice::from_raw_parts(from, count).to_vec()
        }
    }
}

/// `count` Gaussians in front of [`camera`]; deterministic.
pub fn gaussians(count: usize) -> Gaussians {
    let noise = |i: usize, k: u32| {
        let x = (i as u32).wrapping_mul(2_654_435_761).wrapping_add(k.wrapping_mul(40_503));
        let x = (x ^ x >> 15).wrapping_mul(2_246_822_519);
        (x ^ x >> 13) as f32 / u32::MAX as f32 * 2.0 - 1.0
    };
    Gaussians {
        positions: (0..count).map(|i| [noise(i, 1), noise(i, 2), 3.0 + noise(i, 3)]).collect(),
        log_scales: (0..count)
            .map(|i| std::array::from_fn(|k| -2.2 + 0.3 * noise(i, 4 + k as u32)))
            .collect(),
        rotations: (0..count).map(|i| [1.0, noise(i, 7), noise(i, 8), noise(i, 9)]).collect(),
        opacity_logits: (0..count).map(|i| noise(i, 10)).collect(),
        sh_degree: 0,
        sh: (0..count).map(|i| std::array::from_fn(|k| noise(i, 11 + k as u32))).collect(),
        motion_logits: Vec::new(),
    }
}

pub fn camera(width: u32, height: u32) -> Camera {
    let f = f64::from(width);
    let (cx, cy) = (f / 2.0, f64::from(height) / 2.0);
    Camera {
        intrinsics: Intrinsics { fx: f, fy: f, cx, cy, width, height },
        view_from_world: Pose::IDENTITY,
    }
}
