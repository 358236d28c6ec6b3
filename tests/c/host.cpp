// A host in C++ with plain Vulkan: its own device, allocator, command buffers and timeline semaphore.
// It draws splats inside its own frame, sorts and differentiates there, and has the engine submit
// between two points of its own semaphore.
//
//   host FOLDER WIDTH HEIGHT COUNT
//
// The folder holds what the Rust side has rendered and differentiated: the same bits must come out.

#include "vulkan_host.h"

#include <array>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <memory>
#include <vector>

namespace {

// Handles that destroy themselves, and objects that destroy others: in whatever order.
template <auto destroy> struct Destroy {
    template <typename T> void operator()(T *handle) const { destroy(handle); }
};
using Device = std::unique_ptr<splat4d_device, Destroy<splat4d_device_destroy>>;
using Buffer = std::unique_ptr<splat4d_buffer, Destroy<splat4d_buffer_destroy>>;
using Stream = std::unique_ptr<splat4d_stream, Destroy<splat4d_stream_destroy>>;
using Renderer = std::unique_ptr<splat4d_renderer, Destroy<splat4d_renderer_destroy>>;
using Guard = std::unique_ptr<splat4d_guard, Destroy<splat4d_guard_destroy>>;
using Frame = std::unique_ptr<splat4d_frame, Destroy<splat4d_frame_destroy>>;
using Sort = std::unique_ptr<splat4d_sort, Destroy<splat4d_sort_destroy>>;
using Trainer = std::unique_ptr<splat4d_trainer, Destroy<splat4d_trainer_destroy>>;

// What a function gives, in the hands of its owner.
template <typename Owner, typename Function, typename... Args>
Owner make(Function function, Args... args)
{
    typename Owner::pointer handle = nullptr;
    OK(function(args..., &handle));
    return Owner(handle);
}

Buffer adopt(const Device &device, const Piece &piece, int *drops)
{
    return Buffer(adopt_part(device.get(), &piece, 0, piece.bytes, drops));
}

std::vector<float> floats_of(const Job &job, const char *name, std::size_t count)
{
    float *floats = read_floats(job.folder, name, count);
    std::vector<float> all(floats, floats + count);
    std::free(floats);
    return all;
}

// The engine's submission, between two points of the host's semaphore.
void between_semaphores(Host &host, const Device &device, const Job &job)
{
    const auto expected = floats_of(job, "picture.f32", 5 * job.area);
    const Renderer renderer(open_renderer(device.get(), &job));
    const Piece picture = host_piece(&host, 16 * job.area);
    const VkSemaphore semaphore = host_timeline(&host);
    int drops = 0;
    {
        const Buffer rgba = adopt(device, picture, &drops);
        const Stream stream = make<Stream>(splat4d_stream_create, device.get());
        const splat4d_camera camera = camera_of(job.width, job.height);
        NEW(splat4d_target, target);
        target.rgba = rgba.get();
        splat4d_recorder *recorder = nullptr;
        OK(splat4d_stream_record(stream.get(), &recorder));
        Frame frame = make<Frame>(splat4d_renderer_record, renderer.get(), recorder, &camera, 0.0,
                                  &target);
        const splat4d_semaphore_point wait{semaphore, 1}, signal{semaphore, 2};
        std::uint64_t ticket = 0;
        OK(splat4d_stream_submit(stream.get(), recorder, &wait, 1, &signal, 1, &ticket));
        // It waits for the host, who is late.
        INFO(VkSemaphoreSignalInfo, info, SEMAPHORE_SIGNAL_INFO);
        info.semaphore = semaphore;
        info.value = 1;
        VK(vkSignalSemaphore(host.device, &info));
        host_wait(&host, semaphore, 2);
        same_floats("between semaphores", static_cast<float *>(picture.mapped), expected.data(),
                    4 * job.area);
        VkSemaphore own{};
        OK(splat4d_stream_get_semaphore(stream.get(), &own));
        host_wait(&host, own, ticket);
        // The stream looks at its semaphore: it does not wait.
        OK(splat4d_stream_wait(stream.get(), ticket));
        OK(splat4d_renderer_retire(renderer.get(), frame.release(), nullptr));
    }
    CHECK(drops == 1);
    vkDestroySemaphore(host.device, semaphore, nullptr);
}

// Frames of the host's: its own work, splats, its own work again; two under way.
void frames(Host &host, const Device &device, const Job &job)
{
    constexpr std::uint64_t FRAMES = 12, STEADY = 6;
    constexpr std::size_t SLOTS = 2;
    const auto expected = floats_of(job, "picture.f32", 5 * job.area);
    const Renderer renderer(open_renderer(device.get(), &job));
    const VkSemaphore semaphore = host_timeline(&host);
    int drops = 0;
    struct Slot {
        VkCommandBuffer commands;
        Piece drawn, shown;
        Buffer rgba;
        Guard guard;
        Frame frame;
    };
    {
        std::array<Slot, SLOTS> slots;
        for (Slot &slot : slots) {
            slot.commands = host_commands(&host);
            slot.drawn = host_piece(&host, 16 * job.area);
            slot.shown = host_piece(&host, 16 * job.area);
            slot.rgba = adopt(device, slot.drawn, &drops);
        }
        const auto finish = [&](Slot &slot, std::uint64_t value) {
            host_wait(&host, semaphore, value);
            slot.guard.reset();
            NEW(splat4d_drawn, drawn);
            OK(splat4d_renderer_retire(renderer.get(), slot.frame.release(), &drawn));
            CHECK(drawn.is_whole);
        };
        std::uint64_t steady = 0;
        for (std::uint64_t i = 1; i <= FRAMES; i++) {
            Slot &slot = slots[i % SLOTS];
            if (i > SLOTS)
                finish(slot, i - SLOTS);
            NEW(splat4d_device_info, info);
            OK(splat4d_device_get_info(device.get(), &info));
            if (i == STEADY)
                steady = info.allocations;
            CHECK(i < STEADY || info.allocations == steady);
            splat4d_camera camera = camera_of(job.width, job.height);
            // A moving camera; the last frames are from where the expected picture is.
            camera.translation[0] = i + SLOTS > FRAMES ? 0 : 0.01 * static_cast<double>(i);
            host_begin(slot.commands);
            vkCmdFillBuffer(slot.commands, slot.drawn.buffer, 0, VK_WHOLE_SIZE, 0x7fc00000);
            splat4d_recorder *recorder = nullptr;
            OK(splat4d_recorder_over(device.get(), slot.commands, &recorder));
            NEW(splat4d_target, target);
            target.rgba = slot.rgba.get();
            slot.frame = make<Frame>(splat4d_renderer_record, renderer.get(), recorder, &camera,
                                     0.0, &target);
            slot.guard = make<Guard>(splat4d_recorder_finish, recorder);
            host_copy(slot.commands, &slot.drawn, &slot.shown);
            host_submit(&host, slot.commands, semaphore, i);
        }
        for (std::uint64_t i = FRAMES - SLOTS + 1; i <= FRAMES; i++) {
            Slot &slot = slots[i % SLOTS];
            finish(slot, i);
            same_floats("in the host's frame", static_cast<float *>(slot.shown.mapped),
                        expected.data(), 4 * job.area);
        }
    }
    CHECK(drops == static_cast<int>(SLOTS));
    vkDestroySemaphore(host.device, semaphore, nullptr);
}

// A sort of the host's buffers and a step with the host's loss, in one command buffer of the host's.
void sort_and_train(Host &host, const Device &device, const Job &job)
{
    constexpr std::uint32_t N = 300;
    enum { COUNT, KEYS, PAYLOAD, SORTED_KEYS, SORTED_PAYLOAD, BUFFERS };
    int drops = 0;
    std::array<Piece, BUFFERS> pieces;
    std::array<Buffer, BUFFERS> all;
    for (int i = 0; i < BUFFERS; i++) {
        pieces[i] = host_piece(&host, i == COUNT ? 4 : 4 * N);
        all[i] = adopt(device, pieces[i], &drops);
    }
    const auto words = [&](int i) { return static_cast<std::uint32_t *>(pieces[i].mapped); };
    words(COUNT)[0] = N;
    for (std::uint32_t i = 0; i < N; i++) {
        words(KEYS)[i] = (i * 2654435761u) >> 26;
        words(PAYLOAD)[i] = i;
    }
    const Piece gradient = host_piece(&host, 16 * job.area);
    Buffer by_rgba = adopt(device, gradient, &drops);
    Arrays start = arrays_of(job.count), by = arrays_of(job.count);
    const auto given = floats_of(job, "start.f32", start.floats);
    const auto expected = floats_of(job, "gradients.f32", start.floats + 6);
    std::memcpy(start.all, given.data(), start.floats * sizeof(float));
    const splat4d_gaussians gaussians = gaussians_in(&start);
    const splat4d_train_settings settings = settings_of();
    const Trainer trainer = make<Trainer>(splat4d_trainer_create, device.get(), &gaussians, nullptr,
                                          0, 1.0, &settings);
    const Sort sort = make<Sort>(splat4d_sort_create, device.get(), N, 0, 6);

    const VkSemaphore semaphore = host_timeline(&host);
    const VkCommandBuffer commands = host_commands(&host);
    host_begin(commands);
    splat4d_recorder *recorder = nullptr;
    OK(splat4d_recorder_over(device.get(), commands, &recorder));
    NEW(splat4d_sort_buffers, s);
    s.count = all[COUNT].get();
    s.keys = all[KEYS].get();
    s.payload = all[PAYLOAD].get();
    s.sorted_keys = all[SORTED_KEYS].get();
    s.sorted_payload = all[SORTED_PAYLOAD].get();
    OK(splat4d_sort_record(sort.get(), recorder, &s));
    const splat4d_camera camera = camera_of(job.width, job.height);
    OK(splat4d_trainer_forward(trainer.get(), recorder, &camera));
    Guard first = make<Guard>(splat4d_recorder_finish, recorder);
    // Here the host computes its loss: the sum of everything, whose gradient is 1.
    vkCmdFillBuffer(commands, gradient.buffer, 0, VK_WHOLE_SIZE, 0x3f800000);
    OK(splat4d_recorder_over(device.get(), commands, &recorder));
    OK(splat4d_trainer_backward(trainer.get(), recorder, by_rgba.get(), nullptr));
    Guard second = make<Guard>(splat4d_recorder_finish, recorder);
    host_submit(&host, commands, semaphore, 1);
    host_wait(&host, semaphore, 1);
    first.reset();
    second.reset();
    for (std::uint32_t i = 1; i < N; i++) {
        const std::uint32_t *keys = words(SORTED_KEYS), *from = words(SORTED_PAYLOAD);
        CHECK(keys[i - 1] <= keys[i] && words(KEYS)[from[i]] == keys[i]);
        CHECK(keys[i - 1] < keys[i] || from[i - 1] < from[i]);
    }
    float pose[6];
    splat4d_gaussians_out out = gaussians_out(&by);
    OK(splat4d_trainer_read_gradients(trainer.get(), &out, pose));
    same_floats("gradients", by.all, expected.data(), by.floats);
    same_floats("pose", pose, expected.data() + by.floats, 6);
    OK(splat4d_trainer_conclude(trainer.get(), nullptr));

    for (Buffer &buffer : all)
        buffer.reset();
    by_rgba.reset();
    CHECK(drops == BUFFERS + 1);
    vkDestroySemaphore(host.device, semaphore, nullptr);
    std::free(start.all);
    std::free(by.all);
}

} // namespace

int main(int argc, char **argv)
{
    const Job job = job_of(argc, argv);
    Host host;
    host_open(&host);
    int drops = 0;
    {
        const splat4d_host_device lent = host_lend(&host, &drops);
        const Device device = make<Device>(splat4d_device_adopt, &lent);
        between_semaphores(host, device, job);
        frames(host, device, job);
        sort_and_train(host, device, job);
        CHECK(drops == 0 && host.locks > 0);
    }
    CHECK(drops == 1);
    host_close(&host);
    std::puts("host: ok");
    return 0;
}
