/*
 * The engine on its own device: scenes, pictures, ops, training. What comes out must be, bit for bit,
 * what the Rust side has written to the folder.
 *
 *   engine FOLDER WIDTH HEIGHT COUNT
 */
#include "common.h"

static Job job;

static void pictures(splat4d_device *device)
{
    splat4d_scene *file = NULL, *scene = NULL;
    splat4d_renderer *renderer = NULL;
    splat4d_stream *stream = NULL;
    splat4d_recorder *recorder = NULL;
    splat4d_frame *frame = NULL;
    splat4d_buffer *rgba = NULL;
    splat4d_camera camera = camera_of(job.width, job.height), first;
    float *expected = read_floats(job.folder, "picture.f32", 5 * job.area);
    float *got = (float *)calloc(5 * job.area, sizeof(float));
    double time = -1;
    uint64_t ticket = 0;
    char path[1024];
    Arrays arrays = arrays_of(job.count);
    splat4d_gaussians_out out = gaussians_out(&arrays);
    splat4d_gaussians in;
    NEW(splat4d_scene_info, info);
    NEW(splat4d_picture, picture);
    NEW(splat4d_target, target);
    NEW(splat4d_drawn, drawn);
    CHECK(got);

    /* From the file, and again from arrays. */
    snprintf(path, sizeof path, "%s/scene.safetensors", job.folder);
    OK(splat4d_scene_open(path, 0, &file));
    OK(splat4d_scene_get_info(file, &info));
    CHECK(info.count == job.count && info.sh_degree == 0);
    CHECK(!info.is_dynamic && info.camera_count == 1);
    memset(&first, 0, sizeof first);
    first.struct_size = sizeof first;
    OK(splat4d_scene_get_camera(file, 0, &first, &time));
    CHECK(first.fx == camera.fx && first.cy == camera.cy && first.width == job.width);
    CHECK(time == 0.5);
    CHECK(first.rotation[0] == 1 && first.translation[2] == 0);
    OK(splat4d_scene_read(file, &out));
    in = gaussians_in(&arrays);
    OK(splat4d_scene_create(&in, &scene));
    OK(splat4d_renderer_create(device, scene, &renderer));
    splat4d_scene_destroy(scene);
    snprintf(path, sizeof path, "%s/again.safetensors", job.folder);
    OK(splat4d_scene_save(file, path));
    splat4d_scene_destroy(file);

    /* To the host's memory. */
    picture.rgba = got;
    picture.rgba_len = 4 * job.area;
    picture.depth = got + 4 * job.area;
    picture.depth_len = job.area;
    OK(splat4d_renderer_render(renderer, &first, 0, &picture));
    same_floats("rendered", got, expected, 5 * job.area);

    /* On a stream, to a buffer. */
    memset(got, 0, 4 * job.area * sizeof *got);
    OK(splat4d_stream_create(device, &stream));
    OK(splat4d_buffer_create(device, 16 * job.area, &rgba));
    OK(splat4d_stream_record(stream, &recorder));
    target.rgba = rgba;
    OK(splat4d_renderer_record(renderer, recorder, &camera, 0, &target, &frame));
    OK(splat4d_stream_submit(stream, recorder, NULL, 0, NULL, 0, &ticket));
    OK(splat4d_stream_wait(stream, ticket));
    OK(splat4d_renderer_retire(renderer, frame, &drawn));
    CHECK(drawn.is_whole && drawn.visible > 0 && drawn.intersections >= drawn.visible);
    OK(splat4d_stream_download(stream, rgba, got, 16 * job.area));
    same_floats("recorded", got, expected, 4 * job.area);

    splat4d_buffer_destroy(rgba);
    splat4d_stream_destroy(stream);
    splat4d_renderer_destroy(renderer);
    free(arrays.all);
    free(expected);
    free(got);
}

static splat4d_buffer *words(splat4d_device *device, splat4d_stream *stream, const uint32_t *data,
                             size_t length)
{
    splat4d_buffer *buffer = NULL;
    OK(splat4d_buffer_create(device, 4 * length, &buffer));
    OK(splat4d_stream_upload(stream, buffer, data, 4 * length));
    return buffer;
}

static void ops(splat4d_device *device)
{
    enum { N = 700 };
    static uint32_t keys[N], payload[N], got_keys[N], got[N], prefix[N];
    uint32_t n = N, total = 0, sum = 0;
    uint64_t ticket = 0;
    size_t i;
    splat4d_stream *stream = NULL;
    splat4d_recorder *recorder = NULL;
    splat4d_sort *sort = NULL;
    splat4d_scan *scan = NULL;
    splat4d_buffer *all[7];
    NEW(splat4d_sort_buffers, s);
    NEW(splat4d_scan_buffers, c);
    for (i = 0; i < N; i++) {
        keys[i] = (uint32_t)(i * 2654435761u) >> 20;
        payload[i] = (uint32_t)i;
    }
    OK(splat4d_stream_create(device, &stream));
    all[0] = words(device, stream, &n, 1);
    all[1] = words(device, stream, keys, N);
    all[2] = words(device, stream, payload, N);
    all[3] = words(device, stream, payload, N);
    all[4] = words(device, stream, payload, N);
    all[5] = words(device, stream, payload, N);
    all[6] = words(device, stream, &n, 1);
    OK(splat4d_sort_create(device, N, 0, 12, &sort));
    OK(splat4d_scan_create(device, N, &scan));
    OK(splat4d_stream_record(stream, &recorder));
    s.count = all[0];
    s.keys = all[1];
    s.payload = all[2];
    s.sorted_keys = all[3];
    s.sorted_payload = all[4];
    OK(splat4d_sort_record(sort, recorder, &s));
    /* The scan reads what the sort has written. */
    c.count = all[0];
    c.values = all[3];
    c.prefix = all[5];
    c.total = all[6];
    OK(splat4d_scan_record(scan, recorder, &c));
    OK(splat4d_stream_submit(stream, recorder, NULL, 0, NULL, 0, &ticket));
    OK(splat4d_stream_wait(stream, ticket));
    OK(splat4d_stream_download(stream, all[3], got_keys, sizeof got_keys));
    OK(splat4d_stream_download(stream, all[4], got, sizeof got));
    OK(splat4d_stream_download(stream, all[5], prefix, sizeof prefix));
    OK(splat4d_stream_download(stream, all[6], &total, sizeof total));
    for (i = 0; i < N; i++) {
        CHECK(got_keys[i] == keys[got[i]] && prefix[i] == sum);
        CHECK(i == 0 || got_keys[i - 1] < got_keys[i] ||
              (got_keys[i - 1] == got_keys[i] && got[i - 1] < got[i]));
        sum += got_keys[i];
    }
    CHECK(total == sum);
    for (i = 0; i < 7; i++)
        splat4d_buffer_destroy(all[i]);
    splat4d_sort_destroy(sort);
    splat4d_scan_destroy(scan);
    splat4d_stream_destroy(stream);
}

static void training(splat4d_device *device)
{
    splat4d_trainer *trainer = NULL;
    splat4d_scene *scene = NULL;
    splat4d_camera camera = camera_of(job.width, job.height);
    splat4d_train_settings settings = settings_of();
    Arrays start = arrays_of(job.count), end = arrays_of(job.count);
    float *given = read_floats(job.folder, "start.f32", start.floats);
    float *target = read_floats(job.folder, "target.f32", 3 * job.area);
    float *trained = read_floats(job.folder, "trained.f32", start.floats);
    splat4d_gaussians in;
    splat4d_gaussians_out out = gaussians_out(&end);
    size_t i;
    NEW(splat4d_view, view);
    NEW(splat4d_loss, loss);
    NEW(splat4d_progress, progress);
    NEW(splat4d_scene_info, info);

    memcpy(start.all, given, start.floats * sizeof *given);
    in = gaussians_in(&start);
    view.camera = &camera;
    view.rgb = target;
    OK(splat4d_trainer_create(device, &in, &view, 1, 0, &settings, &trainer));
    OK(splat4d_trainer_get_loss(trainer, &loss));
    CHECK(!loss.is_known);
    for (i = 0; i < 5; i++)
        OK(splat4d_trainer_step(trainer));
    OK(splat4d_trainer_get_loss(trainer, &loss));
    CHECK(loss.is_known && loss.l1 > 0 && loss.ssim < 1);
    OK(splat4d_trainer_get_progress(trainer, &progress));
    CHECK(progress.step == 5 && progress.count == job.count && progress.sh_degree == 0);
    OK(splat4d_trainer_read(trainer, &out));
    same_floats("trained", end.all, trained, end.floats);
    OK(splat4d_trainer_get_scene(trainer, &scene));
    OK(splat4d_scene_get_info(scene, &info));
    CHECK(info.count == job.count);
    splat4d_scene_destroy(scene);
    splat4d_trainer_destroy(trainer);
    free(start.all);
    free(end.all);
    free(given);
    free(target);
    free(trained);
}

/* The loss is the sum of red, green, blue and alpha: its gradient is 1. */
static void own_loss(splat4d_device *device)
{
    splat4d_trainer *trainer = NULL;
    splat4d_stream *stream = NULL;
    splat4d_recorder *recorder = NULL;
    splat4d_buffer *by_rgba = NULL;
    splat4d_camera camera = camera_of(job.width, job.height);
    splat4d_train_settings settings = settings_of();
    Arrays start = arrays_of(job.count), by = arrays_of(job.count);
    float *given = read_floats(job.folder, "start.f32", start.floats);
    float *expected = read_floats(job.folder, "gradients.f32", start.floats + 6);
    float *ones = (float *)malloc(16 * job.area);
    float pose[6];
    uint64_t ticket = 0;
    uint32_t fitted = 0;
    size_t i;
    splat4d_gaussians in;
    splat4d_gaussians_out out = gaussians_out(&by);
    NEW(splat4d_pixels, pixels);
    NEW(splat4d_gradients, where);
    CHECK(ones);
    for (i = 0; i < 4 * job.area; i++)
        ones[i] = 1;
    memcpy(start.all, given, start.floats * sizeof *given);
    in = gaussians_in(&start);
    OK(splat4d_trainer_create(device, &in, NULL, 0, 1.0, &settings, &trainer));
    OK(splat4d_stream_create(device, &stream));
    OK(splat4d_buffer_create(device, 16 * job.area, &by_rgba));
    OK(splat4d_stream_upload(stream, by_rgba, ones, 16 * job.area));
    OK(splat4d_stream_record(stream, &recorder));
    FAILS(SPLAT4D_ERROR_INPUT, "backward", splat4d_trainer_backward(trainer, recorder, by_rgba, NULL));
    OK(splat4d_trainer_forward(trainer, recorder, &camera));
    OK(splat4d_trainer_get_pixels(trainer, &pixels));
    CHECK(pixels.width == job.width && pixels.rgba.bytes >= 16 * job.area && pixels.rgba.buffer);
    OK(splat4d_trainer_backward(trainer, recorder, by_rgba, NULL));
    OK(splat4d_trainer_get_gradients(trainer, &where));
    CHECK(where.positions.buffer && where.pose.bytes == 24 && !where.sh[1].buffer);
    OK(splat4d_trainer_update(trainer, recorder));
    OK(splat4d_stream_submit(stream, recorder, NULL, 0, NULL, 0, &ticket));
    OK(splat4d_stream_wait(stream, ticket));
    OK(splat4d_trainer_read_gradients(trainer, &out, pose));
    OK(splat4d_trainer_conclude(trainer, &fitted));
    CHECK(fitted == 1);
    same_floats("gradients", by.all, expected, by.floats);
    same_floats("pose", pose, expected + by.floats, 6);
    /* It has learnt: the sum falls with every opacity that the picture depends on. */
    OK(splat4d_trainer_read(trainer, &out));
    for (i = 0; i < job.count; i++)
        CHECK(expected[10 * job.count + i] <= 0 || by.opacity_logits[i] < start.opacity_logits[i]);
    splat4d_buffer_destroy(by_rgba);
    splat4d_stream_destroy(stream);
    splat4d_trainer_destroy(trainer);
    free(start.all);
    free(by.all);
    free(given);
    free(expected);
    free(ones);
}

int main(int argc, char **argv)
{
    splat4d_device *device;
    NEW(splat4d_device_info, info);
    job = job_of(argc, argv);
    CHECK(splat4d_version() == SPLAT4D_VERSION_MAJOR * 1000000 + SPLAT4D_VERSION_MINOR * 1000 +
                                   SPLAT4D_VERSION_PATCH);
    device = open_device();
    OK(splat4d_device_get_info(device, &info));
    CHECK(info.name[0] && info.storage_alignment > 0 && info.bytes == 0);
    pictures(device);
    ops(device);
    training(device);
    own_loss(device);
    OK(splat4d_device_get_info(device, &info));
    CHECK(info.bytes == 0);
    check_messages(device);
    splat4d_device_destroy(device);
    puts("engine: ok");
    return 0;
}
