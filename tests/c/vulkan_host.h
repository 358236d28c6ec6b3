/*
 * A host's own Vulkan, for programs in C and C++ of one source file: loader, instance, device, an
 * allocator, command buffers, semaphores.
 */
#ifndef VULKAN_HOST_H
#define VULKAN_HOST_H

#define VK_NO_PROTOTYPES
#include <vulkan/vulkan.h>

#include "common.h"

#include <dlfcn.h>
#include <pthread.h>

#define VK(call) CHECK((call) == VK_SUCCESS)

/* A structure of Vulkan's, of zeros with its type. */
#define INFO(type, name, kind)                                                                     \
    type name;                                                                                     \
    memset(&name, 0, sizeof name);                                                                 \
    name.sType = VK_STRUCTURE_TYPE_##kind

#define INSTANCE_FUNCTIONS(F)                                                                      \
    F(vkEnumeratePhysicalDevices)                                                                  \
    F(vkGetPhysicalDeviceProperties)                                                               \
    F(vkGetPhysicalDeviceQueueFamilyProperties)                                                    \
    F(vkGetPhysicalDeviceMemoryProperties)                                                         \
    F(vkCreateDevice)                                                                              \
    F(vkGetDeviceProcAddr)                                                                         \
    F(vkDestroyInstance)

#define DEVICE_FUNCTIONS(F)                                                                        \
    F(vkDestroyDevice)                                                                             \
    F(vkGetDeviceQueue)                                                                            \
    F(vkCreateBuffer)                                                                              \
    F(vkDestroyBuffer)                                                                             \
    F(vkGetBufferMemoryRequirements)                                                               \
    F(vkAllocateMemory)                                                                            \
    F(vkFreeMemory)                                                                                \
    F(vkBindBufferMemory)                                                                          \
    F(vkMapMemory)                                                                                 \
    F(vkCreateSemaphore)                                                                           \
    F(vkDestroySemaphore)                                                                          \
    F(vkWaitSemaphores)                                                                            \
    F(vkSignalSemaphore)                                                                           \
    F(vkCreateCommandPool)                                                                         \
    F(vkDestroyCommandPool)                                                                        \
    F(vkAllocateCommandBuffers)                                                                    \
    F(vkBeginCommandBuffer)                                                                        \
    F(vkEndCommandBuffer)                                                                          \
    F(vkResetCommandBuffer)                                                                        \
    F(vkCmdFillBuffer)                                                                             \
    F(vkCmdCopyBuffer)                                                                             \
    F(vkCmdPipelineBarrier2)                                                                       \
    F(vkQueueSubmit2)

#define DECLARE(name) static PFN_##name name;
DECLARE(vkGetInstanceProcAddr)
INSTANCE_FUNCTIONS(DECLARE)
DEVICE_FUNCTIONS(DECLARE)
#undef DECLARE

enum { ARENA = 8 << 20, MOST_BUFFERS = 64 };

static const VkBufferUsageFlags USAGE = VK_BUFFER_USAGE_STORAGE_BUFFER_BIT |
                                        VK_BUFFER_USAGE_TRANSFER_SRC_BIT |
                                        VK_BUFFER_USAGE_TRANSFER_DST_BIT;

typedef struct {
    VkInstance instance;
    VkDebugUtilsMessengerEXT messenger;
    VkPhysicalDevice physical;
    VkDevice device;
    VkQueue queue;
    uint32_t family, families;
    VkCommandPool pool;
    /* The host's allocator: one piece of memory, handed out from its begin to its end. */
    VkDeviceMemory memory;
    VkDeviceSize used;
    char *mapped;
    VkBuffer buffers[MOST_BUFFERS];
    size_t buffer_count;
    /* Whoever uses the queue holds it: the engine too. */
    pthread_mutex_t queue_mutex;
    /* What the validation layer has said, and how often the engine has taken the queue. */
    int messages, locks;
} Host;

/* A buffer in the host's memory. */
typedef struct {
    VkBuffer buffer;
    VkDeviceSize bytes;
    void *mapped;
} Piece;

static inline void count_up(void *user)
{
    ++*(int *)user;
}

static inline void lock_queue(void *user)
{
    Host *host = (Host *)user;
    pthread_mutex_lock(&host->queue_mutex);
    host->locks++;
}

static inline void unlock_queue(void *user)
{
    pthread_mutex_unlock(&((Host *)user)->queue_mutex);
}

static inline VKAPI_ATTR VkBool32 VKAPI_CALL
on_message(VkDebugUtilsMessageSeverityFlagBitsEXT severity, VkDebugUtilsMessageTypeFlagsEXT type,
           const VkDebugUtilsMessengerCallbackDataEXT *data, void *messages)
{
    (void)severity;
    if (type != VK_DEBUG_UTILS_MESSAGE_TYPE_GENERAL_BIT_EXT) {
        fprintf(stderr, "validation: %s\n", data->pMessage);
        count_up(messages);
    }
    return VK_FALSE;
}

static inline void make_instance(Host *host)
{
    const char *wanted = getenv("SPLAT4D_VALIDATION");
    const int validation = wanted && strcmp(wanted, "1") == 0;
    const char *layers[] = {"VK_LAYER_KHRONOS_validation"};
    const char *extensions[] = {"VK_EXT_debug_utils", "VK_EXT_validation_features"};
    const VkValidationFeatureEnableEXT enabled[] = {
        VK_VALIDATION_FEATURE_ENABLE_SYNCHRONIZATION_VALIDATION_EXT};
    void *library = dlopen("libvulkan.so.1", RTLD_NOW | RTLD_LOCAL), *loader;
    PFN_vkCreateInstance vkCreateInstance;
    INFO(VkApplicationInfo, application, APPLICATION_INFO);
    INFO(VkValidationFeaturesEXT, features, VALIDATION_FEATURES_EXT);
    INFO(VkInstanceCreateInfo, create, INSTANCE_CREATE_INFO);
    CHECK(library);
    loader = dlsym(library, "vkGetInstanceProcAddr");
    CHECK(loader);
    memcpy(&vkGetInstanceProcAddr, &loader, sizeof loader);
    application.apiVersion = VK_API_VERSION_1_3;
    features.enabledValidationFeatureCount = 1;
    features.pEnabledValidationFeatures = enabled;
    create.pApplicationInfo = &application;
    if (validation) {
        create.pNext = &features;
        create.enabledLayerCount = 1;
        create.ppEnabledLayerNames = layers;
        create.enabledExtensionCount = 2;
        create.ppEnabledExtensionNames = extensions;
    }
    vkCreateInstance = (PFN_vkCreateInstance)vkGetInstanceProcAddr(NULL, "vkCreateInstance");
    VK(vkCreateInstance(&create, NULL, &host->instance));
#define LOAD(name)                                                                                 \
    name = (PFN_##name)vkGetInstanceProcAddr(host->instance, #name);                               \
    CHECK(name);
    INSTANCE_FUNCTIONS(LOAD)
#undef LOAD
    if (validation) {
        PFN_vkCreateDebugUtilsMessengerEXT make =
            (PFN_vkCreateDebugUtilsMessengerEXT)vkGetInstanceProcAddr(
                host->instance, "vkCreateDebugUtilsMessengerEXT");
        INFO(VkDebugUtilsMessengerCreateInfoEXT, info, DEBUG_UTILS_MESSENGER_CREATE_INFO_EXT);
        info.messageSeverity = VK_DEBUG_UTILS_MESSAGE_SEVERITY_WARNING_BIT_EXT |
                               VK_DEBUG_UTILS_MESSAGE_SEVERITY_ERROR_BIT_EXT;
        info.messageType = VK_DEBUG_UTILS_MESSAGE_TYPE_GENERAL_BIT_EXT |
                           VK_DEBUG_UTILS_MESSAGE_TYPE_VALIDATION_BIT_EXT |
                           VK_DEBUG_UTILS_MESSAGE_TYPE_PERFORMANCE_BIT_EXT;
        info.pfnUserCallback = on_message;
        info.pUserData = &host->messages;
        VK(make(host->instance, &info, NULL, &host->messenger));
    }
}

/* The software driver, and a family of queues with compute. */
static inline void choose_device(Host *host)
{
    enum { MOST = 16 };
    VkPhysicalDevice all[MOST];
    VkQueueFamilyProperties families[MOST];
    uint32_t count = MOST, i;
    VK(vkEnumeratePhysicalDevices(host->instance, &count, all));
    for (i = 0; i < count; i++) {
        VkPhysicalDeviceProperties properties;
        vkGetPhysicalDeviceProperties(all[i], &properties);
        if (properties.deviceType == VK_PHYSICAL_DEVICE_TYPE_CPU)
            host->physical = all[i];
    }
    CHECK(host->physical);
    host->families = MOST;
    vkGetPhysicalDeviceQueueFamilyProperties(host->physical, &host->families, families);
    while (host->family < host->families &&
           !(families[host->family].queueFlags & VK_QUEUE_COMPUTE_BIT))
        host->family++;
    CHECK(host->family < host->families);
}

static inline void make_device(Host *host)
{
    const float priority = 1;
    INFO(VkDeviceQueueCreateInfo, queues, DEVICE_QUEUE_CREATE_INFO);
    INFO(VkPhysicalDeviceVulkan13Features, vulkan13, PHYSICAL_DEVICE_VULKAN_1_3_FEATURES);
    INFO(VkPhysicalDeviceVulkan12Features, vulkan12, PHYSICAL_DEVICE_VULKAN_1_2_FEATURES);
    INFO(VkDeviceCreateInfo, create, DEVICE_CREATE_INFO);
    INFO(VkCommandPoolCreateInfo, pool, COMMAND_POOL_CREATE_INFO);
    queues.queueFamilyIndex = host->family;
    queues.queueCount = 1;
    queues.pQueuePriorities = &priority;
    vulkan13.synchronization2 = VK_TRUE;
    vulkan13.subgroupSizeControl = VK_TRUE;
    vulkan13.computeFullSubgroups = VK_TRUE;
    vulkan12.pNext = &vulkan13;
    vulkan12.timelineSemaphore = VK_TRUE;
    vulkan12.scalarBlockLayout = VK_TRUE;
    create.pNext = &vulkan12;
    create.queueCreateInfoCount = 1;
    create.pQueueCreateInfos = &queues;
    VK(vkCreateDevice(host->physical, &create, NULL, &host->device));
#define LOAD(name)                                                                                 \
    name = (PFN_##name)vkGetDeviceProcAddr(host->device, #name);                                   \
    CHECK(name);
    DEVICE_FUNCTIONS(LOAD)
#undef LOAD
    vkGetDeviceQueue(host->device, host->family, 0, &host->queue);
    pool.queueFamilyIndex = host->family;
    pool.flags = VK_COMMAND_POOL_CREATE_RESET_COMMAND_BUFFER_BIT;
    VK(vkCreateCommandPool(host->device, &pool, NULL, &host->pool));
}

static inline void make_memory(Host *host)
{
    const VkMemoryPropertyFlags seen =
        VK_MEMORY_PROPERTY_HOST_VISIBLE_BIT | VK_MEMORY_PROPERTY_HOST_COHERENT_BIT;
    VkPhysicalDeviceMemoryProperties kinds;
    void *at = NULL;
    INFO(VkMemoryAllocateInfo, allocate, MEMORY_ALLOCATE_INFO);
    vkGetPhysicalDeviceMemoryProperties(host->physical, &kinds);
    allocate.allocationSize = ARENA;
    while (allocate.memoryTypeIndex < kinds.memoryTypeCount &&
           (kinds.memoryTypes[allocate.memoryTypeIndex].propertyFlags & seen) != seen)
        allocate.memoryTypeIndex++;
    CHECK(allocate.memoryTypeIndex < kinds.memoryTypeCount);
    VK(vkAllocateMemory(host->device, &allocate, NULL, &host->memory));
    VK(vkMapMemory(host->device, host->memory, 0, VK_WHOLE_SIZE, 0, &at));
    host->mapped = (char *)at;
}

static inline void host_open(Host *host)
{
    memset(host, 0, sizeof *host);
    CHECK(pthread_mutex_init(&host->queue_mutex, NULL) == 0);
    make_instance(host);
    choose_device(host);
    make_device(host);
    make_memory(host);
}

/* Everything made from it must be gone; fails where the validation layer has said anything. */
static inline void host_close(Host *host)
{
    size_t i;
    for (i = 0; i < host->buffer_count; i++)
        vkDestroyBuffer(host->device, host->buffers[i], NULL);
    vkFreeMemory(host->device, host->memory, NULL);
    vkDestroyCommandPool(host->device, host->pool, NULL);
    vkDestroyDevice(host->device, NULL);
    if (host->messenger) {
        PFN_vkDestroyDebugUtilsMessengerEXT destroy =
            (PFN_vkDestroyDebugUtilsMessengerEXT)vkGetInstanceProcAddr(
                host->instance, "vkDestroyDebugUtilsMessengerEXT");
        destroy(host->instance, host->messenger, NULL);
    }
    vkDestroyInstance(host->instance, NULL);
    pthread_mutex_destroy(&host->queue_mutex);
    CHECK(host->messages == 0);
}

static inline Piece host_piece(Host *host, VkDeviceSize bytes)
{
    Piece made;
    VkMemoryRequirements needs;
    INFO(VkBufferCreateInfo, info, BUFFER_CREATE_INFO);
    info.size = made.bytes = bytes;
    info.usage = USAGE;
    VK(vkCreateBuffer(host->device, &info, NULL, &made.buffer));
    vkGetBufferMemoryRequirements(host->device, made.buffer, &needs);
    host->used = (host->used + needs.alignment - 1) / needs.alignment * needs.alignment;
    CHECK(host->used + needs.size <= ARENA && host->buffer_count < MOST_BUFFERS);
    VK(vkBindBufferMemory(host->device, made.buffer, host->memory, host->used));
    made.mapped = host->mapped + host->used;
    host->used += needs.size;
    host->buffers[host->buffer_count++] = made.buffer;
    return made;
}

/* What the engine is lent; `drops` counts how often it is given back. */
static inline splat4d_host_device host_lend(Host *host, int *drops)
{
    NEW(splat4d_host_device, lent);
    lent.get_instance_proc_addr = vkGetInstanceProcAddr;
    lent.instance = host->instance;
    lent.physical_device = host->physical;
    lent.device = host->device;
    lent.queue = host->queue;
    lent.queue_family = host->family;
    lent.features = SPLAT4D_FEATURE_TIMELINE_SEMAPHORE | SPLAT4D_FEATURE_SCALAR_BLOCK_LAYOUT |
                    SPLAT4D_FEATURE_SYNCHRONIZATION2 | SPLAT4D_FEATURE_SUBGROUP_SIZE_CONTROL |
                    SPLAT4D_FEATURE_COMPUTE_FULL_SUBGROUPS;
    lent.queue_lock = lock_queue;
    lent.queue_unlock = unlock_queue;
    lent.queue_user = host;
    lent.on_drop = count_up;
    lent.on_drop_user = drops;
    return lent;
}

/* A part of a piece, to adopt. */
static inline splat4d_host_buffer part_of(const Piece *piece, uint64_t offset, uint64_t bytes)
{
    NEW(splat4d_host_buffer, part);
    part.buffer = piece->buffer;
    part.offset = offset;
    part.bytes = bytes;
    part.usage = USAGE;
    return part;
}

static inline splat4d_buffer *adopt_part(splat4d_device *device, const Piece *piece,
                                         uint64_t offset, uint64_t bytes, int *drops)
{
    splat4d_buffer *buffer = NULL;
    splat4d_host_buffer part = part_of(piece, offset, bytes);
    part.on_drop = count_up;
    part.on_drop_user = drops;
    OK(splat4d_buffer_adopt(device, &part, &buffer));
    return buffer;
}

static inline VkCommandBuffer host_commands(const Host *host)
{
    VkCommandBuffer made = NULL;
    INFO(VkCommandBufferAllocateInfo, info, COMMAND_BUFFER_ALLOCATE_INFO);
    info.commandPool = host->pool;
    info.commandBufferCount = 1;
    VK(vkAllocateCommandBuffers(host->device, &info, &made));
    return made;
}

static inline void host_begin(VkCommandBuffer commands)
{
    INFO(VkCommandBufferBeginInfo, info, COMMAND_BUFFER_BEGIN_INFO);
    info.flags = VK_COMMAND_BUFFER_USAGE_ONE_TIME_SUBMIT_BIT;
    VK(vkBeginCommandBuffer(commands, &info));
}

/* Records a copy of a whole piece, which the host then reads. */
static inline void host_copy(VkCommandBuffer commands, const Piece *from, const Piece *to)
{
    VkBufferCopy region;
    INFO(VkMemoryBarrier2, barrier, MEMORY_BARRIER_2);
    INFO(VkDependencyInfo, dependency, DEPENDENCY_INFO);
    region.srcOffset = region.dstOffset = 0;
    region.size = from->bytes;
    vkCmdCopyBuffer(commands, from->buffer, to->buffer, 1, &region);
    barrier.srcStageMask = VK_PIPELINE_STAGE_2_COPY_BIT;
    barrier.srcAccessMask = VK_ACCESS_2_TRANSFER_WRITE_BIT;
    barrier.dstStageMask = VK_PIPELINE_STAGE_2_HOST_BIT;
    barrier.dstAccessMask = VK_ACCESS_2_HOST_READ_BIT;
    dependency.memoryBarrierCount = 1;
    dependency.pMemoryBarriers = &barrier;
    vkCmdPipelineBarrier2(commands, &dependency);
}

/* Ends and submits; the semaphore reaches the value when the device is done. */
static inline void host_submit(Host *host, VkCommandBuffer commands, VkSemaphore semaphore,
                               uint64_t value)
{
    INFO(VkCommandBufferSubmitInfo, buffer, COMMAND_BUFFER_SUBMIT_INFO);
    INFO(VkSemaphoreSubmitInfo, signal, SEMAPHORE_SUBMIT_INFO);
    INFO(VkSubmitInfo2, info, SUBMIT_INFO_2);
    VK(vkEndCommandBuffer(commands));
    buffer.commandBuffer = commands;
    signal.semaphore = semaphore;
    signal.value = value;
    signal.stageMask = VK_PIPELINE_STAGE_2_ALL_COMMANDS_BIT;
    info.commandBufferInfoCount = 1;
    info.pCommandBufferInfos = &buffer;
    info.signalSemaphoreInfoCount = 1;
    info.pSignalSemaphoreInfos = &signal;
    pthread_mutex_lock(&host->queue_mutex);
    VK(vkQueueSubmit2(host->queue, 1, &info, VK_NULL_HANDLE));
    pthread_mutex_unlock(&host->queue_mutex);
}

static inline VkSemaphore host_timeline(const Host *host)
{
    VkSemaphore made = VK_NULL_HANDLE;
    INFO(VkSemaphoreTypeCreateInfo, kind, SEMAPHORE_TYPE_CREATE_INFO);
    INFO(VkSemaphoreCreateInfo, info, SEMAPHORE_CREATE_INFO);
    kind.semaphoreType = VK_SEMAPHORE_TYPE_TIMELINE;
    info.pNext = &kind;
    VK(vkCreateSemaphore(host->device, &info, NULL, &made));
    return made;
}

static inline void host_wait(const Host *host, VkSemaphore semaphore, uint64_t value)
{
    INFO(VkSemaphoreWaitInfo, info, SEMAPHORE_WAIT_INFO);
    info.semaphoreCount = 1;
    info.pSemaphores = &semaphore;
    info.pValues = &value;
    VK(vkWaitSemaphores(host->device, &info, UINT64_MAX));
}

#endif
