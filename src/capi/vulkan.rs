//! Vulkan's types, under Vulkan's names; the header leaves them to Vulkan's own, or declares them
//! likewise.

use crate::embed::ash::vk;

/// A handle of Vulkan's.
pub type VkInstance = vk::Instance;
/// A handle of Vulkan's.
pub type VkPhysicalDevice = vk::PhysicalDevice;
/// A handle of Vulkan's.
pub type VkDevice = vk::Device;
/// A handle of Vulkan's.
pub type VkQueue = vk::Queue;
/// A handle of Vulkan's.
pub type VkCommandBuffer = vk::CommandBuffer;
/// A handle of Vulkan's.
pub type VkBuffer = vk::Buffer;
/// A handle of Vulkan's.
pub type VkSemaphore = vk::Semaphore;
/// The loader's function; may be null.
#[allow(non_camel_case_types)]
pub type PFN_vkGetInstanceProcAddr = Option<vk::PFN_vkGetInstanceProcAddr>;
