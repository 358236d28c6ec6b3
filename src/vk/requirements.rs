//! The requirements of the engine on a device: for opening a device, and for hosts that create
//! their own.

use crate::error::{Error, Result};
use ash::vk;
use std::ffi::CStr;

/// A set of device features; [`Requirements`] lists the required ones.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Features {
    /// Of Vulkan 1.2.
    pub timeline_semaphore: bool,
    /// Of Vulkan 1.2.
    pub scalar_block_layout: bool,
    /// Of Vulkan 1.3.
    pub synchronization2: bool,
    /// Of Vulkan 1.3.
    pub subgroup_size_control: bool,
    /// Of Vulkan 1.3.
    pub compute_full_subgroups: bool,
}

impl Features {
    /// All features.
    pub const ALL: Features = Features {
        timeline_semaphore: true,
        scalar_block_layout: true,
        synchronization2: true,
        subgroup_size_control: true,
        compute_full_subgroups: true,
    };

    fn named(&self) -> [(bool, &'static str); 5] {
        [
            (self.timeline_semaphore, "timelineSemaphore"),
            (self.scalar_block_layout, "scalarBlockLayout"),
            (self.synchronization2, "synchronization2"),
            (self.subgroup_size_control, "subgroupSizeControl"),
            (self.compute_full_subgroups, "computeFullSubgroups"),
        ]
    }

    /// The Vulkan names of the features that are in `needed` and not in this set.
    pub fn lacking(&self, needed: &Features) -> Vec<&'static str> {
        let pairs = self.named().into_iter().zip(needed.named());
        pairs.filter(|((has, _), (needs, _))| *needs && !has).map(|((_, name), _)| name).collect()
    }

    /// Enables these features in the feature structures of a device to be created; other features
    /// keep their values.
    pub fn enable(
        &self,
        vulkan12: &mut vk::PhysicalDeviceVulkan12Features<'_>,
        vulkan13: &mut vk::PhysicalDeviceVulkan13Features<'_>,
    ) {
        vulkan12.timeline_semaphore |= u32::from(self.timeline_semaphore);
        vulkan12.scalar_block_layout |= u32::from(self.scalar_block_layout);
        vulkan13.synchronization2 |= u32::from(self.synchronization2);
        vulkan13.subgroup_size_control |= u32::from(self.subgroup_size_control);
        vulkan13.compute_full_subgroups |= u32::from(self.compute_full_subgroups);
    }

    /// Enables these features in an existing `VkDeviceCreateInfo` chain. Features whose structures
    /// are in the chain are set there; for the others, structures from `links` are added to the
    /// chain. For hosts whose device is created by a library that builds its own chain.
    ///
    /// # Safety
    /// The chain behind `p_next` is valid, and its structures may be written.
    pub unsafe fn enable_in<'a>(
        &self,
        create: &mut vk::DeviceCreateInfo<'a>,
        links: &'a mut FeatureLinks,
    ) {
        // SAFETY: guaranteed by the caller.
        let switches = unsafe { switches(create) };
        let mut absent = [false; 5];
        for (k, (wanted, _)) in self.named().into_iter().enumerate().filter(|(_, f)| f.0) {
            match switches[k].is_null() {
                true => absent[k] = wanted,
                // SAFETY: a field of a structure of the chain, which may be written.
                false => unsafe { *switches[k] = vk::TRUE },
            }
        }
        let [timeline, scalar, synchronization, size, full] = absent;
        let mut info = *create;
        if timeline {
            links.timeline.timeline_semaphore = vk::TRUE;
            info = info.push_next(&mut links.timeline);
        }
        if scalar {
            links.scalar.scalar_block_layout = vk::TRUE;
            info = info.push_next(&mut links.scalar);
        }
        if synchronization {
            links.synchronization.synchronization2 = vk::TRUE;
            info = info.push_next(&mut links.synchronization);
        }
        // One structure holds both features.
        if size || full {
            links.subgroups.subgroup_size_control = u32::from(size);
            links.subgroups.compute_full_subgroups = u32::from(full);
            info = info.push_next(&mut links.subgroups);
        }
        *create = info;
    }

    /// The features that a `VkDeviceCreateInfo` enables, read from its chain: the structures of
    /// Vulkan 1.2 and 1.3, and those of the extensions that these versions replaced.
    ///
    /// # Safety
    /// The chain behind `p_next` is valid.
    pub unsafe fn enabled_by(create: &vk::DeviceCreateInfo<'_>) -> Features {
        // SAFETY: guaranteed by the caller.
        let switches = unsafe { switches(create) };
        let on = switches.map(|switch| {
            // SAFETY: null, or a field of a structure of the chain, which nobody writes now.
            unsafe { switch.as_ref() }.is_some_and(|&on| on != vk::FALSE)
        });
        let [timeline_semaphore, scalar_block_layout, synchronization2, size, full] = on;
        Features {
            timeline_semaphore,
            scalar_block_layout,
            synchronization2,
            subgroup_size_control: size,
            compute_full_subgroups: full,
        }
    }
}

/// Storage for the structures that [`Features::enable_in`] may add to a chain; it must not move
/// until the device is created.
#[derive(Default)]
pub struct FeatureLinks {
    timeline: vk::PhysicalDeviceTimelineSemaphoreFeatures<'static>,
    scalar: vk::PhysicalDeviceScalarBlockLayoutFeatures<'static>,
    synchronization: vk::PhysicalDeviceSynchronization2Features<'static>,
    subgroups: vk::PhysicalDeviceSubgroupSizeControlFeatures<'static>,
}

/// Pointers to each feature's switch in a chain of structures, in the order of [`Features`]; null
/// if no structure of the chain has it.
///
/// # Safety
/// The chain behind `p_next` is valid.
unsafe fn switches(create: &vk::DeviceCreateInfo<'_>) -> [*mut vk::Bool32; 5] {
    let [mut timeline, mut scalar, mut synchronization, mut size, mut full] =
        [std::ptr::null_mut(); 5];
    let mut next = create.p_next.cast_mut();
    while !next.is_null() {
        let at = next.cast::<vk::BaseOutStructure<'_>>();
        // SAFETY: the chain is valid, so each link begins with type and next, and is what its type
        // says.
        unsafe {
            match (*at).s_type {
                vk::StructureType::PHYSICAL_DEVICE_VULKAN_1_2_FEATURES => {
                    let link = next.cast::<vk::PhysicalDeviceVulkan12Features<'_>>();
                    timeline = &raw mut (*link).timeline_semaphore;
                    scalar = &raw mut (*link).scalar_block_layout;
                }
                vk::StructureType::PHYSICAL_DEVICE_VULKAN_1_3_FEATURES => {
                    let link = next.cast::<vk::PhysicalDeviceVulkan13Features<'_>>();
                    synchronization = &raw mut (*link).synchronization2;
                    size = &raw mut (*link).subgroup_size_control;
                    full = &raw mut (*link).compute_full_subgroups;
                }
                vk::StructureType::PHYSICAL_DEVICE_TIMELINE_SEMAPHORE_FEATURES => {
                    let link = next.cast::<vk::PhysicalDeviceTimelineSemaphoreFeatures<'_>>();
                    timeline = &raw mut (*link).timeline_semaphore;
                }
                vk::StructureType::PHYSICAL_DEVICE_SCALAR_BLOCK_LAYOUT_FEATURES => {
                    let link = next.cast::<vk::PhysicalDeviceScalarBlockLayoutFeatures<'_>>();
                    scalar = &raw mut (*link).scalar_block_layout;
                }
                vk::StructureType::PHYSICAL_DEVICE_SYNCHRONIZATION_2_FEATURES => {
                    let link = next.cast::<vk::PhysicalDeviceSynchronization2Features<'_>>();
                    synchronization = &raw mut (*link).synchronization2;
                }
                vk::StructureType::PHYSICAL_DEVICE_SUBGROUP_SIZE_CONTROL_FEATURES => {
                    let link = next.cast::<vk::PhysicalDeviceSubgroupSizeControlFeatures<'_>>();
                    size = &raw mut (*link).subgroup_size_control;
                    full = &raw mut (*link).compute_full_subgroups;
                }
                _ => {}
            }
            next = (*at).p_next.cast();
        }
    }
    [timeline, scalar, synchronization, size, full]
}

/// The properties, features and limits that a device must have.
#[derive(Clone, Copy, Debug)]
pub struct Requirements {
    /// Minimum Vulkan version of instance and device, in Vulkan's packed encoding.
    pub api_version: u32,
    /// Device extensions that must be enabled.
    pub extensions: &'static [&'static CStr],
    /// Device extensions that the engine uses if they are enabled.
    pub optional_extensions: &'static [&'static CStr],
    /// Device features that must be enabled.
    pub features: Features,
    /// Capabilities that the queue's family must have.
    pub queue_flags: vk::QueueFlags,
    /// Subgroup operations that compute shaders must support.
    pub subgroup_operations: vk::SubgroupFeatureFlags,
    /// Minimum of `maxComputeWorkGroupInvocations` and `maxComputeWorkGroupSize[0]`.
    pub workgroup_invocations: u32,
    /// Minimum of `maxComputeSharedMemorySize`, bytes.
    pub shared_memory: u32,
    /// Minimum of `maxPushConstantsSize`, bytes.
    pub push_constants: u32,
    /// Minimum of `maxPerStageDescriptorStorageBuffers` and `maxDescriptorSetStorageBuffers`.
    pub storage_buffers: u32,
}

impl Requirements {
    /// The requirements of all kernels of the crate.
    ///
    /// ```
    /// let needed = splat4d::embed::Requirements::query();
    /// assert!(needed.extensions.is_empty() && needed.features.timeline_semaphore);
    /// ```
    pub fn query() -> Requirements {
        Requirements {
            api_version: vk::API_VERSION_1_3,
            extensions: &[],
            optional_extensions: &[ash::khr::external_memory_fd::NAME],
            features: Features::ALL,
            queue_flags: vk::QueueFlags::COMPUTE,
            subgroup_operations: vk::SubgroupFeatureFlags::BASIC
                | vk::SubgroupFeatureFlags::BALLOT
                | vk::SubgroupFeatureFlags::ARITHMETIC
                | vk::SubgroupFeatureFlags::SHUFFLE,
            workgroup_invocations: 256,
            shared_memory: 32 * 1024,
            push_constants: 128,
            storage_buffers: 30,
        }
    }

    /// Descriptions of the requirements that a physical device lacks; empty if nothing is missing.
    pub(super) fn lacked_by(
        &self,
        instance: &ash::Instance,
        physical: vk::PhysicalDevice,
    ) -> Vec<String> {
        // The version is checked first: the other queries need Vulkan 1.3.
        // SAFETY: here and below plain queries of a device of this instance; the chains' structures
        // live until the end of the function.
        let version = unsafe { instance.get_physical_device_properties(physical) }.api_version;
        if version < self.api_version {
            let (major, minor) = (vk::api_version_major(version), vk::api_version_minor(version));
            return vec![format!("Vulkan 1.3 (it has {major}.{minor})")];
        }
        let mut vulkan12 = vk::PhysicalDeviceVulkan12Features::default();
        let mut vulkan13 = vk::PhysicalDeviceVulkan13Features::default();
        let mut features = vk::PhysicalDeviceFeatures2::default()
            .push_next(&mut vulkan12)
            .push_next(&mut vulkan13);
        let mut vulkan11 = vk::PhysicalDeviceVulkan11Properties::default();
        let mut properties = vk::PhysicalDeviceProperties2::default().push_next(&mut vulkan11);
        // SAFETY: as above.
        unsafe {
            instance.get_physical_device_features2(physical, &mut features);
            instance.get_physical_device_properties2(physical, &mut properties);
        }
        let limits = properties.properties.limits;
        let has = Features {
            timeline_semaphore: vulkan12.timeline_semaphore != 0,
            scalar_block_layout: vulkan12.scalar_block_layout != 0,
            synchronization2: vulkan13.synchronization2 != 0,
            subgroup_size_control: vulkan13.subgroup_size_control != 0,
            compute_full_subgroups: vulkan13.compute_full_subgroups != 0,
        };
        let lacking = has.lacking(&self.features);
        let mut missing: Vec<String> =
            lacking.into_iter().map(|name| format!("the feature {name}")).collect();
        let subgroup = self.subgroup_operations;
        if !(vulkan11.subgroup_supported_operations.contains(subgroup)
            && vulkan11.subgroup_supported_stages.contains(vk::ShaderStageFlags::COMPUTE))
        {
            missing.push("subgroup ballot, arithmetic and shuffle in compute shaders".into());
        }
        let invocations =
            limits.max_compute_work_group_invocations.min(limits.max_compute_work_group_size[0]);
        let buffers = limits
            .max_per_stage_descriptor_storage_buffers
            .min(limits.max_descriptor_set_storage_buffers);
        for (what, least, actual) in [
            ("invocations in a workgroup", self.workgroup_invocations, invocations),
            ("bytes of shared memory", self.shared_memory, limits.max_compute_shared_memory_size),
            ("bytes of push constants", self.push_constants, limits.max_push_constants_size),
            ("storage buffers in a descriptor set", self.storage_buffers, buffers),
        ] {
            if actual < least {
                missing.push(format!("{least} {what} (it has {actual})"));
            }
        }
        // SAFETY: as above.
        let families = unsafe { instance.get_physical_device_queue_family_properties(physical) };
        if !families.iter().any(|family| family.queue_flags.contains(self.queue_flags)) {
            missing.push("a queue family with compute".into());
        }
        missing
    }

    /// Returns an error if a physical device lacks any requirement.
    pub(super) fn check(
        &self,
        instance: &ash::Instance,
        physical: vk::PhysicalDevice,
        name: &str,
    ) -> Result<()> {
        let missing = self.lacked_by(instance, physical);
        if missing.is_empty() {
            return Ok(());
        }
        Err(unsupported(format!("{name} lacks {}", missing.join(", "))))
    }
}

/// The error that the engine cannot run on a device, with what is missing.
pub(super) fn unsupported(missing: String) -> Error {
    Error::Unsupported { kernel: "the engine".into(), missing }
}
