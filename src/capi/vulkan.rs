//! Vulkan's types under Vulkan's names. The C header takes them from Vulkan's headers, or declares
//! them identically.

use crate::embed::ash::vk;

/// A Vulkan handle.
pub type VkInstance = vk::Instance;
/// A Vulkan handle.
pub type VkPhysicalDevice = vk::PhysicalDevice;
/// A Vulkan handle.
pub type VkDevice = vk::Device;
/// A Vulkan handle.
pub type VkQueue = vk::Queue;
/// A Vulkan handle.
pub type VkCommandBuffer = vk::CommandBuffer;
/// A Vulkan handle.
pub type VkBuffer = vk::Buffer;
/// A Vulkan handle.
pub type VkSemaphore = vk::Semaphore;
/// The loader's vkGetInstanceProcAddr; may be null.
#[allow(non_camel_case_types)]
pub type PFN_vkGetInstanceProcAddr = Option<vk::PFN_vkGetInstanceProcAddr>;
