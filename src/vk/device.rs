//! The logical device and what belongs to it: queue, allocator, limits, pipeline cache.

use super::cache::PipelineCache;
use super::instance::{DeviceInfo, Instance};
use super::vk_error;
use crate::error::{Error, Result};
use ash::vk;
use gpu_allocator::vulkan::{Allocator, AllocatorCreateDesc};
use std::mem::ManuallyDrop;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};

/// What kernels and ops have to stay within. A test may lower any of them to reach a boundary with
/// small data.
#[derive(Clone, Copy, Debug)]
pub struct Limits {
    /// Workgroups along one axis of a grid; beyond it grids are folded.
    pub groups: u32,
    /// Bytes of one storage binding.
    pub storage_range: u64,
    /// Alignment of a storage binding's offset.
    pub storage_alignment: u64,
    /// Nanoseconds of one timestamp tick; 0 where the queue has no timestamps.
    pub timestamp_period: f32,
}

/// A logical device. Everything made from it holds an `Arc` of it.
pub(crate) struct Context {
    pub(super) raw: ash::Device,
    pub(super) queue: Mutex<vk::Queue>,
    pub(super) family: u32,
    pub(super) allocator: ManuallyDrop<Mutex<Allocator>>,
    pub(super) cache: PipelineCache,
    pub(crate) info: DeviceInfo,
    pub(crate) limits: Limits,
    pub(super) max_subgroup: u32,
    bytes_now: AtomicU64,
    bytes_peak: AtomicU64,
    instance: Arc<Instance>,
}

impl Context {
    pub(crate) fn open(
        instance: Arc<Instance>,
        physical: vk::PhysicalDevice,
        info: DeviceInfo,
    ) -> Result<Context> {
        require_features(&instance, physical, &info)?;
        let family = compute_family(&instance, physical, &info)?;
        let priorities = [1.0];
        let queues = [vk::DeviceQueueCreateInfo::default()
            .queue_family_index(family.index)
            .queue_priorities(&priorities)];
        let mut vulkan12 = vk::PhysicalDeviceVulkan12Features::default()
            .timeline_semaphore(true)
            .scalar_block_layout(true);
        let mut vulkan13 = vk::PhysicalDeviceVulkan13Features::default()
            .synchronization2(true)
            .compute_full_subgroups(true)
            .subgroup_size_control(true);
        let create = vk::DeviceCreateInfo::default()
            .queue_create_infos(&queues)
            .push_next(&mut vulkan12)
            .push_next(&mut vulkan13);
        // SAFETY: the features were checked, and what `create` points at outlives the call.
        let raw = unsafe { instance.raw.create_device(physical, &create, None) }
            .map_err(vk_error("vkCreateDevice"))?;
        // SAFETY: the family and its first queue were asked for above.
        let queue = unsafe { raw.get_device_queue(family.index, 0) };

        let allocator = Allocator::new(&AllocatorCreateDesc {
            instance: instance.raw.clone(),
            device: raw.clone(),
            physical_device: physical,
            debug_settings: Default::default(),
            buffer_device_address: false,
            allocation_sizes: Default::default(),
        });
        let allocator = match allocator {
            Ok(allocator) => allocator,
            Err(error) => {
                // SAFETY: nothing was made from the device yet.
                unsafe { raw.destroy_device(None) };
                return Err(Error::NoDevice(format!(
                    "no memory allocator for {}: {error}",
                    info.name
                )));
            }
        };
        let mut vulkan13 = vk::PhysicalDeviceVulkan13Properties::default();
        let mut properties = vk::PhysicalDeviceProperties2::default().push_next(&mut vulkan13);
        // SAFETY: the chain's structures live until the end of the function.
        unsafe { instance.raw.get_physical_device_properties2(physical, &mut properties) };
        let core_properties = properties.properties;
        let core = core_properties.limits;
        let max_subgroup = vulkan13.max_subgroup_size.max(1);
        let limits = Limits {
            groups: core.max_compute_work_group_count[0]
                .min(core.max_compute_work_group_count[1])
                .min(65_535),
            storage_range: u64::from(core.max_storage_buffer_range),
            storage_alignment: core.min_storage_buffer_offset_alignment.max(4),
            timestamp_period: if family.timestamps { core.timestamp_period } else { 0.0 },
        };
        let cache = PipelineCache::open(&raw, &core_properties);
        Ok(Context {
            raw,
            queue: Mutex::new(queue),
            family: family.index,
            allocator: ManuallyDrop::new(Mutex::new(allocator)),
            cache,
            info,
            limits,
            max_subgroup,
            bytes_now: AtomicU64::new(0),
            bytes_peak: AtomicU64::new(0),
            instance,
        })
    }

    /// What the validation layer has said since the last call.
    pub(crate) fn take_messages(&self) -> Vec<String> {
        std::mem::take(&mut *self.instance.messages.lock().expect("no holder panics"))
    }

    pub(super) fn count_allocation(&self, bytes: u64) {
        let now = self.bytes_now.fetch_add(bytes, Ordering::Relaxed) + bytes;
        self.bytes_peak.fetch_max(now, Ordering::Relaxed);
    }

    pub(super) fn count_free(&self, bytes: u64) {
        self.bytes_now.fetch_sub(bytes, Ordering::Relaxed);
    }

    /// Bytes of buffers now and at most so far.
    pub(crate) fn memory(&self) -> (u64, u64) {
        (self.bytes_now.load(Ordering::Relaxed), self.bytes_peak.load(Ordering::Relaxed))
    }
}

impl Drop for Context {
    fn drop(&mut self) {
        // SAFETY: everything made from the device holds an `Arc` of this context, so nothing is in
        // flight and nothing is left but the cache and the allocator, which go before the device.
        unsafe {
            let _ = self.raw.device_wait_idle();
            self.cache.close(&self.raw);
            ManuallyDrop::drop(&mut self.allocator);
            self.raw.destroy_device(None);
        }
    }
}

struct Family {
    index: u32,
    timestamps: bool,
}

fn compute_family(
    instance: &Instance,
    physical: vk::PhysicalDevice,
    info: &DeviceInfo,
) -> Result<Family> {
    // SAFETY: a plain query.
    let families = unsafe { instance.raw.get_physical_device_queue_family_properties(physical) };
    families
        .iter()
        .enumerate()
        .find(|(_, family)| family.queue_flags.contains(vk::QueueFlags::COMPUTE))
        .map(|(index, family)| Family {
            index: index as u32,
            timestamps: family.timestamp_valid_bits > 0,
        })
        .ok_or_else(|| Error::Unsupported {
            kernel: "the engine".into(),
            missing: format!("{} has no compute queue", info.name),
        })
}

fn require_features(
    instance: &Instance,
    physical: vk::PhysicalDevice,
    info: &DeviceInfo,
) -> Result<()> {
    let mut vulkan12 = vk::PhysicalDeviceVulkan12Features::default();
    let mut vulkan13 = vk::PhysicalDeviceVulkan13Features::default();
    let mut features =
        vk::PhysicalDeviceFeatures2::default().push_next(&mut vulkan12).push_next(&mut vulkan13);
    // SAFETY: the chain's structures live until the end of the function.
    unsafe { instance.raw.get_physical_device_features2(physical, &mut features) };
    let mut vulkan11 = vk::PhysicalDeviceVulkan11Properties::default();
    let mut properties = vk::PhysicalDeviceProperties2::default().push_next(&mut vulkan11);
    // SAFETY: as above.
    unsafe { instance.raw.get_physical_device_properties2(physical, &mut properties) };
    let subgroup = vk::SubgroupFeatureFlags::BASIC
        | vk::SubgroupFeatureFlags::BALLOT
        | vk::SubgroupFeatureFlags::ARITHMETIC
        | vk::SubgroupFeatureFlags::SHUFFLE;
    let needs = [
        (vulkan12.timeline_semaphore == vk::TRUE, "timeline semaphores"),
        (vulkan12.scalar_block_layout == vk::TRUE, "scalar block layout"),
        (vulkan13.synchronization2 == vk::TRUE, "synchronization2"),
        (vulkan13.subgroup_size_control == vk::TRUE, "subgroup size control"),
        (vulkan13.compute_full_subgroups == vk::TRUE, "full compute subgroups"),
        (
            vulkan11.subgroup_supported_operations.contains(subgroup)
                && vulkan11.subgroup_supported_stages.contains(vk::ShaderStageFlags::COMPUTE),
            "subgroup ballot, arithmetic and shuffle in compute shaders",
        ),
    ];
    let missing: Vec<_> = needs.iter().filter(|(has, _)| !has).map(|(_, what)| *what).collect();
    if missing.is_empty() {
        return Ok(());
    }
    Err(Error::Unsupported {
        kernel: "the engine".into(),
        missing: format!("{} lacks {}", info.name, missing.join(", ")),
    })
}
