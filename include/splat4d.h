/*
 * splat4d: 4D Gaussian splatting on Vulkan compute, for programs in C and C++.
 *
 * Made from src/capi by tools/header; do not edit.
 *
 * Three depths, each of which goes with the renderer, the trainer and the ops:
 *
 *   1. The engine's device (splat4d_device_open), its streams, its memory.
 *   2. The host's device (splat4d_device_adopt), the engine's submissions between the host's timeline
 *      semaphores (splat4d_stream_submit), the host's buffers (splat4d_buffer_adopt).
 *   3. The host's command buffers (splat4d_recorder_over).
 *
 * Conventions, of every function unless it says otherwise:
 *
 * - Errors. A splat4d_result, SPLAT4D_OK (0) for success; splat4d_last_error() has the message, per
 *   thread. No panic and no exception crosses the border. NULL where something must be is an error, and
 *   so is a structure of a wrong size. After SPLAT4D_ERROR_INTERNAL and SPLAT4D_ERROR_DEVICE_LOST only
 *   destroying is left for the handles of the call.
 * - Handles. Opaque pointers. Who is given one by a function that creates, opens, adopts, records or
 *   finishes owns it, and destroys it, or hands it to a function that says that it is gone afterwards.
 *   Where such a function fails the handle is NULL. Destroying NULL does nothing, destroying in any
 *   order is fine: everything keeps what it needs. A destroyed handle, or one of another kind, must not
 *   be used; nobody can check that.
 * - Structures begin with their size: set struct_size = sizeof(the structure) and the rest to 0, then
 *   what you want. 0 is the default of whatever has one, also of fields that later versions add, so
 *   that programs run with libraries older and newer than their header.
 * - Arrays and texts given in are copied or read before the function returns: nothing of them is kept.
 *   Texts are UTF-8 with a zero at the end. Arrays have the length that is documented; nobody can
 *   check that either.
 * - Threads. A splat4d_device may be used by any number of threads at once, and nothing is global. Any
 *   other handle may go from thread to thread, and is used by one at a time.
 * - Transforms are named a_from_b. Images are row by row from the upper left; floats are 32 bits.
 */

#ifndef SPLAT4D_H
#define SPLAT4D_H

#include <stddef.h>
#include <stdint.h>
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

// Version of the library of this header. Before 1.0 a minor version may break the interface.
#define SPLAT4D_VERSION_MAJOR 0

// As above.
#define SPLAT4D_VERSION_MINOR 1

// As above.
#define SPLAT4D_VERSION_PATCH 0

// Version of the binary interface: it changes when programs must be recompiled.
#define SPLAT4D_ABI_VERSION 1

// timelineSemaphore of Vulkan 1.2, in a mask of features.
#define SPLAT4D_FEATURE_TIMELINE_SEMAPHORE 1

// scalarBlockLayout of Vulkan 1.2.
#define SPLAT4D_FEATURE_SCALAR_BLOCK_LAYOUT 2

// synchronization2 of Vulkan 1.3.
#define SPLAT4D_FEATURE_SYNCHRONIZATION2 4

// subgroupSizeControl of Vulkan 1.3.
#define SPLAT4D_FEATURE_SUBGROUP_SIZE_CONTROL 8

// computeFullSubgroups of Vulkan 1.3.
#define SPLAT4D_FEATURE_COMPUTE_FULL_SUBGROUPS 16

// 3DGS-MCMC: dead Gaussians are relocated onto live ones, and the number grows up to
// max_gaussians. The default.
#define SPLAT4D_GROWTH_MCMC 0

// 3D Gaussian Splatting: clone, split, prune.
#define SPLAT4D_GROWTH_ADAPTIVE 1

// No growth: the number of Gaussians stays constant.
#define SPLAT4D_GROWTH_NONE 2

// The result code of a call.
enum splat4d_result
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : int32_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
    // Success.
    SPLAT4D_OK = 0,
    // A required pointer or handle is null, or a pointer is not aligned.
    SPLAT4D_ERROR_POINTER = 1,
    // A structure's struct_size is not set, or the structure has fields set that this library does
    // not know.
    SPLAT4D_ERROR_STRUCT_SIZE = 2,
    // An argument is invalid.
    SPLAT4D_ERROR_INPUT = 3,
    // An array or a buffer is too short, or lengths are inconsistent.
    SPLAT4D_ERROR_SHAPE = 4,
    // A buffer is larger than one binding of the device may be.
    SPLAT4D_ERROR_RANGE_LIMIT = 5,
    // There is no Vulkan loader, no driver, or no device that fits the request.
    SPLAT4D_ERROR_NO_DEVICE = 6,
    // The device, or the library as it was built, lacks something.
    SPLAT4D_ERROR_UNSUPPORTED = 7,
    // Device memory ran out.
    SPLAT4D_ERROR_OUT_OF_MEMORY = 8,
    // The device was lost: handles can only be destroyed.
    SPLAT4D_ERROR_DEVICE_LOST = 9,
    // A Vulkan call failed.
    SPLAT4D_ERROR_VULKAN = 10,
    // A file could not be read or written.
    SPLAT4D_ERROR_IO = 11,
    // The content of a file violates its format.
    SPLAT4D_ERROR_FORMAT = 12,
    // The method did not find a result.
    SPLAT4D_ERROR_FAILED = 13,
    // The program was compiled for another binary interface.
    SPLAT4D_ERROR_VERSION = 14,
    // A bug of the library: the handles of the call can only be destroyed.
    SPLAT4D_ERROR_INTERNAL = 15,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum splat4d_result splat4d_result;
#else
typedef int32_t splat4d_result;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

// A device buffer of 32-bit words.
typedef struct splat4d_buffer splat4d_buffer;

// A Vulkan device. Objects made from it keep the underlying device alive, so handles may be
// destroyed in any order. Any number of threads may use a device at once.
typedef struct splat4d_device splat4d_device;

// A recorded frame.
typedef struct splat4d_frame splat4d_frame;

// Keeps the resources of a recording into the host's command buffer alive while the device works
// on it.
typedef struct splat4d_guard splat4d_guard;

// A recording in progress. Functions named ..._record, and a trainer's forward, backward and
// update, add to it; the engine's barriers order them. If one fails, destroy the recording.
typedef struct splat4d_recorder splat4d_recorder;

// A renderer of one scene on a device. Successive images of the same size cost no allocation.
typedef struct splat4d_renderer splat4d_renderer;

// A plan for exclusive prefix sums, with its scratch memory.
typedef struct splat4d_scan splat4d_scan;

// A scene on the host.
typedef struct splat4d_scene splat4d_scene;

// A plan for a stable sort of key-payload pairs, with its scratch memory.
typedef struct splat4d_sort splat4d_sort;

// An ordered sequence of submissions to the device's queue.
typedef struct splat4d_stream splat4d_stream;

// A trainer of Gaussians as a static scene.
typedef struct splat4d_trainer splat4d_trainer;

// Which device to open.
typedef struct splat4d_request {
    // sizeof(splat4d_request).
    size_t struct_size;
    // A number is an index; "best", "gpu", "discrete", "integrated", "virtual" and "software" are kinds;
    // anything else is part of a name. Null for "best".
    const char *selector;
    // Not 0 turns the Khronos validation layer on, with synchronization validation.
    uint32_t validation;
} splat4d_request;

// The requirements on a device.
typedef struct splat4d_requirements {
    // sizeof(splat4d_requirements).
    size_t struct_size;
    // Minimum Vulkan version of instance and device, in Vulkan's packed encoding.
    uint32_t api_version;
    // SPLAT4D_FEATURE_*: the features that must be enabled. No extension is required.
    uint32_t features;
    // VkQueueFlags that the queue's family must have.
    uint32_t queue_flags;
    // VkSubgroupFeatureFlags that compute shaders must support.
    uint32_t subgroup_operations;
    // Minimum of maxComputeWorkGroupInvocations and `maxComputeWorkGroupSize[0]`.
    uint32_t workgroup_invocations;
    // Minimum of maxComputeSharedMemorySize, bytes.
    uint32_t shared_memory;
    // Minimum of maxPushConstantsSize, bytes.
    uint32_t push_constants;
    // Minimum of maxPerStageDescriptorStorageBuffers and maxDescriptorSetStorageBuffers.
    uint32_t storage_buffers;
} splat4d_requirements;

// A function of the host, called with the pointer registered with it. It must not throw and must
// not call splat4d with the handle of the running call.
typedef void (*splat4d_callback)(void *user);

// A Vulkan device that the host has created.
typedef struct splat4d_host_device {
    // sizeof(splat4d_host_device).
    size_t struct_size;
    // The loader's.
    PFN_vkGetInstanceProcAddr get_instance_proc_addr;
    // The instance, created for Vulkan 1.3 or newer.
    VkInstance instance;
    // A physical device of the instance.
    VkPhysicalDevice physical_device;
    // The device, created for Vulkan 1.3 or newer with everything that splat4d_requirements lists.
    VkDevice device;
    // A queue of the device, for the engine's own submissions.
    VkQueue queue;
    // The queue's family, which must offer compute.
    uint32_t queue_family;
    // SPLAT4D_FEATURE_*: the features that the device was created with.
    uint32_t features;
    // Locks the queue. Required if other code uses the queue while the engine may submit; called
    // before each submission on the submitting thread. queue_lock and queue_unlock must both be
    // set or both be null.
    splat4d_callback queue_lock;
    // As above.
    splat4d_callback queue_unlock;
    // Given to queue_lock and queue_unlock.
    void *queue_user;
    // Called once when no object of the engine uses the device any more, on the thread that
    // destroys the last one. It is also called if splat4d_device_adopt fails, except with
    // SPLAT4D_ERROR_POINTER or SPLAT4D_ERROR_STRUCT_SIZE.
    splat4d_callback on_drop;
    // Given to on_drop.
    void *on_drop_user;
} splat4d_host_device;

// Properties of a device and its memory use.
typedef struct splat4d_device_info {
    // sizeof(splat4d_device_info).
    size_t struct_size;
    // The device's name, zero-terminated; truncated if it is longer.
    char name[256];
    // VkPhysicalDeviceType.
    uint32_t kind;
    // Supported Vulkan version, in Vulkan's packed encoding.
    uint32_t api_version;
    // Offsets of adopted buffers must be multiples of this many bytes.
    uint64_t storage_alignment;
    // The largest buffer that an op may use, bytes.
    uint64_t storage_range;
    // Bytes of all live buffers of the engine.
    uint64_t bytes;
    // Number of buffers and pools created so far; constant in steady-state work.
    uint64_t allocations;
} splat4d_device_info;

// A part of a host's buffer, to adopt.
typedef struct splat4d_host_buffer {
    // sizeof(splat4d_host_buffer).
    size_t struct_size;
    // The buffer; it must belong to the device and be bound to memory.
    VkBuffer buffer;
    // First byte of the part; a multiple of splat4d_device_info.storage_alignment.
    uint64_t offset;
    // Bytes of the part, a multiple of 4.
    uint64_t bytes;
    // VkBufferUsageFlags that the whole buffer was created with; at least STORAGE_BUFFER,
    // TRANSFER_SRC and TRANSFER_DST.
    uint32_t usage;
    // Called once when no object of the engine uses the buffer any more. It is also called if
    // splat4d_buffer_adopt fails, except with SPLAT4D_ERROR_POINTER or SPLAT4D_ERROR_STRUCT_SIZE.
    splat4d_callback on_drop;
    // Given to on_drop.
    void *on_drop_user;
} splat4d_host_buffer;

// A part of a VkBuffer; if absent, buffer is null and bytes is 0.
typedef struct splat4d_range {
    // The buffer.
    VkBuffer buffer;
    // First byte.
    uint64_t offset;
    // Bytes.
    uint64_t bytes;
} splat4d_range;

// A value of a timeline semaphore.
typedef struct splat4d_semaphore_point {
    // A timeline semaphore of the device.
    VkSemaphore semaphore;
    // The value to wait for, or to signal.
    uint64_t value;
} splat4d_semaphore_point;

// Gaussians of a static scene, one row of every array per Gaussian.
typedef struct splat4d_gaussians {
    // sizeof(splat4d_gaussians).
    size_t struct_size;
    // Number of Gaussians.
    size_t count;
    // Centres in the world: 3 per Gaussian.
    const float *positions;
    // Natural logarithms of the standard deviations along the Gaussian's own axes: 3.
    const float *log_scales;
    // world_from_gaussian quaternions w, x, y, z, which need not be normalised: 4.
    const float *rotations;
    // Logits of the opacity: 1.
    const float *opacity_logits;
    // Coefficients of the spherical harmonics, lowest band first, each red, green, blue:
    // 3 * (sh_degree + 1)^2.
    const float *sh;
    // Degree of the spherical harmonics, 0 to 3.
    uint32_t sh_degree;
} splat4d_gaussians;

// Properties of a scene.
typedef struct splat4d_scene_info {
    // sizeof(splat4d_scene_info).
    size_t struct_size;
    // Number of Gaussians.
    size_t count;
    // Degree of the spherical harmonics.
    uint32_t sh_degree;
    // 1 if the scene is dynamic.
    uint32_t is_dynamic;
    // Number of input cameras.
    size_t camera_count;
    // Background colour: red, green, blue.
    float background[3];
} splat4d_scene_info;

// A pinhole camera. Axes: x right, y down, z forward; the first pixel's centre lies at (0.5, 0.5).
typedef struct splat4d_camera {
    // sizeof(splat4d_camera).
    size_t struct_size;
    // Focal length along x, pixels.
    double fx;
    // Focal length along y, pixels; 0 for fx.
    double fy;
    // Principal point, x, from the left edge, pixels.
    double cx;
    // Principal point, y, from the upper edge, pixels.
    double cy;
    // Width of the image, pixels.
    uint32_t width;
    // Height of the image, pixels.
    uint32_t height;
    // view_from_world: a quaternion w, x, y, z, which need not be normalised; all 0 for no rotation.
    double rotation[4];
    // view_from_world: x_view = rotation * x_world + translation.
    double translation[3];
} splat4d_camera;

// Output arrays for Gaussians, laid out as in splat4d_gaussians. Null arrays are skipped.
typedef struct splat4d_gaussians_out {
    // sizeof(splat4d_gaussians_out).
    size_t struct_size;
    // Capacity of the arrays, Gaussians.
    size_t capacity;
    // 3 per Gaussian.
    float *positions;
    // 3 per Gaussian.
    float *log_scales;
    // 4 per Gaussian.
    float *rotations;
    // 1 per Gaussian.
    float *opacity_logits;
    // 3 * (sh_degree + 1)^2 per Gaussian.
    float *sh;
    // The degree of `sh`; it must equal the degree of the Gaussians that are read.
    uint32_t sh_degree;
} splat4d_gaussians_out;

// Output arrays for an image in the host's memory. Null arrays are skipped.
typedef struct splat4d_picture {
    // sizeof(splat4d_picture).
    size_t struct_size;
    // Premultiplied red, green, blue without background, and alpha: 4 * width * height.
    float *rgba;
    // Capacity of `rgba`, floats.
    size_t rgba_len;
    // Sum of alpha * T * z: width * height. The mean depth is this divided by alpha.
    float *depth;
    // Capacity of `depth`, floats.
    size_t depth_len;
} splat4d_picture;

// The output buffers of a frame: buffers of the device, adopted ones included. An output that is
// null goes to the renderer's own pixels.
typedef struct splat4d_target {
    // sizeof(splat4d_target).
    size_t struct_size;
    // As in splat4d_picture: 16 bytes a pixel.
    struct splat4d_buffer *rgba;
    // As in splat4d_picture: 4 bytes a pixel.
    struct splat4d_buffer *depth;
    // The motion mask, 16 bytes per pixel: red is the part of alpha that comes from dynamic
    // Gaussians, green and blue are 0, alpha is that of `rgba`. It costs a second blending pass.
    struct splat4d_buffer *mask;
} splat4d_target;

// The result of a frame that the device has rendered.
typedef struct splat4d_drawn {
    // sizeof(splat4d_drawn).
    size_t struct_size;
    // 1 if every splat was rendered. Otherwise the farthest were left out, and the next frame has
    // more capacity.
    uint32_t is_whole;
    // Gaussians that were visible.
    size_t visible;
    // Number of (splat, tile) pairs; 2³² − 1 stands for that many or more.
    size_t intersections;
} splat4d_drawn;

// An image on the device, in buffers of the engine.
typedef struct splat4d_pixels {
    // sizeof(splat4d_pixels).
    size_t struct_size;
    // Width, pixels.
    uint32_t width;
    // Height, pixels.
    uint32_t height;
    // As in splat4d_picture.
    struct splat4d_range rgba;
    // As in splat4d_picture.
    struct splat4d_range depth;
} splat4d_pixels;

// A training view.
typedef struct splat4d_view {
    // sizeof(splat4d_view). It must be equal in all elements of an array, and is the distance
    // between them.
    size_t struct_size;
    // The camera, with the size of the image.
    const struct splat4d_camera *camera;
    // Red, green, blue in [0, 1]: 3 * width * height.
    const float *rgb;
    // Weight of each pixel in [0, 1]: width * height; null for 1.
    const float *weights;
} splat4d_view;

// Settings of training. 0 selects the default of a field; a negative value stands for 0 itself.
typedef struct splat4d_train_settings {
    // sizeof(splat4d_train_settings).
    size_t struct_size;
    // Number of steps of the schedules; 0 for 30000.
    uint32_t steps;
    // SPLAT4D_GROWTH_*.
    uint32_t growth;
    // Maximum number of Gaussians; 0 for a million.
    size_t max_gaussians;
    // Bands of the spherical harmonics, 1 to 4 (the degree plus 1); 0 for 4.
    uint32_t sh_bands;
    // Number of steps after which a further band is added; 0 for 1000, negative for all bands from
    // the first step.
    int32_t sh_interval;
    // Weight of D-SSIM in the loss; 0 for 0.2, negative for none.
    float ssim_share;
    // Background colour: red, green, blue.
    float background[3];
    // Learning rates; 0 for those of 3D Gaussian Splatting, negative for none. This one is for
    // positions at the first step, and the next at the last step, in units of the scene's extent.
    double position_rate;
    // As above.
    double position_rate_last;
    // As above.
    double log_scale_rate;
    // As above.
    double rotation_rate;
    // As above.
    double opacity_rate;
    // As above: the constant spherical harmonic.
    double sh0_rate;
    // As above: the other bands.
    double sh_rest_rate;
    // Seed of the order of the training views and of all random numbers.
    uint64_t seed;
} splat4d_train_settings;

// The terms of the last step's loss.
typedef struct splat4d_loss {
    // sizeof(splat4d_loss).
    size_t struct_size;
    // 1 if a loss is known; otherwise the other fields are 0.
    uint32_t is_known;
    // Weighted mean of the absolute differences.
    double l1;
    // Weighted mean of SSIM.
    double ssim;
} splat4d_loss;

// The progress of training.
typedef struct splat4d_progress {
    // sizeof(splat4d_progress).
    size_t struct_size;
    // Number of steps done.
    uint32_t step;
    // Degree of the spherical harmonics of the Gaussians that are read.
    uint32_t sh_degree;
    // Number of Gaussians.
    size_t count;
} splat4d_progress;

// Gradients on the device, in the layout of the parameters: floats, one row per Gaussian.
typedef struct splat4d_gradients {
    // sizeof(splat4d_gradients).
    size_t struct_size;
    // 3 per Gaussian.
    struct splat4d_range positions;
    // 3 per Gaussian.
    struct splat4d_range log_scales;
    // 4 per Gaussian.
    struct splat4d_range rotations;
    // 1 per Gaussian.
    struct splat4d_range opacity_logits;
    // By band: 3, 9, 15, 21 per Gaussian; empty above the degree.
    struct splat4d_range sh[4];
    // With respect to the camera's pose, for a left perturbation of view_from_world: translation,
    // rotation; 6 floats. Empty before backward.
    struct splat4d_range pose;
} splat4d_gradients;

// The buffers of one scan; elements are 32-bit words.
typedef struct splat4d_scan_buffers {
    // sizeof(splat4d_scan_buffers).
    size_t struct_size;
    // Holds the number of values; what exceeds the capacity is left out.
    const struct splat4d_buffer *count;
    // Index of the word that holds the number.
    uint64_t count_at;
    // The values; as long as the capacity.
    const struct splat4d_buffer *values;
    // Receives `prefix[i] = values[0] + ... + values[i - 1]`, modulo 2^32; elements from the
    // number of values on stay unchanged.
    struct splat4d_buffer *prefix;
    // Receives the sum of all values.
    struct splat4d_buffer *total;
    // Index of the word that receives the sum.
    uint64_t total_at;
} splat4d_scan_buffers;

// The buffers of one sort; elements are 32-bit words. The input stays unchanged.
typedef struct splat4d_sort_buffers {
    // sizeof(splat4d_sort_buffers).
    size_t struct_size;
    // Holds the number of pairs; what exceeds the capacity is left out.
    const struct splat4d_buffer *count;
    // Index of the word that holds the number.
    uint64_t count_at;
    // The keys; as long as the capacity.
    const struct splat4d_buffer *keys;
    // The payload of each key; as long as the capacity.
    const struct splat4d_buffer *payload;
    // Receives the sorted keys; elements from the number of pairs on stay unchanged.
    struct splat4d_buffer *sorted_keys;
    // Receives the payload in the order of the sorted keys.
    struct splat4d_buffer *sorted_payload;
} splat4d_sort_buffers;

#ifdef __cplusplus
extern "C" {
#endif // __cplusplus

// Version of the loaded library: major * 1000000 + minor * 1000 + patch.
uint32_t splat4d_version(void);

// Checks that the loaded library is compatible with programs compiled with this header. Call it
// once, with SPLAT4D_ABI_VERSION, before any other function. Returns SPLAT4D_ERROR_VERSION if it
// is not.
splat4d_result splat4d_check_abi(uint32_t abi_version);

// The message of the last failed call on this thread; empty before the first. It is UTF-8, owned
// by the library, and valid until the next call on this thread fails. A call that succeeds does
// not change it.
const char *splat4d_last_error(void);

// Opens a device. `request` may be null for the best device. `device` gets a handle, to be
// destroyed.
splat4d_result splat4d_device_open(const struct splat4d_request *request,
                                   struct splat4d_device **device);

// Gets the requirements on a device, for hosts that create their own.
splat4d_result splat4d_requirements_query(struct splat4d_requirements *requirements);

// Gets descriptions of the requirements that a physical device lacks, separated by ", "; empty if
// the engine can run on it. As much as fits is written to `text` (`size` bytes, zero-terminated;
// may be null if size is 0), and the length of the whole text to `length`, which may be null.
//
// The instance must be alive and of that loader, and the physical device must belong to it.
splat4d_result splat4d_requirements_lacking(PFN_vkGetInstanceProcAddr get_instance_proc_addr,
                                            VkInstance instance,
                                            VkPhysicalDevice physical_device,
                                            char *text,
                                            size_t size,
                                            size_t *length);

// Adopts a device that the host has created. `device` gets a handle, to be destroyed. Nothing is
// written to disk; messages of a validation layer go to the host.
//
// The handles must belong together. Instance and device must have been created for Vulkan 1.3 or
// newer, the device with every feature that `features` claims. The loader must stay loaded, and
// instance and device alive, until on_drop is called; without on_drop, until everything made from
// the device is destroyed. No other code may use the queue while the engine does: either only the
// engine uses it, or every other use takes the same lock as queue_lock. vkDeviceWaitIdle uses all
// queues.
splat4d_result splat4d_device_adopt(const struct splat4d_host_device *host,
                                    struct splat4d_device **device);

// Gets the properties of the device and the engine's memory use.
splat4d_result splat4d_device_get_info(const struct splat4d_device *device,
                                       struct splat4d_device_info *info);

// Takes the messages of the validation layer since the last call, one per line: empty without
// messages, without the layer, and on a host's device. `text`, `size` and `length` are as for
// splat4d_requirements_lacking; the messages are kept if not all of the text fits.
splat4d_result splat4d_device_take_validation_messages(const struct splat4d_device *device,
                                                       char *text,
                                                       size_t size,
                                                       size_t *length);

// Destroys the handle; null is allowed. The device is destroyed with the last object made from it.
void splat4d_device_destroy(struct splat4d_device *device);

// Creates a buffer of `bytes` bytes (a multiple of 4, above 0) with undefined content. `buffer`
// gets a handle, to be destroyed.
splat4d_result splat4d_buffer_create(const struct splat4d_device *device,
                                     uint64_t bytes,
                                     struct splat4d_buffer **buffer);

// Adopts a part of a host's buffer; the host keeps the ownership. `buffer` gets a handle, to be
// destroyed. The VkBuffer must stay alive until on_drop is called, that is, until recorded work no
// longer uses it.
//
// The queue family of the device must own the buffer, or its sharing mode must be concurrent.
// Other code may use it only in order with the engine's work: on the same queue before or after a
// recording, or synchronised by a semaphore.
splat4d_result splat4d_buffer_adopt(const struct splat4d_device *device,
                                    const struct splat4d_host_buffer *host,
                                    struct splat4d_buffer **buffer);

// Gets the VkBuffer, offset and size of a buffer, for the host's own commands. Keep the handle
// until these are done, and order them with the engine's work.
splat4d_result splat4d_buffer_get_range(const struct splat4d_buffer *buffer,
                                        struct splat4d_range *range);

// Destroys the handle; null is allowed. Recorded work keeps the memory until it is done.
void splat4d_buffer_destroy(struct splat4d_buffer *buffer);

// Creates a stream. `stream` gets a handle, to be destroyed.
splat4d_result splat4d_stream_create(const struct splat4d_device *device,
                                     struct splat4d_stream **stream);

// Starts a recording for splat4d_stream_submit. `recorder` gets a handle, which is submitted or
// destroyed.
splat4d_result splat4d_stream_record(struct splat4d_stream *stream,
                                     struct splat4d_recorder **recorder);

// Submits a recording. It begins when all `waits` are reached, runs after all earlier submissions
// of this stream, and signals the `signals` when it is done. The recorder is invalid afterwards,
// also if the call fails. `ticket`, which may be null, receives the value to wait for.
//
// The semaphores are timeline semaphores of the device and live until the submission is done; the
// values of `waits` must be reached eventually, or else waiting for the ticket and destroying the
// stream block forever. Each signalled value must be greater than the semaphore's value and than
// all values that pending submissions signal.
splat4d_result splat4d_stream_submit(struct splat4d_stream *stream,
                                     struct splat4d_recorder *recorder,
                                     const struct splat4d_semaphore_point *waits,
                                     size_t wait_count,
                                     const struct splat4d_semaphore_point *signals,
                                     size_t signal_count,
                                     uint64_t *ticket);

// Waits for a submission and everything before it.
splat4d_result splat4d_stream_wait(struct splat4d_stream *stream, uint64_t ticket);

// Gets the timeline semaphore that counts the stream's submissions: it reaches a ticket's value
// when that submission is done.
// It lives as long as the stream.
splat4d_result splat4d_stream_get_semaphore(const struct splat4d_stream *stream,
                                            VkSemaphore *semaphore);

// Writes `bytes` bytes (a multiple of 4) to the start of a buffer. `data` may be freed on return.
splat4d_result splat4d_stream_upload(struct splat4d_stream *stream,
                                     struct splat4d_buffer *buffer,
                                     const void *data,
                                     size_t bytes);

// Waits for all submissions of the stream so far, and reads `bytes` bytes (a multiple of 4) from
// the start of a buffer.
splat4d_result splat4d_stream_download(struct splat4d_stream *stream,
                                       const struct splat4d_buffer *buffer,
                                       void *data,
                                       size_t bytes);

// Waits for all submissions, and destroys the handle; null is allowed.
void splat4d_stream_destroy(struct splat4d_stream *stream);

// Starts a recording that appends to the host's command buffer. After splat4d_recorder_finish the
// host may record more, and submits the buffer. `recorder` gets a handle, to be finished or
// destroyed.
//
// A recording begins with a barrier after all earlier commands of the queue and ends with a
// barrier before all later ones: the host needs no buffer barriers. It binds its own pipelines,
// descriptor sets and push constants.
//
// The command buffer must be of the device, of a pool for a family with compute, begun, and outside
// of a render pass; nobody else records into it until splat4d_recorder_finish. It is submitted once
// at most for each recording. Command buffers that use the same buffers, renderers, trainers or ops
// go to one queue in the order in which they were recorded, or are ordered by semaphores.
splat4d_result splat4d_recorder_over(const struct splat4d_device *device,
                                     VkCommandBuffer commands,
                                     struct splat4d_recorder **recorder);

// Ends a recording into the host's command buffer. The recorder is gone afterwards, also where this
// fails. `guard` gets a handle, to be destroyed when the device is done with the command buffer or
// the host has reset it.
splat4d_result splat4d_recorder_finish(struct splat4d_recorder *recorder,
                                       struct splat4d_guard **guard);

// Discards a recording; null is allowed. The host must reset or free a command buffer of its own
// that was recorded into, since the resources that it binds are freed.
void splat4d_recorder_destroy(struct splat4d_recorder *recorder);

// Destroys the guard; null is allowed. Call it when the device is done with the host's command
// buffer, or when that will never be submitted.
void splat4d_guard_destroy(struct splat4d_guard *guard);

// Creates a static scene from Gaussians, which are copied. `scene` gets a handle, to be destroyed.
splat4d_result splat4d_scene_create(const struct splat4d_gaussians *gaussians,
                                    struct splat4d_scene **scene);

// Opens a scene file or a 3DGS PLY. If `drop_bad` is not 0, Gaussians that are not finite are left
// out; otherwise they are an error. `scene` gets a handle, to be destroyed.
// SPLAT4D_ERROR_UNSUPPORTED if the library was built without the feature `files`.
splat4d_result splat4d_scene_open(const char *path,
                                  uint32_t drop_bad,
                                  struct splat4d_scene **scene);

// Writes a scene file, atomically by rename. SPLAT4D_ERROR_UNSUPPORTED if the library was built
// without the feature `files`.
splat4d_result splat4d_scene_save(const struct splat4d_scene *scene, const char *path);

// Gets the properties of a scene.
splat4d_result splat4d_scene_get_info(const struct splat4d_scene *scene,
                                      struct splat4d_scene_info *info);

// Gets an input camera of the scene, and its time in [0, 1]. `time` may be null.
splat4d_result splat4d_scene_get_camera(const struct splat4d_scene *scene,
                                        size_t index,
                                        struct splat4d_camera *camera,
                                        double *time);

// Reads a scene's Gaussians; those of a dynamic scene are in the canonical frame.
splat4d_result splat4d_scene_read(const struct splat4d_scene *scene,
                                  struct splat4d_gaussians_out *gaussians);

// Destroys the handle; null is allowed. Renderers and trainers made from the scene have copies.
void splat4d_scene_destroy(struct splat4d_scene *scene);

// Uploads a scene to a device. `renderer` gets a handle, to be destroyed. The scene may be
// destroyed afterwards.
splat4d_result splat4d_renderer_create(const struct splat4d_device *device,
                                       const struct splat4d_scene *scene,
                                       struct splat4d_renderer **renderer);

// Renders the scene as `camera` sees it at `time` in [0, 1], waits, and fills `picture`.
splat4d_result splat4d_renderer_render(struct splat4d_renderer *renderer,
                                       const struct splat4d_camera *camera,
                                       double time,
                                       const struct splat4d_picture *picture);

// Records a frame. `target` may be null for the renderer's own pixels. `frame` gets a handle, to
// be retired or destroyed when the device is done with the frame. Successive frames of the same
// size allocate nothing on the device, if each is retired.
splat4d_result splat4d_renderer_record(struct splat4d_renderer *renderer,
                                       struct splat4d_recorder *recorder,
                                       const struct splat4d_camera *camera,
                                       double time,
                                       const struct splat4d_target *target,
                                       struct splat4d_frame **frame);

// Retires a frame that the device is known to be done with: after splat4d_stream_wait for its
// submission, or after the guard of the host's recording is destroyed; SPLAT4D_ERROR_INPUT if
// called earlier. The frame is invalid afterwards, also if the call fails. `drawn` may be null.
splat4d_result splat4d_renderer_retire(struct splat4d_renderer *renderer,
                                       struct splat4d_frame *frame,
                                       struct splat4d_drawn *drawn);

// Gets the renderer's own pixels, for the host's own commands: the outputs of the last recorded
// frame that had no target. They are valid until the next frame, or until the renderer is
// destroyed. SPLAT4D_ERROR_INPUT before the first frame.
splat4d_result splat4d_renderer_get_pixels(const struct splat4d_renderer *renderer,
                                           struct splat4d_pixels *pixels);

// Destroys a frame that will not be retired; null is allowed.
void splat4d_frame_destroy(struct splat4d_frame *frame);

// Destroys the handle; null is allowed. Recorded work keeps the resources that it needs.
void splat4d_renderer_destroy(struct splat4d_renderer *renderer);

// Uploads Gaussians and training views to a device, to train a static scene. All data is copied.
// `settings` may be null for the defaults. `trainer` gets a handle, to be destroyed.
//
// Without views (`view_count` 0, for a loss of the host's own) `extent` is the unit of the positions'
// learning rate: about the distance of the outermost camera from the mean of all. With views it is
// computed from their cameras, and `extent` is ignored.
splat4d_result splat4d_trainer_create(const struct splat4d_device *device,
                                      const struct splat4d_gaussians *gaussians,
                                      const struct splat4d_view *views,
                                      size_t view_count,
                                      double extent,
                                      const struct splat4d_train_settings *settings,
                                      struct splat4d_trainer **trainer);

// Does one step on the next training view with the engine's own loss. Returns before the device is
// done.
splat4d_result splat4d_trainer_step(struct splat4d_trainer *trainer);

// Waits, and gets the last step's loss.
splat4d_result splat4d_trainer_get_loss(struct splat4d_trainer *trainer, struct splat4d_loss *loss);

// Gets the progress of training.
splat4d_result splat4d_trainer_get_progress(const struct splat4d_trainer *trainer,
                                            struct splat4d_progress *progress);

// Waits for the steps in flight, and reads the Gaussians.
splat4d_result splat4d_trainer_read(struct splat4d_trainer *trainer,
                                    struct splat4d_gaussians_out *gaussians);

// Waits for the steps in flight, and creates a scene from the Gaussians. `scene` gets a handle, to
// be destroyed.
splat4d_result splat4d_trainer_get_scene(struct splat4d_trainer *trainer,
                                         struct splat4d_scene **scene);

// Begins a step with the host's own loss: records the rendering of the image that `camera` sees.
// Then, in this order and in this or later recordings, call splat4d_trainer_backward,
// splat4d_trainer_update if the parameters are to be updated, and when the device is done
// splat4d_trainer_conclude.
splat4d_result splat4d_trainer_forward(struct splat4d_trainer *trainer,
                                       struct splat4d_recorder *recorder,
                                       const struct splat4d_camera *camera);

// Gets the pixel buffers of the current step's image, for the host's own commands.
splat4d_result splat4d_trainer_get_pixels(struct splat4d_trainer *trainer,
                                          struct splat4d_pixels *pixels);

// Records the computation of the gradients with respect to every parameter and the camera's pose,
// given those of the host's loss with respect to the image: `by_rgba`, with respect to
// premultiplied colour and alpha, 16 bytes per pixel; `by_depth`, 4 bytes per pixel, null if the
// loss does not use the depth. Where buffers are too short, the step has ended without an update.
splat4d_result splat4d_trainer_backward(struct splat4d_trainer *trainer,
                                        struct splat4d_recorder *recorder,
                                        const struct splat4d_buffer *by_rgba,
                                        const struct splat4d_buffer *by_depth);

// Records the update of every parameter with these gradients; the gradients of density control's
// regularisers are added to them. A frame that exceeded the capacity changes nothing.
splat4d_result splat4d_trainer_update(struct splat4d_trainer *trainer,
                                      struct splat4d_recorder *recorder);

// Ends the step when the device is known to be done with the recorded work: after
// splat4d_stream_wait for the submissions, or after the guards of the host's recordings are
// destroyed. If called earlier, it returns SPLAT4D_ERROR_INPUT and the step stays open.
// `fitted`, which may be null, gets 0 if the frame exceeded the capacity: no parameter was
// updated, the capacity is larger now, and the step should be repeated.
splat4d_result splat4d_trainer_conclude(struct splat4d_trainer *trainer, uint32_t *fitted);

// Gets the buffers of the gradients of the last backward, for the host's own commands. They are
// valid as long as the trainer lives; that of the pose until the image's size changes.
splat4d_result splat4d_trainer_get_gradients(struct splat4d_trainer *trainer,
                                             struct splat4d_gradients *gradients);

// Reads the gradients of the last backward, which the device must have finished: with respect to
// the parameters, and to the camera's pose (6 floats; SPLAT4D_ERROR_INPUT outside of a step).
// Either may be null.
splat4d_result splat4d_trainer_read_gradients(struct splat4d_trainer *trainer,
                                              struct splat4d_gaussians_out *gradients,
                                              float *pose);

// Waits for the steps in flight, and destroys the handle; null is allowed.
void splat4d_trainer_destroy(struct splat4d_trainer *trainer);

// Plans scans of at most `capacity` values. `scan` gets a handle, to be destroyed.
splat4d_result splat4d_scan_create(const struct splat4d_device *device,
                                   size_t capacity,
                                   struct splat4d_scan **scan);

// Records a scan. The dispatches: scan/single for a small capacity, else indirect/arguments,
// scan/reduce, scan/spine, scan/downsweep.
splat4d_result splat4d_scan_record(struct splat4d_scan *scan,
                                   struct splat4d_recorder *recorder,
                                   const struct splat4d_scan_buffers *buffers);

// Destroys the handle; null is allowed.
void splat4d_scan_destroy(struct splat4d_scan *scan);

// Plans sorts of at most `capacity` pairs by the key bits from `first_bit` up to, but excluding,
// `end_bit`: 0 and 32 for all bits. Other bits are ignored; pairs with equal bits keep their
// order. `sort` gets a handle, to be destroyed.
splat4d_result splat4d_sort_create(const struct splat4d_device *device,
                                   size_t capacity,
                                   uint32_t first_bit,
                                   uint32_t end_bit,
                                   struct splat4d_sort **sort);

// Records a sort. The dispatches: sort/plan; for each pass of up to 8 bits sort/count, those of
// splat4d_scan_record, sort/scatter.
splat4d_result splat4d_sort_record(struct splat4d_sort *sort,
                                   struct splat4d_recorder *recorder,
                                   const struct splat4d_sort_buffers *buffers);

// Destroys the handle; null is allowed.
void splat4d_sort_destroy(struct splat4d_sort *sort);

#ifdef __cplusplus
}  // extern "C"
#endif  // __cplusplus

#endif  /* SPLAT4D_H */
