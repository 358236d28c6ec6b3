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
 * - Transforms are named a_from_b. Pictures are row by row from the upper left; floats are 32 bits.
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

// Version of the library that this header is of. Before 1.0 a minor version may break the interface.
#define SPLAT4D_VERSION_MAJOR 0

// As above.
#define SPLAT4D_VERSION_MINOR 1

// As above.
#define SPLAT4D_VERSION_PATCH 0

// Version of the binary interface: it changes when a program must be compiled anew.
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

// 3DGS-MCMC: the dead move to the living, up to max_gaussians. The default.
#define SPLAT4D_GROWTH_MCMC 0

// 3D Gaussian Splatting: clone, split, prune.
#define SPLAT4D_GROWTH_ADAPTIVE 1

// The Gaussians that there are.
#define SPLAT4D_GROWTH_NONE 2

// What a call returns.
enum splat4d_result
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : int32_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
    // Done.
    SPLAT4D_OK = 0,
    // A pointer or handle that must be there is null, or a pointer is not aligned.
    SPLAT4D_ERROR_POINTER = 1,
    // A structure's struct_size is not set, or the structure has fields set that this library does
    // not know.
    SPLAT4D_ERROR_STRUCT_SIZE = 2,
    // An argument cannot be worked with.
    SPLAT4D_ERROR_INPUT = 3,
    // An array or a buffer is too short, or lengths do not fit together.
    SPLAT4D_ERROR_SHAPE = 4,
    // A buffer is larger than one binding of the device may be.
    SPLAT4D_ERROR_RANGE_LIMIT = 5,
    // No Vulkan loader, no driver, or no device that fits.
    SPLAT4D_ERROR_NO_DEVICE = 6,
    // The device, or the library as it was built, lacks something.
    SPLAT4D_ERROR_UNSUPPORTED = 7,
    // Device memory ran out.
    SPLAT4D_ERROR_OUT_OF_MEMORY = 8,
    // The device was lost: only destroying is left.
    SPLAT4D_ERROR_DEVICE_LOST = 9,
    // A Vulkan call failed.
    SPLAT4D_ERROR_VULKAN = 10,
    // A file could not be read or written.
    SPLAT4D_ERROR_IO = 11,
    // A file holds something else than its format says.
    SPLAT4D_ERROR_FORMAT = 12,
    // No result could be reached.
    SPLAT4D_ERROR_FAILED = 13,
    // The program was compiled for another binary interface.
    SPLAT4D_ERROR_VERSION = 14,
    // A bug of the library's: only destroying is left for the handles of the call.
    SPLAT4D_ERROR_INTERNAL = 15,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum splat4d_result splat4d_result;
#else
typedef int32_t splat4d_result;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

// Memory on a device, of whole words of 4 bytes.
typedef struct splat4d_buffer splat4d_buffer;

// A Vulkan device. Everything made from it keeps what it needs of it: handles may be destroyed in
// any order. Any number of threads may use a device at once.
typedef struct splat4d_device splat4d_device;

// A recorded frame.
typedef struct splat4d_frame splat4d_frame;

// What a recording into the host's command buffer needs while the device works on it.
typedef struct splat4d_guard splat4d_guard;

// A recording under way. Functions named ..._record, and a trainer's forward, backward and update,
// add to it, ordered by the engine's own barriers. Where one fails, throw the recording away.
typedef struct splat4d_recorder splat4d_recorder;

// A scene on a device. Pictures of one size after the other cost no allocation.
typedef struct splat4d_renderer splat4d_renderer;

// A plan for exclusive prefix sums, and what they work in.
typedef struct splat4d_scan splat4d_scan;

// A scene on the host.
typedef struct splat4d_scene splat4d_scene;

// A plan for a stable sort of key-payload pairs, and what it works in.
typedef struct splat4d_sort splat4d_sort;

// Submissions to the device's queue, one after the other.
typedef struct splat4d_stream splat4d_stream;

// Gaussians in training.
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

// What a device must offer and be made with.
typedef struct splat4d_requirements {
    // sizeof(splat4d_requirements).
    size_t struct_size;
    // Of instance and device, packed as Vulkan packs it.
    uint32_t api_version;
    // SPLAT4D_FEATURE_*: what must be enabled. No extension must be.
    uint32_t features;
    // VkQueueFlags that the queue's family must offer.
    uint32_t queue_flags;
    // VkSubgroupFeatureFlags in compute shaders.
    uint32_t subgroup_operations;
    // maxComputeWorkGroupInvocations and `maxComputeWorkGroupSize[0]`, at least.
    uint32_t workgroup_invocations;
    // maxComputeSharedMemorySize, at least; bytes.
    uint32_t shared_memory;
    // maxPushConstantsSize, at least; bytes.
    uint32_t push_constants;
    // maxPerStageDescriptorStorageBuffers and maxDescriptorSetStorageBuffers, at least.
    uint32_t storage_buffers;
} splat4d_requirements;

// A function of a host's that is given the pointer registered with it. It must not throw and not
// call splat4d with the handle under way.
typedef void (*splat4d_callback)(void *user);

// A Vulkan device that a host has made.
typedef struct splat4d_host_device {
    // sizeof(splat4d_host_device).
    size_t struct_size;
    // The loader's.
    PFN_vkGetInstanceProcAddr get_instance_proc_addr;
    // Made for Vulkan 1.3 or newer.
    VkInstance instance;
    // One of the instance's.
    VkPhysicalDevice physical_device;
    // Made for Vulkan 1.3 or newer, with what splat4d_requirements lists.
    VkDevice device;
    // A queue of the device, for the engine's own submissions.
    VkQueue queue;
    // The queue's family, which must offer compute.
    uint32_t queue_family;
    // SPLAT4D_FEATURE_*: what the device was made with.
    uint32_t features;
    // Needed where anybody else uses the queue while the engine may submit: taken before, and given
    // back after, on the thread that submits. Both or neither.
    splat4d_callback queue_lock;
    // As above.
    splat4d_callback queue_unlock;
    // Given to queue_lock and queue_unlock.
    void *queue_user;
    // Called once when nothing of the engine's uses the device any more, on whatever thread destroys
    // the last of it; also where splat4d_device_adopt fails, unless with SPLAT4D_ERROR_POINTER or
    // SPLAT4D_ERROR_STRUCT_SIZE.
    splat4d_callback on_drop;
    // Given to on_drop.
    void *on_drop_user;
} splat4d_host_device;

// What a device is.
typedef struct splat4d_device_info {
    // sizeof(splat4d_device_info).
    size_t struct_size;
    // Its name, with a zero at the end; cut off where it is longer.
    char name[256];
    // VkPhysicalDeviceType.
    uint32_t kind;
    // Packed as Vulkan packs it.
    uint32_t api_version;
    // Offsets of buffers that are adopted are multiples of this many bytes.
    uint64_t storage_alignment;
    // The largest buffer that an op may use, bytes.
    uint64_t storage_range;
    // Bytes of the engine's buffers alive now.
    uint64_t bytes;
    // How many buffers and pools were made so far: in steady work it stands still.
    uint64_t allocations;
} splat4d_device_info;

// A part of a buffer of the host's, to adopt.
typedef struct splat4d_host_buffer {
    // sizeof(splat4d_host_buffer).
    size_t struct_size;
    // The buffer, of the device, bound to memory.
    VkBuffer buffer;
    // First byte of the part; a multiple of splat4d_device_info.storage_alignment.
    uint64_t offset;
    // Bytes of the part, a multiple of 4.
    uint64_t bytes;
    // VkBufferUsageFlags that the whole buffer was made with: STORAGE_BUFFER, TRANSFER_SRC and
    // TRANSFER_DST at least.
    uint32_t usage;
    // Called once when nothing of the engine's uses the buffer any more; also where
    // splat4d_buffer_adopt fails, unless with SPLAT4D_ERROR_POINTER or SPLAT4D_ERROR_STRUCT_SIZE.
    splat4d_callback on_drop;
    // Given to on_drop.
    void *on_drop_user;
} splat4d_host_buffer;

// A part of a VkBuffer; buffer is null and bytes 0 where there is none.
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
    // To wait for, or to signal.
    uint64_t value;
} splat4d_semaphore_point;

// Gaussians of a static scene, one row of every array per Gaussian.
typedef struct splat4d_gaussians {
    // sizeof(splat4d_gaussians).
    size_t struct_size;
    // How many.
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

// What a scene holds.
typedef struct splat4d_scene_info {
    // sizeof(splat4d_scene_info).
    size_t struct_size;
    // Number of Gaussians.
    size_t count;
    // Degree of the spherical harmonics.
    uint32_t sh_degree;
    // 1 where it moves.
    uint32_t is_dynamic;
    // Number of cameras of the input.
    size_t camera_count;
    // Red, green, blue behind everything.
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
    // Principal point, x, from the left edge.
    double cx;
    // Principal point, y, from the upper edge.
    double cy;
    // Width of the picture, pixels.
    uint32_t width;
    // Height of the picture, pixels.
    uint32_t height;
    // view_from_world: a quaternion w, x, y, z, which need not be normalised; all 0 for no rotation.
    double rotation[4];
    // view_from_world: x_view = rotation * x_world + translation.
    double translation[3];
} splat4d_camera;

// Room for Gaussians, laid out as in splat4d_gaussians. What is null is left out.
typedef struct splat4d_gaussians_out {
    // sizeof(splat4d_gaussians_out).
    size_t struct_size;
    // How many there is room for.
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
    // The degree that `sh` has room for: exactly that of what is read.
    uint32_t sh_degree;
} splat4d_gaussians_out;

// Room for a picture in the host's memory. What is null is left out.
typedef struct splat4d_picture {
    // sizeof(splat4d_picture).
    size_t struct_size;
    // Premultiplied red, green, blue without background, and alpha: 4 * width * height.
    float *rgba;
    // Floats that `rgba` has room for.
    size_t rgba_len;
    // Sum of alpha * T * z, divided by alpha the mean depth: width * height.
    float *depth;
    // Floats that `depth` has room for.
    size_t depth_len;
} splat4d_picture;

// Where a frame goes: buffers of the device, the host's too. What is null stays in the renderer's own
// pixels.
typedef struct splat4d_target {
    // sizeof(splat4d_target).
    size_t struct_size;
    // As in splat4d_picture: 16 bytes a pixel.
    struct splat4d_buffer *rgba;
    // As in splat4d_picture: 4 bytes a pixel.
    struct splat4d_buffer *depth;
    // In red, how much of alpha comes from what moves; green and blue are 0; alpha: 16 bytes a pixel.
    // Costs another pass of blending.
    struct splat4d_buffer *mask;
} splat4d_target;

// What became of a frame.
typedef struct splat4d_drawn {
    // sizeof(splat4d_drawn).
    size_t struct_size;
    // 1 where every splat was drawn; else the farthest were left out, and the next frame has room.
    uint32_t is_whole;
    // Gaussians that were visible.
    size_t visible;
    // (splat, tile) pairs; 2³² − 1 stands for as many or more.
    size_t intersections;
} splat4d_drawn;

// A picture on the device, in buffers of the engine's.
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

// A picture to train on.
typedef struct splat4d_view {
    // sizeof(splat4d_view); the same in each of an array, whose elements lie so far apart.
    size_t struct_size;
    // Its camera, of the picture's size.
    const struct splat4d_camera *camera;
    // Red, green, blue in [0, 1]: 3 * width * height.
    const float *rgb;
    // Weight of each pixel in [0, 1]: width * height; null for 1.
    const float *weights;
} splat4d_view;

// How to train. 0 is the default of every field; where 0 itself is meant, give a value below it.
typedef struct splat4d_train_settings {
    // sizeof(splat4d_train_settings).
    size_t struct_size;
    // Steps that the schedules are made for; 0 for 30000.
    uint32_t steps;
    // SPLAT4D_GROWTH_*.
    uint32_t growth;
    // Growth ends here; 0 for a million.
    size_t max_gaussians;
    // Bands of the spherical harmonics, 1 to 4: the degree and 1; 0 for 4.
    uint32_t sh_bands;
    // A band is added each time so many steps have passed; 0 for 1000, below 0 for all bands from the
    // first step.
    int32_t sh_interval;
    // Share of D-SSIM in the loss; 0 for 0.2, below 0 for none.
    float ssim_share;
    // Red, green, blue behind everything.
    float background[3];
    // Learning rates; 0 for those of 3D Gaussian Splatting, below 0 for none. Positions, at the first
    // step and at the last, are in units of the scene's extent.
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
    // Decides the order of the pictures and everything random.
    uint64_t seed;
} splat4d_train_settings;

// Parts of the last step's loss.
typedef struct splat4d_loss {
    // sizeof(splat4d_loss).
    size_t struct_size;
    // 1 where there is one; else the rest is 0.
    uint32_t is_known;
    // Weighted mean of the absolute differences.
    double l1;
    // Weighted mean of SSIM.
    double ssim;
} splat4d_loss;

// How far training is.
typedef struct splat4d_progress {
    // sizeof(splat4d_progress).
    size_t struct_size;
    // Steps done.
    uint32_t step;
    // Degree of the spherical harmonics of what is read.
    uint32_t sh_degree;
    // Number of Gaussians.
    size_t count;
} splat4d_progress;

// Gradients on the device, in the layout of the parameters: floats, row after row.
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
    // By the camera's pose, for a left perturbation of view_from_world: translation, rotation; 6.
    // Empty before backward.
    struct splat4d_range pose;
} splat4d_gradients;

// The buffers of one scan, of words.
typedef struct splat4d_scan_buffers {
    // sizeof(splat4d_scan_buffers).
    size_t struct_size;
    // Holds the number of values; what exceeds the capacity is left out.
    const struct splat4d_buffer *count;
    // Word at which it lies.
    uint64_t count_at;
    // The values; as long as the capacity.
    const struct splat4d_buffer *values;
    // Gets `prefix[i] = values[0] + ... + values[i - 1]`, modulo 2^32; untouched from the number of
    // values on.
    struct splat4d_buffer *prefix;
    // Gets the sum of all values.
    struct splat4d_buffer *total;
    // Word at which it goes.
    uint64_t total_at;
} splat4d_scan_buffers;

// The buffers of one sort, of words. The input is left as it is.
typedef struct splat4d_sort_buffers {
    // sizeof(splat4d_sort_buffers).
    size_t struct_size;
    // Holds the number of pairs; what exceeds the capacity is left out.
    const struct splat4d_buffer *count;
    // Word at which it lies.
    uint64_t count_at;
    // The keys; as long as the capacity.
    const struct splat4d_buffer *keys;
    // What goes with them; likewise.
    const struct splat4d_buffer *payload;
    // Gets the sorted keys; untouched from the number of pairs on.
    struct splat4d_buffer *sorted_keys;
    // Gets what goes with them.
    struct splat4d_buffer *sorted_payload;
} splat4d_sort_buffers;

#ifdef __cplusplus
extern "C" {
#endif // __cplusplus

// Version of the library that runs: major * 1000000 + minor * 1000 + patch.
uint32_t splat4d_version(void);

// Whether the library that runs understands programs compiled with this header: call it once, with
// SPLAT4D_ABI_VERSION, before anything else. SPLAT4D_ERROR_VERSION where it does not.
splat4d_result splat4d_check_abi(uint32_t abi_version);

// The message of the last call on this thread that failed; empty before the first. UTF-8, owned by
// the library, valid until the next call on this thread fails. A call that succeeds leaves it.
const char *splat4d_last_error(void);

// Opens a device. `request` may be null for the best. `device` gets a handle, to be destroyed.
splat4d_result splat4d_device_open(const struct splat4d_request *request,
                                   struct splat4d_device **device);

// What a device must offer and be made with, for hosts that make their own.
splat4d_result splat4d_requirements_query(struct splat4d_requirements *requirements);

// What a physical device lacks of the requirements, in words, separated by ", "; empty where the
// engine can run on it. As much as fits goes to `text` (`size` bytes, with a zero at the end; null
// where size is 0), and the length of all of it to `length`, which may be null.
//
// The instance must be alive and of that loader, and the physical device one of its own.
splat4d_result splat4d_requirements_lacking(PFN_vkGetInstanceProcAddr get_instance_proc_addr,
                                            VkInstance instance,
                                            VkPhysicalDevice physical_device,
                                            char *text,
                                            size_t size,
                                            size_t *length);

// Works on a device that the host has made. `device` gets a handle, to be destroyed. Nothing is
// written to disk; messages of a validation layer go to the host.
//
// The handles must belong together; instance and device must have been made for Vulkan 1.3 or newer,
// the device with every feature that `features` claims. The loader stays loaded, and instance and
// device alive, until on_drop is called, or without it until everything made from the device is
// destroyed. Nobody uses the queue while the engine does: either it is the engine's alone, or every
// other use takes the lock that queue_lock takes; vkDeviceWaitIdle uses all queues.
splat4d_result splat4d_device_adopt(const struct splat4d_host_device *host,
                                    struct splat4d_device **device);

// What the device is, and what the engine holds on it.
splat4d_result splat4d_device_get_info(const struct splat4d_device *device,
                                       struct splat4d_device_info *info);

// Takes what the validation layer has said since it was last taken, line by line: empty where it has
// said nothing, without the layer, and on a host's device. `text`, `size` and `length` as for
// splat4d_requirements_lacking; nothing is taken where not all of it fits.
splat4d_result splat4d_device_take_validation_messages(const struct splat4d_device *device,
                                                       char *text,
                                                       size_t size,
                                                       size_t *length);

// Destroys the handle; null is fine. The device goes when the last that was made from it is gone.
void splat4d_device_destroy(struct splat4d_device *device);

// Makes a buffer of `bytes` (a multiple of 4, above 0) with undefined content. `buffer` gets a handle,
// to be destroyed.
splat4d_result splat4d_buffer_create(const struct splat4d_device *device,
                                     uint64_t bytes,
                                     struct splat4d_buffer **buffer);

// Takes a part of a buffer of the host's, which stays the host's. `buffer` gets a handle, to be
// destroyed; the VkBuffer must outlive what was recorded with it, until on_drop is called.
//
// The buffer must belong to the family of the device's queue or be shared concurrently, and others
// use it only in order with the engine's work: in the same queue before or after a recording, or
// behind a semaphore.
splat4d_result splat4d_buffer_adopt(const struct splat4d_device *device,
                                    const struct splat4d_host_buffer *host,
                                    struct splat4d_buffer **buffer);

// Where a buffer lies, for the host's own commands: keep the handle until these are done, and order
// them with the engine's work.
splat4d_result splat4d_buffer_get_range(const struct splat4d_buffer *buffer,
                                        struct splat4d_range *range);

// Destroys the handle; null is fine. What was recorded with it keeps the memory until it is done.
void splat4d_buffer_destroy(struct splat4d_buffer *buffer);

// Makes a stream. `stream` gets a handle, to be destroyed.
splat4d_result splat4d_stream_create(const struct splat4d_device *device,
                                     struct splat4d_stream **stream);

// Starts a recording for splat4d_stream_submit. `recorder` gets a handle, which is submitted or
// destroyed.
splat4d_result splat4d_stream_record(struct splat4d_stream *stream,
                                     struct splat4d_recorder **recorder);

// Submits a recording, which begins when the `waits` have come, runs after everything submitted before
// on this stream, and brings the `signals` when it is done. The recorder is gone afterwards, also
// where this fails. `ticket`, which may be null, gets what to wait for.
//
// The semaphores are timeline semaphores of the device and live until the submission is done; what is
// waited for comes, else waiting for the ticket and destroying the stream never end; each value
// signalled is above all that the semaphore had or gets from submissions pending.
splat4d_result splat4d_stream_submit(struct splat4d_stream *stream,
                                     struct splat4d_recorder *recorder,
                                     const struct splat4d_semaphore_point *waits,
                                     size_t wait_count,
                                     const struct splat4d_semaphore_point *signals,
                                     size_t signal_count,
                                     uint64_t *ticket);

// Waits for a submission and everything before it.
splat4d_result splat4d_stream_wait(struct splat4d_stream *stream, uint64_t ticket);

// The timeline semaphore that counts the stream's submissions: it reaches a ticket when that is done.
// It lives as long as the stream.
splat4d_result splat4d_stream_get_semaphore(const struct splat4d_stream *stream,
                                            VkSemaphore *semaphore);

// Writes a buffer from its start: `bytes`, a multiple of 4. `data` is free again on return.
splat4d_result splat4d_stream_upload(struct splat4d_stream *stream,
                                     struct splat4d_buffer *buffer,
                                     const void *data,
                                     size_t bytes);

// Waits for everything submitted on the stream so far, and reads a buffer from its start: `bytes`, a
// multiple of 4.
splat4d_result splat4d_stream_download(struct splat4d_stream *stream,
                                       const struct splat4d_buffer *buffer,
                                       void *data,
                                       size_t bytes);

// Waits for what was submitted, and destroys the handle; null is fine.
void splat4d_stream_destroy(struct splat4d_stream *stream);

// Records into the host's command buffer, from where the host is in it; the host goes on with it
// after splat4d_recorder_finish, and submits it. `recorder` gets a handle, which is finished or
// destroyed.
//
// A recording begins with a barrier from everything that the queue was given before and ends with one
// to everything after: the host adds none for buffers. It binds pipelines, descriptor sets and push
// constants of its own.
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

// Throws a recording away; null is fine. Into the host's command buffer: the host must reset or free
// that, since what it binds is gone.
void splat4d_recorder_destroy(struct splat4d_recorder *recorder);

// Tells that the device is done with a command buffer of the host's, or that it will never be
// submitted; null is fine.
void splat4d_guard_destroy(struct splat4d_guard *guard);

// Makes a static scene of some Gaussians, which are copied. `scene` gets a handle, to be destroyed.
splat4d_result splat4d_scene_create(const struct splat4d_gaussians *gaussians,
                                    struct splat4d_scene **scene);

// Opens a scene's file or a 3DGS PLY. Not 0 as `drop_bad` leaves out Gaussians that are not finite,
// which are an error otherwise. `scene` gets a handle, to be destroyed. SPLAT4D_ERROR_UNSUPPORTED
// where the library was built without the feature `files`.
splat4d_result splat4d_scene_open(const char *path,
                                  uint32_t drop_bad,
                                  struct splat4d_scene **scene);

// Writes a scene's file by rename. SPLAT4D_ERROR_UNSUPPORTED where the library was built without the
// feature `files`.
splat4d_result splat4d_scene_save(const struct splat4d_scene *scene,
                                  const char *path);

// What a scene holds.
splat4d_result splat4d_scene_get_info(const struct splat4d_scene *scene,
                                      struct splat4d_scene_info *info);

// A camera of the scene's input, and its time in [0, 1]. `time` may be null.
splat4d_result splat4d_scene_get_camera(const struct splat4d_scene *scene,
                                        size_t index,
                                        struct splat4d_camera *camera,
                                        double *time);

// Reads a scene's Gaussians, in the canonical frame where it moves.
splat4d_result splat4d_scene_read(const struct splat4d_scene *scene,
                                  struct splat4d_gaussians_out *gaussians);

// Destroys the handle; null is fine. Renderers and trainers made from the scene have copies.
void splat4d_scene_destroy(struct splat4d_scene *scene);

// Puts a scene on a device. `renderer` gets a handle, to be destroyed; the scene may go.
splat4d_result splat4d_renderer_create(const struct splat4d_device *device,
                                       const struct splat4d_scene *scene,
                                       struct splat4d_renderer **renderer);

// Renders the scene as `camera` sees it at `time` in [0, 1], waits, and fills `picture`.
splat4d_result splat4d_renderer_render(struct splat4d_renderer *renderer,
                                       const struct splat4d_camera *camera,
                                       double time,
                                       const struct splat4d_picture *picture);

// Records a frame. `target` may be null for the renderer's own pixels. `frame` gets a handle, which is
// retired or destroyed when the device is done with the frame. Frames of one size after the other
// allocate nothing on the device, as long as each is retired.
splat4d_result splat4d_renderer_record(struct splat4d_renderer *renderer,
                                       struct splat4d_recorder *recorder,
                                       const struct splat4d_camera *camera,
                                       double time,
                                       const struct splat4d_target *target,
                                       struct splat4d_frame **frame);

// Takes back a frame with which the device is known to be done: after splat4d_stream_wait for its
// submission, or when the guard of the host's recording is destroyed. SPLAT4D_ERROR_INPUT earlier. The
// frame is gone afterwards, also where this fails. `drawn` may be null.
splat4d_result splat4d_renderer_retire(struct splat4d_renderer *renderer,
                                       struct splat4d_frame *frame,
                                       struct splat4d_drawn *drawn);

// Where the last frame recorded goes as far as it has no target, for the host's own commands: until
// the next frame, or until the renderer is destroyed. SPLAT4D_ERROR_INPUT before the first.
splat4d_result splat4d_renderer_get_pixels(const struct splat4d_renderer *renderer,
                                           struct splat4d_pixels *pixels);

// Throws a frame away that nobody will retire; null is fine.
void splat4d_frame_destroy(struct splat4d_frame *frame);

// Destroys the handle; null is fine. What was recorded keeps what it needs.
void splat4d_renderer_destroy(struct splat4d_renderer *renderer);

// Puts Gaussians and pictures on a device, to be trained as a static scene. Everything is copied.
// `settings` may be null for the defaults. `trainer` gets a handle, to be destroyed.
//
// Without views (`view_count` 0, for a loss of the host's own) `extent` is the unit of the positions'
// learning rate: about the distance of the outermost camera from the middle of all. With views it is
// found from their cameras, and `extent` is not looked at.
splat4d_result splat4d_trainer_create(const struct splat4d_device *device,
                                      const struct splat4d_gaussians *gaussians,
                                      const struct splat4d_view *views,
                                      size_t view_count,
                                      double extent,
                                      const struct splat4d_train_settings *settings,
                                      struct splat4d_trainer **trainer);

// Does one step on the next picture with the engine's own loss. Returns before the device is done.
splat4d_result splat4d_trainer_step(struct splat4d_trainer *trainer);

// Waits, and gives the last step's loss.
splat4d_result splat4d_trainer_get_loss(struct splat4d_trainer *trainer, struct splat4d_loss *loss);

// How far training is.
splat4d_result splat4d_trainer_get_progress(const struct splat4d_trainer *trainer,
                                            struct splat4d_progress *progress);

// Waits for the steps under way, and reads the Gaussians.
splat4d_result splat4d_trainer_read(struct splat4d_trainer *trainer,
                                    struct splat4d_gaussians_out *gaussians);

// Waits for the steps under way, and makes a scene of the Gaussians. `scene` gets a handle, to be
// destroyed.
splat4d_result splat4d_trainer_get_scene(struct splat4d_trainer *trainer,
                                         struct splat4d_scene **scene);

// Begins a step with the host's own loss: records the picture that `camera` sees. What follows, each
// in its turn, in this recording or a later one: splat4d_trainer_backward, splat4d_trainer_update if
// the trainer is to learn from it, and when the device is done splat4d_trainer_conclude.
splat4d_result splat4d_trainer_forward(struct splat4d_trainer *trainer,
                                       struct splat4d_recorder *recorder,
                                       const struct splat4d_camera *camera);

// Where the picture of the step under way lies, for the host's own commands.
splat4d_result splat4d_trainer_get_pixels(struct splat4d_trainer *trainer,
                                          struct splat4d_pixels *pixels);

// Records the gradients by every parameter and by the camera's pose, given those of the host's loss by
// the picture: `by_rgba`, by premultiplied colour and alpha, 16 bytes a pixel; `by_depth`, 4 bytes a
// pixel, null where the loss does not read the depth.
splat4d_result splat4d_trainer_backward(struct splat4d_trainer *trainer,
                                        struct splat4d_recorder *recorder,
                                        const struct splat4d_buffer *by_rgba,
                                        const struct splat4d_buffer *by_depth);

// Records the update of every parameter by these gradients. A frame that did not fit changes nothing.
splat4d_result splat4d_trainer_update(struct splat4d_trainer *trainer,
                                      struct splat4d_recorder *recorder);

// Ends the step when the device is known to be done with what was recorded: after splat4d_stream_wait
// for the submissions, or when the guards of the host's recordings are destroyed. SPLAT4D_ERROR_INPUT
// earlier; the step is still under way then.
// `fitted`, which may be null, gets 0 where the frame did not fit: nothing was learnt, there is more
// room now, and the step should be done again.
splat4d_result splat4d_trainer_conclude(struct splat4d_trainer *trainer,
                                        uint32_t *fitted);

// Where the gradients of the last backward lie, for the host's own commands. They stay where they are
// as long as the trainer lives; that by the pose until the picture's size changes.
splat4d_result splat4d_trainer_get_gradients(struct splat4d_trainer *trainer,
                                             struct splat4d_gradients *gradients);

// Reads the gradients of the last backward, with which the device must be done, by the parameters and
// by the camera's pose: 6 floats, outside of a step SPLAT4D_ERROR_INPUT. Either may be null.
splat4d_result splat4d_trainer_read_gradients(struct splat4d_trainer *trainer,
                                              struct splat4d_gaussians_out *gradients,
                                              float *pose);

// Destroys the handle, and waits for the steps under way; null is fine.
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

// Destroys the handle; null is fine.
void splat4d_scan_destroy(struct splat4d_scan *scan);

// Plans sorts of at most `capacity` pairs by the bits of their keys from `first_bit` up to, and
// without, `end_bit`: 0 and 32 for all. Bits outside do not count; pairs whose bits are equal keep
// their order. `sort` gets a handle, to be destroyed.
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

// Destroys the handle; null is fine.
void splat4d_sort_destroy(struct splat4d_sort *sort);

#ifdef __cplusplus
}  // extern "C"
#endif  // __cplusplus

#endif  /* SPLAT4D_H */
