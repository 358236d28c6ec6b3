//! The logical device with its queue, allocator, limits and pipeline cache.

use super::cache::PipelineCache;
use super::instance::{DeviceInfo, Instance};
use super::ledger::Ledger;
use super::queue::Queue;
use super::requirements::{Requirements, unsupported};
use super::vk_error;
use crate::error::{Error, Result};
use ash::vk;
use gpu_allocator::vulkan::{Allocator, AllocatorCreateDesc};
use std::mem::ManuallyDrop;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};

/// The device limits that kernels and ops must respect. A test may lower any of them to reach a
/// boundary case with small data.
#[derive(Clone, Copy, Debug)]
pub struct Limits {
    /// Maximum number of workgroups along one axis of a grid; larger grids are folded into a second
    /// axis.
    pub groups: u32,
    /// Maximum size of one storage binding, bytes.
    pub storage_range: u64,
    /// Required alignment of a storage binding's offset, bytes.
    pub storage_alignment: u64,
    /// Nanoseconds per timestamp tick; 0 if the queue has no timestamps.
    pub timestamp_period: f32,
}

/// A callback, called when the engine has dropped every object that uses a resource of the host.
pub(crate) struct OnDrop(pub(crate) Option<Box<dyn FnOnce() + Send + Sync>>);

impl Drop for OnDrop {
    fn drop(&mut self) {
        if let Some(call) = self.0.take() {
            call();
        }
    }
}

/// The smallest subgroup for which the kernels are written.
const LEAST_SUBGROUP: u32 = 4;
/// The largest number of invocations in a workgroup of the crate's kernels.
const LARGEST_WORKGROUP: u32 = 256;

/// A logical device. Everything made from it holds an `Arc` of it.
pub(crate) struct Context {
    pub(super) raw: ash::Device,
    pub(super) queue: Queue,
    pub(super) family: u32,
    pub(super) allocator: ManuallyDrop<Mutex<Allocator>>,
    pub(super) cache: PipelineCache,
    pub(crate) info: DeviceInfo,
    pub(crate) limits: Limits,
    pub(super) max_subgroup: u32,
    /// The subgroup sizes that a pipeline may require, ascending; empty if the driver does not let compute
    /// shaders require any.
    pub(crate) subgroup_sizes: Vec<u32>,
    /// Whether memory of other devices and processes can be imported by file descriptor
    /// (`VK_KHR_external_memory_fd`).
    pub(super) imports_fd: bool,
    physical: vk::PhysicalDevice,
    pub(crate) ledger: Arc<Ledger>,
    allocations: AtomicU64,
    pub(super) instance: Arc<Instance>,
    /// The host's callback if the device is a host's. Declared last, so that it is called after all
    /// other fields are dropped.
    host: Option<OnDrop>,
}

/// A logical device to build a context around.
pub(super) struct Opened {
    pub(super) raw: ash::Device,
    pub(super) physical: vk::PhysicalDevice,
    pub(super) queue: Queue,
    pub(super) family: u32,
    pub(super) imports_fd: bool,
    pub(super) host: Option<OnDrop>,
}

impl Context {
    pub(crate) fn open(
        instance: Arc<Instance>,
        physical: vk::PhysicalDevice,
        info: DeviceInfo,
    ) -> Result<Context> {
        let requirements = Requirements::query();
        requirements.check(&instance.raw, physical, &info.name)?;
        let family = compute_family(&instance, physical)?;
        let priorities = [1.0];
        let queues = [vk::DeviceQueueCreateInfo::default()
            .queue_family_index(family)
            .queue_priorities(&priorities)];
        let mut vulkan12 = vk::PhysicalDeviceVulkan12Features::default();
        let mut vulkan13 = vk::PhysicalDeviceVulkan13Features::default();
        requirements.features.enable(&mut vulkan12, &mut vulkan13);
        // SAFETY: a plain query.
        let offered = unsafe { instance.raw.enumerate_device_extension_properties(physical) }
            .map_err(vk_error("vkEnumerateDeviceExtensionProperties"))?;
        let fd = ash::khr::external_memory_fd::NAME;
        let imports_fd =
            offered.iter().any(|e| e.extension_name_as_c_str().is_ok_and(|name| name == fd));
        let extensions: &[_] = if imports_fd { &[fd.as_ptr()] } else { &[] };
        let create = vk::DeviceCreateInfo::default()
            .queue_create_infos(&queues)
            .enabled_extension_names(extensions)
            .push_next(&mut vulkan12)
            .push_next(&mut vulkan13);
        // SAFETY: the features were checked, and what `create` points at outlives the call.
        let raw = unsafe { instance.raw.create_device(physical, &create, None) }
            .map_err(vk_error("vkCreateDevice"))?;
        // SAFETY: the family and its first queue were asked for above.
        let queue = Queue::new(unsafe { raw.get_device_queue(family, 0) }, None);
        Context::around(
            instance,
            Opened { raw, physical, queue, family, imports_fd, host: None },
            info,
        )
    }

    /// Builds the context of a logical device. On an error, a device that the engine created is
    /// destroyed.
    pub(super) fn around(
        instance: Arc<Instance>,
        opened: Opened,
        info: DeviceInfo,
    ) -> Result<Context> {
        let Opened { raw, physical, queue, family, imports_fd, host } = opened;
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
                if host.is_none() {
                    // SAFETY: nothing was made from the device yet.
                    unsafe { raw.destroy_device(None) };
                }
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
        let requires =
            vulkan13.required_subgroup_size_stages.contains(vk::ShaderStageFlags::COMPUTE);
        let groups = vulkan13.max_compute_workgroup_subgroups;
        let subgroup_sizes = (0..32)
            .map(|exponent| 1u32 << exponent)
            .filter(|&size| requires && (vulkan13.min_subgroup_size..=max_subgroup).contains(&size))
            .filter(|&size| size >= LEAST_SUBGROUP && LARGEST_WORKGROUP.div_ceil(size) <= groups)
            .collect();
        // SAFETY: a plain query.
        let families =
            unsafe { instance.raw.get_physical_device_queue_family_properties(physical) };
        let timestamps = families[family as usize].timestamp_valid_bits > 0;
        let limits = Limits {
            groups: core.max_compute_work_group_count[0]
                .min(core.max_compute_work_group_count[1])
                .min(65_535),
            storage_range: u64::from(core.max_storage_buffer_range),
            storage_alignment: core.min_storage_buffer_offset_alignment.max(4),
            timestamp_period: if timestamps { core.timestamp_period } else { 0.0 },
        };
        let cache = match host {
            None => PipelineCache::open(&raw, &core_properties),
            Some(_) => PipelineCache::in_memory(&raw),
        };
        Ok(Context {
            raw,
            queue,
            family,
            allocator: ManuallyDrop::new(Mutex::new(allocator)),
            cache,
            info,
            limits,
            max_subgroup,
            subgroup_sizes,
            imports_fd,
            physical,
            ledger: Arc::default(),
            allocations: AtomicU64::new(0),
            instance,
            host,
        })
    }

    /// The messages of the validation layer since the last call.
    pub(crate) fn take_messages(&self) -> Vec<String> {
        std::mem::take(&mut *self.instance.messages.lock().expect("no holder panics"))
    }

    /// Bytes of device-local memory left for buffers: measured against the budget that the driver
    /// reports for this process, or against the size of the heap if the driver reports none.
    pub(crate) fn free_memory(&self) -> u64 {
        let raw = &self.instance.raw;
        let budget = ash::ext::memory_budget::NAME;
        // SAFETY: plain queries of a device of this instance; the chain lives until the call is over,
        // and holds the budget only where the device knows of it.
        let (memory, budgets) = unsafe {
            let offered =
                raw.enumerate_device_extension_properties(self.physical).unwrap_or_default();
            let mut budgets = vk::PhysicalDeviceMemoryBudgetPropertiesEXT::default();
            let mut memory = vk::PhysicalDeviceMemoryProperties2::default();
            let told = offered
                .iter()
                .any(|e| e.extension_name_as_c_str().is_ok_and(|name| name == budget));
            if told {
                memory = memory.push_next(&mut budgets);
            }
            raw.get_physical_device_memory_properties2(self.physical, &mut memory);
            let memory = memory.memory_properties;
            (memory, told.then_some((budgets.heap_budget, budgets.heap_usage)))
        };
        let own =
            |i: &usize| memory.memory_heaps[*i].flags.contains(vk::MemoryHeapFlags::DEVICE_LOCAL);
        let heaps = (0..memory.memory_heap_count as usize).filter(own);
        let Some(heap) = heaps.max_by_key(|&i| memory.memory_heaps[i].size) else { return 0 };
        match budgets {
            Some((budget, usage)) => budget[heap].saturating_sub(usage[heap]),
            None => memory.memory_heaps[heap].size.saturating_sub(self.ledger.bytes().0),
        }
    }

    /// The number of buffers, descriptor pools, query pools and command pools created so far.
    pub(crate) fn allocations(&self) -> u64 {
        self.allocations.load(Ordering::Relaxed)
    }

    /// Counts the creation of an object other than a buffer.
    pub(super) fn count_object(&self) {
        self.allocations.fetch_add(1, Ordering::Relaxed);
    }

    /// Whether the device was created by a host.
    pub(crate) fn is_adopted(&self) -> bool {
        self.host.is_some()
    }
}

impl Drop for Context {
    fn drop(&mut self) {
        // SAFETY: everything made from the device holds an `Arc` of this context, so nothing is in
        // flight and nothing is left but the cache and the allocator, which go before the device.
        // A host's device stays: others may use its queues right now.
        unsafe {
            if self.host.is_none() {
                let _ = self.raw.device_wait_idle();
            }
            self.cache.close(&self.raw);
            ManuallyDrop::drop(&mut self.allocator);
            if self.host.is_none() {
                self.raw.destroy_device(None);
            }
        }
    }
}

fn compute_family(instance: &Instance, physical: vk::PhysicalDevice) -> Result<u32> {
    // SAFETY: a plain query.
    let families = unsafe { instance.raw.get_physical_device_queue_family_properties(physical) };
    families
        .iter()
        .position(|family| family.queue_flags.contains(vk::QueueFlags::COMPUTE))
        .map(|index| index as u32)
        .ok_or_else(|| unsupported("a queue family with compute".into()))
}
