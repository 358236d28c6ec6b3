/*
 * Vulkan's handles. Include Vulkan's headers first where you use both: these stand in for them, and
 * are the same types.
 */
#ifndef VULKAN_CORE_H_
typedef struct VkInstance_T *VkInstance;
typedef struct VkPhysicalDevice_T *VkPhysicalDevice;
typedef struct VkDevice_T *VkDevice;
typedef struct VkQueue_T *VkQueue;
typedef struct VkCommandBuffer_T *VkCommandBuffer;
#if UINTPTR_MAX > 0xffffffffu
typedef struct VkBuffer_T *VkBuffer;
typedef struct VkSemaphore_T *VkSemaphore;
#else
typedef uint64_t VkBuffer;
typedef uint64_t VkSemaphore;
#endif
#if defined(_WIN32)
typedef void(__stdcall *PFN_vkVoidFunction)(void);
typedef PFN_vkVoidFunction(__stdcall *PFN_vkGetInstanceProcAddr)(VkInstance instance,
                                                                 const char *name);
#else
typedef void (*PFN_vkVoidFunction)(void);
typedef PFN_vkVoidFunction (*PFN_vkGetInstanceProcAddr)(VkInstance instance, const char *name);
#endif
#endif
