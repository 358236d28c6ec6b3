/*
 * A host in C with plain Vulkan: its own device, its own allocator, its own frame with its own timeline
 * semaphore, in which it draws splats into its own memory; and all that such a host can get wrong.
 *
 *   host FOLDER WIDTH HEIGHT COUNT
 *
 * The folder holds what the Rust side has rendered: the same bits must come out.
 */
#include "vulkan_host.h"

static void wrong_devices(Host *host)
{
    splat4d_device *device = NULL;
    char lacking[64] = "x";
    size_t length = 99;
    int drops = 0;
    const splat4d_host_device good = host_lend(host, &drops);
    splat4d_host_device bad = good;
    bad.queue_family = host->families;
    FAILS(SPLAT4D_ERROR_INPUT, "queue family", splat4d_device_adopt(&bad, &device));
    bad = good;
    bad.features &= ~(uint32_t)SPLAT4D_FEATURE_SCALAR_BLOCK_LAYOUT;
    FAILS(SPLAT4D_ERROR_UNSUPPORTED, "scalarBlockLayout", splat4d_device_adopt(&bad, &device));
    bad = good;
    bad.queue = NULL;
    FAILS(SPLAT4D_ERROR_INPUT, "queue is a null", splat4d_device_adopt(&bad, &device));
    bad = good;
    bad.device = NULL;
    FAILS(SPLAT4D_ERROR_INPUT, "device is a null", splat4d_device_adopt(&bad, &device));
    bad = good;
    bad.physical_device = NULL;
    FAILS(SPLAT4D_ERROR_INPUT, "physical device is a null", splat4d_device_adopt(&bad, &device));
    bad = good;
    bad.instance = NULL;
    FAILS(SPLAT4D_ERROR_INPUT, "instance is a null", splat4d_device_adopt(&bad, &device));
    CHECK(drops == 6 && device == NULL);
    OK(splat4d_requirements_lacking(vkGetInstanceProcAddr, host->instance, host->physical, lacking,
                                    sizeof lacking, &length));
    CHECK(length == 0 && lacking[0] == 0);
}

static void wrong_buffers(Host *host)
{
    int drops = 0, returned = 0;
    const splat4d_host_device lent = host_lend(host, &drops);
    const Piece piece = host_piece(host, 1024);
    const splat4d_host_buffer good = part_of(&piece, 0, 1024);
    splat4d_host_buffer bad = good;
    splat4d_device *device = NULL, *own = open_device();
    splat4d_buffer *one = NULL, *two = NULL, *strange = NULL;
    splat4d_scan *scan = NULL;
    splat4d_stream *stream = NULL;
    splat4d_recorder *recorder = NULL;
    splat4d_semaphore_point point = {VK_NULL_HANDLE, 1};
    const VkCommandBuffer commands = host_commands(host);
    NEW(splat4d_device_info, info);
    NEW(splat4d_scan_buffers, buffers);
    OK(splat4d_device_adopt(&lent, &device));
    OK(splat4d_device_get_info(device, &info));
    CHECK(info.kind == VK_PHYSICAL_DEVICE_TYPE_CPU);
    bad.on_drop = count_up;
    bad.on_drop_user = &returned;
    bad.usage = VK_BUFFER_USAGE_TRANSFER_SRC_BIT | VK_BUFFER_USAGE_TRANSFER_DST_BIT;
    FAILS(SPLAT4D_ERROR_INPUT, "STORAGE_BUFFER", splat4d_buffer_adopt(device, &bad, &one));
    bad.usage = good.usage;
    bad.buffer = VK_NULL_HANDLE;
    FAILS(SPLAT4D_ERROR_INPUT, "null", splat4d_buffer_adopt(device, &bad, &one));
    bad.buffer = good.buffer;
    bad.bytes = 1 << 20;
    FAILS(SPLAT4D_ERROR_INPUT, "at most", splat4d_buffer_adopt(device, &bad, &one));
    bad.bytes = 4;
    bad.offset = info.storage_alignment / 2;
    FAILS(SPLAT4D_ERROR_INPUT, "multiple", splat4d_buffer_adopt(device, &bad, &one));
    CHECK(one == NULL && returned == 4);

    /* Two handles of one place, a buffer too small, one of another device. */
    OK(splat4d_buffer_adopt(device, &good, &one));
    OK(splat4d_buffer_adopt(device, &good, &two));
    OK(splat4d_buffer_create(own, 1024, &strange));
    OK(splat4d_scan_create(device, 256, &scan));
    host_begin(commands);
    OK(splat4d_recorder_over(device, commands, &recorder));
    buffers.count = buffers.values = one;
    buffers.prefix = two;
    buffers.total = strange;
    FAILS(SPLAT4D_ERROR_INPUT, "share memory", splat4d_scan_record(scan, recorder, &buffers));
    buffers.prefix = strange;
    buffers.total = two;
    buffers.count = buffers.values = strange;
    FAILS(SPLAT4D_ERROR_INPUT, "share memory", splat4d_scan_record(scan, recorder, &buffers));
    buffers.count = buffers.values = one;
    buffers.total = NULL;
    OK(splat4d_buffer_create(device, 4, &buffers.total));
    FAILS(SPLAT4D_ERROR_INPUT, "another device", splat4d_scan_record(scan, recorder, &buffers));
    splat4d_buffer_destroy(two);
    bad = good;
    bad.bytes = 512;
    OK(splat4d_buffer_adopt(device, &bad, &two));
    buffers.values = two;
    FAILS(SPLAT4D_ERROR_SHAPE, "values", splat4d_scan_record(scan, recorder, &buffers));
    splat4d_recorder_destroy(recorder);
    /* What failed is thrown away. */
    VK(vkResetCommandBuffer(commands, 0));

    /* A recording goes where it belongs. */
    OK(splat4d_stream_create(device, &stream));
    host_begin(commands);
    OK(splat4d_recorder_over(device, commands, &recorder));
    FAILS(SPLAT4D_ERROR_INPUT, "finish",
          splat4d_stream_submit(stream, recorder, NULL, 0, NULL, 0, NULL));
    VK(vkResetCommandBuffer(commands, 0));
    OK(splat4d_stream_record(stream, &recorder));
    FAILS(SPLAT4D_ERROR_INPUT, "null handle",
          splat4d_stream_submit(stream, recorder, &point, 1, NULL, 0, NULL));
    FAILS(SPLAT4D_ERROR_INPUT, "null handle", splat4d_recorder_over(device, NULL, &recorder));

    /* The device's handle goes first; the device itself with the last that was made from it. */
    splat4d_device_destroy(device);
    splat4d_device_destroy(own);
    splat4d_stream_destroy(stream);
    splat4d_scan_destroy(scan);
    splat4d_buffer_destroy(buffers.total);
    splat4d_buffer_destroy(strange);
    splat4d_buffer_destroy(one);
    CHECK(drops == 0);
    splat4d_buffer_destroy(two);
    CHECK(drops == 1);
}

enum { SLOTS = 2, FRAMES = 12, STEADY = 6 };

/* One of the frames under way. Colour, depth and mask are parts of one buffer. */
typedef struct {
    VkCommandBuffer commands;
    Piece drawn, shown;
    splat4d_buffer *rgba, *depth, *mask;
    splat4d_guard *guard;
    splat4d_frame *frame;
} Slot;

static uint64_t aligned(uint64_t bytes, uint64_t alignment)
{
    return (bytes + alignment - 1) / alignment * alignment;
}

static void finish(Host *host, splat4d_renderer *renderer, Slot *slot, VkSemaphore semaphore,
                   uint64_t value)
{
    NEW(splat4d_drawn, drawn);
    host_wait(host, semaphore, value);
    splat4d_guard_destroy(slot->guard);
    OK(splat4d_renderer_retire(renderer, slot->frame, &drawn));
    CHECK(drawn.is_whole && drawn.visible > 0);
}

/* Frames of the host's: its own work, splats, its own work again; two under way. */
static void frames(Host *host, const Job *job)
{
    float *expected = read_floats(job->folder, "picture.f32", 5 * job->area);
    Slot slots[SLOTS];
    int drops = 0, returned = 0, i;
    const splat4d_host_device lent = host_lend(host, &drops);
    splat4d_device *device = NULL;
    splat4d_renderer *renderer;
    const VkSemaphore semaphore = host_timeline(host);
    uint64_t rgba, depth, steady = 0, value;
    NEW(splat4d_device_info, info);
    OK(splat4d_device_adopt(&lent, &device));
    OK(splat4d_device_get_info(device, &info));
    renderer = open_renderer(device, job);
    rgba = aligned(16 * job->area, info.storage_alignment);
    depth = aligned(4 * job->area, info.storage_alignment);
    for (i = 0; i < SLOTS; i++) {
        Slot *slot = &slots[i];
        slot->commands = host_commands(host);
        slot->drawn = host_piece(host, rgba + depth + 16 * job->area);
        slot->shown = host_piece(host, slot->drawn.bytes);
        slot->rgba = adopt_part(device, &slot->drawn, 0, 16 * job->area, &returned);
        slot->depth = adopt_part(device, &slot->drawn, rgba, 4 * job->area, &returned);
        slot->mask = adopt_part(device, &slot->drawn, rgba + depth, 16 * job->area, &returned);
    }
    for (value = 1; value <= FRAMES; value++) {
        Slot *slot = &slots[value % SLOTS];
        splat4d_camera camera = camera_of(job->width, job->height);
        splat4d_recorder *recorder = NULL;
        NEW(splat4d_target, target);
        if (value > SLOTS)
            finish(host, renderer, slot, semaphore, value - SLOTS);
        OK(splat4d_device_get_info(device, &info));
        if (value == STEADY)
            steady = info.allocations;
        CHECK(value < STEADY || info.allocations == steady);
        /* A moving camera; the last frames are from where the expected picture is. */
        camera.translation[0] = value + SLOTS > FRAMES ? 0 : 0.01 * (double)value;
        host_begin(slot->commands);
        vkCmdFillBuffer(slot->commands, slot->drawn.buffer, 0, VK_WHOLE_SIZE, 0x7fc00000);
        OK(splat4d_recorder_over(device, slot->commands, &recorder));
        target.rgba = slot->rgba;
        target.depth = slot->depth;
        target.mask = slot->mask;
        OK(splat4d_renderer_record(renderer, recorder, &camera, 0, &target, &slot->frame));
        OK(splat4d_recorder_finish(recorder, &slot->guard));
        host_copy(slot->commands, &slot->drawn, &slot->shown);
        host_submit(host, slot->commands, semaphore, value);
    }
    for (value = FRAMES - SLOTS + 1; value <= FRAMES; value++) {
        Slot *slot = &slots[value % SLOTS];
        const char *shown = (const char *)slot->shown.mapped;
        const float *mask = (const float *)(shown + rgba + depth);
        size_t pixel;
        finish(host, renderer, slot, semaphore, value);
        same_floats("colour", (const float *)shown, expected, 4 * job->area);
        same_floats("depth", (const float *)(shown + rgba), expected + 4 * job->area, job->area);
        /* Nothing moves. */
        for (pixel = 0; pixel < job->area; pixel++)
            CHECK(mask[4 * pixel] == 0 && mask[4 * pixel + 3] == expected[4 * pixel + 3]);
        splat4d_buffer_destroy(slot->rgba);
        splat4d_buffer_destroy(slot->depth);
        splat4d_buffer_destroy(slot->mask);
    }
    splat4d_renderer_destroy(renderer);
    CHECK(returned == 3 * SLOTS && drops == 0);
    splat4d_device_destroy(device);
    CHECK(drops == 1 && host->locks > 0);
    vkDestroySemaphore(host->device, semaphore, NULL);
    free(expected);
}

int main(int argc, char **argv)
{
    const Job job = job_of(argc, argv);
    Host host;
    host_open(&host);
    wrong_devices(&host);
    wrong_buffers(&host);
    frames(&host, &job);
    host_close(&host);
    puts("host: ok");
    return 0;
}
