/* A host that gets things wrong: each a clear error, and nothing breaks. */
#include "common.h"

static int dropped;

static void on_drop(void *user)
{
    ++*(int *)user;
}

static void structures(splat4d_device *device)
{
    splat4d_device *none = (splat4d_device *)&dropped;
    splat4d_scene *scene = NULL;
    float values[16] = {0};
    /* A newer host's request, with a field that this library does not know. */
    struct {
        splat4d_request known;
        uint64_t unknown;
    } newer;
    NEW(splat4d_request, request);
    NEW(splat4d_gaussians, g);
    NEW(splat4d_device_info, info);

    FAILS(SPLAT4D_ERROR_POINTER, "device", splat4d_device_open(NULL, NULL));
    request.selector = "no such device";
    FAILS(SPLAT4D_ERROR_NO_DEVICE, "no such device", splat4d_device_open(&request, &none));
    CHECK(none == NULL);
    request.selector = "\xff";
    FAILS(SPLAT4D_ERROR_INPUT, "UTF-8", splat4d_device_open(&request, &none));
    request.struct_size = 0;
    FAILS(SPLAT4D_ERROR_STRUCT_SIZE, "struct_size", splat4d_device_open(&request, &none));
    request.struct_size = 8;
    FAILS(SPLAT4D_ERROR_STRUCT_SIZE, "struct_size", splat4d_device_open(&request, &none));
    request.struct_size = (size_t)-1;
    FAILS(SPLAT4D_ERROR_STRUCT_SIZE, "struct_size", splat4d_device_open(&request, &none));
    memset(&newer, 0, sizeof newer);
    newer.known.struct_size = sizeof newer;
    newer.known.selector = "no such device";
    FAILS(SPLAT4D_ERROR_NO_DEVICE, "no such", splat4d_device_open(&newer.known, &none));
    newer.unknown = 1;
    FAILS(SPLAT4D_ERROR_STRUCT_SIZE, "not know", splat4d_device_open(&newer.known, &none));
    FAILS(SPLAT4D_ERROR_VERSION, "header", splat4d_check_abi(SPLAT4D_ABI_VERSION + 1));
    FAILS(SPLAT4D_ERROR_POINTER, "device is null", splat4d_device_get_info(NULL, &info));
    FAILS(SPLAT4D_ERROR_POINTER, "info is null", splat4d_device_get_info(device, NULL));
    info.struct_size = 3;
    FAILS(SPLAT4D_ERROR_STRUCT_SIZE, "info", splat4d_device_get_info(device, &info));

    FAILS(SPLAT4D_ERROR_POINTER, "gaussians", splat4d_scene_create(NULL, &scene));
    g.count = 2;
    FAILS(SPLAT4D_ERROR_POINTER, "positions is null", splat4d_scene_create(&g, &scene));
    g.positions = g.log_scales = g.rotations = g.opacity_logits = values;
    g.positions = (const float *)((const char *)values + 1);
    FAILS(SPLAT4D_ERROR_POINTER, "aligned", splat4d_scene_create(&g, &scene));
    g.positions = g.sh = values;
    g.count = (size_t)-1;
    FAILS(SPLAT4D_ERROR_SHAPE, "more than memory", splat4d_scene_create(&g, &scene));
    g.sh_degree = 4;
    FAILS(SPLAT4D_ERROR_INPUT, "sh_degree", splat4d_scene_create(&g, &scene));
    CHECK(scene == NULL);
    FAILS(SPLAT4D_ERROR_IO, "no/such/file", splat4d_scene_open("no/such/file", 0, &scene));
    FAILS(SPLAT4D_ERROR_POINTER, "path", splat4d_scene_open(NULL, 0, &scene));

    /* Destroying nothing does nothing. */
    splat4d_device_destroy(NULL);
    splat4d_scene_destroy(NULL);
    splat4d_renderer_destroy(NULL);
    splat4d_frame_destroy(NULL);
    splat4d_trainer_destroy(NULL);
    splat4d_stream_destroy(NULL);
    splat4d_recorder_destroy(NULL);
    splat4d_guard_destroy(NULL);
    splat4d_buffer_destroy(NULL);
    splat4d_sort_destroy(NULL);
    splat4d_scan_destroy(NULL);
}

static void adoption(void)
{
    splat4d_device *device = NULL;
    size_t length = 0;
    NEW(splat4d_host_device, host);
    NEW(splat4d_requirements, needed);
    OK(splat4d_requirements_query(&needed));
    CHECK(needed.features == 31 && needed.queue_flags != 0 && needed.api_version >> 22 == 1);
    FAILS(SPLAT4D_ERROR_INPUT, "get_instance_proc_addr",
          splat4d_requirements_lacking(NULL, NULL, NULL, NULL, 0, &length));
    host.on_drop = on_drop;
    host.on_drop_user = &dropped;
    FAILS(SPLAT4D_ERROR_POINTER, "device", splat4d_device_adopt(&host, NULL));
    CHECK(dropped == 0);
    FAILS(SPLAT4D_ERROR_INPUT, "get_instance_proc_addr", splat4d_device_adopt(&host, &device));
    CHECK(dropped == 1);
    host.queue_lock = on_drop;
    FAILS(SPLAT4D_ERROR_INPUT, "queue_unlock", splat4d_device_adopt(&host, &device));
    CHECK(dropped == 2);
}

static splat4d_scene *some_scene(void)
{
    static const float positions[] = {0, 0, 3, 0.2f, 0, 3};
    static const float log_scales[] = {-2, -2, -2, -2, -2, -2};
    static const float rotations[] = {1, 0, 0, 0, 1, 0, 0, 0};
    static const float opacity_logits[] = {1, 1}, sh[] = {1, 0, 0, 0, 1, 0};
    splat4d_scene *scene = NULL;
    NEW(splat4d_gaussians, g);
    g.count = 2;
    g.positions = positions;
    g.log_scales = log_scales;
    g.rotations = rotations;
    g.opacity_logits = opacity_logits;
    g.sh = sh;
    OK(splat4d_scene_create(&g, &scene));
    return scene;
}

static void renderers(splat4d_device *device)
{
    splat4d_scene *scene = some_scene();
    splat4d_renderer *renderer = NULL, *other = NULL;
    splat4d_stream *stream = NULL;
    splat4d_recorder *recorder = NULL;
    splat4d_guard *guard = (splat4d_guard *)&dropped;
    splat4d_frame *frame = NULL;
    splat4d_buffer *small = NULL, *large = NULL;
    splat4d_camera camera = camera_of(16, 16), wrong;
    uint64_t ticket = 0, word = 0;
    float floats[6];
    NEW(splat4d_picture, picture);
    NEW(splat4d_target, target);
    NEW(splat4d_pixels, pixels);
    NEW(splat4d_gaussians_out, out);

    out.capacity = 1;
    FAILS(SPLAT4D_ERROR_SHAPE, "capacity is 1", splat4d_scene_read(scene, &out));
    out.capacity = 2;
    out.sh = floats;
    out.sh_degree = 1;
    FAILS(SPLAT4D_ERROR_SHAPE, "sh_degree is 1", splat4d_scene_read(scene, &out));
    FAILS(SPLAT4D_ERROR_INPUT, "camera 0", splat4d_scene_get_camera(scene, 0, &camera, NULL));
    FAILS(SPLAT4D_ERROR_POINTER, "scene", splat4d_renderer_create(device, NULL, &renderer));
    FAILS(SPLAT4D_ERROR_POINTER, "device", splat4d_renderer_create(NULL, scene, &renderer));
    OK(splat4d_renderer_create(device, scene, &renderer));
    OK(splat4d_renderer_create(device, scene, &other));
    splat4d_scene_destroy(scene);

    picture.rgba = floats;
    picture.rgba_len = 6;
    FAILS(SPLAT4D_ERROR_SHAPE, "rgba", splat4d_renderer_render(renderer, &camera, 0, &picture));
    FAILS(SPLAT4D_ERROR_POINTER, "picture", splat4d_renderer_render(renderer, &camera, 0, NULL));
    picture.rgba = NULL;
    wrong = camera;
    wrong.width = 0;
    FAILS(SPLAT4D_ERROR_INPUT, "pixels", splat4d_renderer_render(renderer, &wrong, 0, &picture));
    wrong.width = 16;
    wrong.fx = -1;
    FAILS(SPLAT4D_ERROR_INPUT, "fx -1", splat4d_renderer_render(renderer, &wrong, 0, &picture));
    wrong = camera;
    wrong.rotation[2] = 1e-9;
    FAILS(SPLAT4D_ERROR_INPUT, "pose", splat4d_renderer_render(renderer, &wrong, 0, &picture));
    wrong = camera;
    wrong.width = 0xffffffff;
    FAILS(SPLAT4D_ERROR_INPUT, "4294967295", splat4d_renderer_render(renderer, &wrong, 0, &picture));
    FAILS(SPLAT4D_ERROR_INPUT, "no frame", splat4d_renderer_get_pixels(renderer, &pixels));

    /* Buffers. */
    FAILS(SPLAT4D_ERROR_INPUT, "multiple of 4", splat4d_buffer_create(device, 7, &small));
    FAILS(SPLAT4D_ERROR_INPUT, "above 0", splat4d_buffer_create(device, 0, &small));
    OK(splat4d_buffer_create(device, 16, &small));
    OK(splat4d_buffer_create(device, 16 * 256, &large));
    OK(splat4d_stream_create(device, &stream));
    FAILS(SPLAT4D_ERROR_SHAPE, "20 bytes", splat4d_stream_upload(stream, small, floats, 20));
    FAILS(SPLAT4D_ERROR_SHAPE, "3 bytes", splat4d_stream_download(stream, small, floats, 3));
    FAILS(SPLAT4D_ERROR_POINTER, "data", splat4d_stream_upload(stream, small, NULL, 16));
    FAILS(SPLAT4D_ERROR_INPUT, "ticket 99", splat4d_stream_wait(stream, 99));

    /* Recordings. */
    FAILS(SPLAT4D_ERROR_INPUT, "null handle", splat4d_recorder_over(device, NULL, &recorder));
    OK(splat4d_stream_record(stream, &recorder));
    target.rgba = small;
    FAILS(SPLAT4D_ERROR_SHAPE, "rgba",
          splat4d_renderer_record(renderer, recorder, &camera, 0, &target, &frame));
    splat4d_recorder_destroy(recorder);
    OK(splat4d_stream_record(stream, &recorder));
    target.rgba = target.mask = large;
    FAILS(SPLAT4D_ERROR_INPUT, "share memory",
          splat4d_renderer_record(renderer, recorder, &camera, 0, &target, &frame));
    CHECK(frame == NULL);
    target.mask = NULL;
    OK(splat4d_renderer_record(renderer, recorder, &camera, 0, &target, &frame));
    /* Everything it uses goes before it is submitted. */
    splat4d_buffer_destroy(large);
    OK(splat4d_stream_submit(stream, recorder, NULL, 0, NULL, 0, &ticket));
    OK(splat4d_stream_wait(stream, ticket));
    FAILS(SPLAT4D_ERROR_INPUT, "another renderer", splat4d_renderer_retire(other, frame, NULL));
    FAILS(SPLAT4D_ERROR_POINTER, "frame", splat4d_renderer_retire(renderer, NULL, NULL));
    /* A stream's recording is submitted, not finished. */
    OK(splat4d_stream_record(stream, &recorder));
    FAILS(SPLAT4D_ERROR_INPUT, "submit", splat4d_recorder_finish(recorder, &guard));
    CHECK(guard == NULL);
    FAILS(SPLAT4D_ERROR_POINTER, "recorder",
          splat4d_stream_submit(stream, NULL, NULL, 0, NULL, 0, NULL));
    OK(splat4d_stream_record(stream, &recorder));
    FAILS(SPLAT4D_ERROR_POINTER, "waits",
          splat4d_stream_submit(stream, recorder, NULL, 1, NULL, 0, &word));
    splat4d_renderer_destroy(renderer);
    splat4d_renderer_destroy(other);
    splat4d_buffer_destroy(small);
    splat4d_stream_destroy(stream);
}

static void ops(splat4d_device *device)
{
    splat4d_sort *sort = NULL;
    splat4d_scan *scan = NULL;
    splat4d_stream *stream = NULL;
    splat4d_recorder *recorder = NULL;
    splat4d_buffer *one = NULL, *a = NULL, *b = NULL, *c = NULL;
    NEW(splat4d_sort_buffers, s);
    NEW(splat4d_scan_buffers, n);
    FAILS(SPLAT4D_ERROR_INPUT, "bits", splat4d_sort_create(device, 9, 4, 33, &sort));
    OK(splat4d_sort_create(device, 9, 0, 32, &sort));
    OK(splat4d_scan_create(device, 9, &scan));
    OK(splat4d_stream_create(device, &stream));
    OK(splat4d_stream_record(stream, &recorder));
    OK(splat4d_buffer_create(device, 4, &one));
    OK(splat4d_buffer_create(device, 36, &a));
    OK(splat4d_buffer_create(device, 36, &b));
    OK(splat4d_buffer_create(device, 32, &c));
    s.count = one;
    s.keys = s.payload = a;
    FAILS(SPLAT4D_ERROR_POINTER, "sorted_keys", splat4d_sort_record(sort, recorder, &s));
    s.sorted_keys = s.sorted_payload = b;
    FAILS(SPLAT4D_ERROR_INPUT, "share memory", splat4d_sort_record(sort, recorder, &s));
    s.sorted_payload = a;
    FAILS(SPLAT4D_ERROR_INPUT, "share memory", splat4d_sort_record(sort, recorder, &s));
    s.sorted_payload = c;
    FAILS(SPLAT4D_ERROR_SHAPE, "sorted_payload", splat4d_sort_record(sort, recorder, &s));
    n.count = one;
    n.count_at = 1;
    n.values = a;
    n.prefix = b;
    n.total = c;
    FAILS(SPLAT4D_ERROR_SHAPE, "count", splat4d_scan_record(scan, recorder, &n));
    n.count_at = (uint64_t)-1;
    FAILS(SPLAT4D_ERROR_SHAPE, "count_at", splat4d_scan_record(scan, recorder, &n));
    splat4d_recorder_destroy(recorder);
    splat4d_buffer_destroy(one);
    splat4d_buffer_destroy(a);
    splat4d_buffer_destroy(b);
    splat4d_buffer_destroy(c);
    splat4d_sort_destroy(sort);
    splat4d_scan_destroy(scan);
    splat4d_stream_destroy(stream);
}

static void trainers(splat4d_device *device)
{
    splat4d_trainer *trainer = NULL;
    splat4d_stream *stream = NULL;
    splat4d_recorder *recorder = NULL;
    splat4d_camera camera = camera_of(16, 16);
    splat4d_train_settings settings = settings_of();
    Arrays arrays = arrays_of(2);
    splat4d_gaussians g = gaussians_in(&arrays);
    float pose[6];
    splat4d_view views[2];
    NEW(splat4d_view, view);
    NEW(splat4d_pixels, pixels);
    g.count = 0;
    FAILS(SPLAT4D_ERROR_INPUT, "at least one",
          splat4d_trainer_create(device, &g, NULL, 0, 1, &settings, &trainer));
    g.count = 2;
    FAILS(SPLAT4D_ERROR_INPUT, "no direction",
          splat4d_trainer_create(device, &g, NULL, 0, 1, &settings, &trainer));
    arrays.rotations[0] = arrays.rotations[4] = 1;
    FAILS(SPLAT4D_ERROR_INPUT, "extent 0",
          splat4d_trainer_create(device, &g, NULL, 0, 0, &settings, &trainer));
    FAILS(SPLAT4D_ERROR_POINTER, "views",
          splat4d_trainer_create(device, &g, NULL, 1, 1, &settings, &trainer));
    FAILS(SPLAT4D_ERROR_POINTER, "camera",
          splat4d_trainer_create(device, &g, &view, 1, 1, &settings, &trainer));
    view.camera = &camera;
    FAILS(SPLAT4D_ERROR_POINTER, "rgb",
          splat4d_trainer_create(device, &g, &view, 1, 1, &settings, &trainer));
    view.rgb = arrays.all;
    camera = camera_of(2, 1);
    views[0] = views[1] = view;
    views[1].struct_size++;
    FAILS(SPLAT4D_ERROR_STRUCT_SIZE, "views[1]",
          splat4d_trainer_create(device, &g, views, 2, 1, &settings, &trainer));
    camera = camera_of(16, 16);
    settings.sh_bands = 5;
    FAILS(SPLAT4D_ERROR_INPUT, "sh_bands",
          splat4d_trainer_create(device, &g, NULL, 0, 1, &settings, &trainer));
    settings.sh_bands = 1;
    settings.growth = 9;
    FAILS(SPLAT4D_ERROR_INPUT, "growth",
          splat4d_trainer_create(device, &g, NULL, 0, 1, &settings, &trainer));
    settings.growth = SPLAT4D_GROWTH_NONE;
    settings.opacity_rate = 1e308 * 10;
    FAILS(SPLAT4D_ERROR_INPUT, "opacity_rate",
          splat4d_trainer_create(device, &g, NULL, 0, 1, &settings, &trainer));
    settings.opacity_rate = 0;
    CHECK(trainer == NULL);
    OK(splat4d_trainer_create(device, &g, NULL, 0, 1, &settings, &trainer));
    OK(splat4d_stream_create(device, &stream));
    OK(splat4d_stream_record(stream, &recorder));
    FAILS(SPLAT4D_ERROR_INPUT, "images", splat4d_trainer_step(trainer));
    FAILS(SPLAT4D_ERROR_INPUT, "conclude", splat4d_trainer_conclude(trainer, NULL));
    FAILS(SPLAT4D_ERROR_INPUT, "update", splat4d_trainer_update(trainer, recorder));
    FAILS(SPLAT4D_ERROR_INPUT, "pixels", splat4d_trainer_get_pixels(trainer, &pixels));
    FAILS(SPLAT4D_ERROR_INPUT, "pose", splat4d_trainer_read_gradients(trainer, NULL, pose));
    FAILS(SPLAT4D_ERROR_POINTER, "by_rgba",
          splat4d_trainer_backward(trainer, recorder, NULL, NULL));
    /* Both go while a step is under way. */
    OK(splat4d_trainer_forward(trainer, recorder, &camera));
    splat4d_trainer_destroy(trainer);
    splat4d_recorder_destroy(recorder);
    splat4d_stream_destroy(stream);
    free(arrays.all);
}

/* The device's handle goes first, then everything else, the wrong way round. */
static void order(void)
{
    splat4d_device *device = open_device();
    splat4d_scene *scene = some_scene();
    splat4d_renderer *renderer = NULL;
    splat4d_stream *stream = NULL;
    splat4d_recorder *recorder = NULL;
    splat4d_frame *frame = NULL;
    splat4d_camera camera = camera_of(16, 16);
    OK(splat4d_renderer_create(device, scene, &renderer));
    OK(splat4d_stream_create(device, &stream));
    OK(splat4d_stream_record(stream, &recorder));
    splat4d_device_destroy(device);
    OK(splat4d_renderer_record(renderer, recorder, &camera, 0, NULL, &frame));
    OK(splat4d_stream_submit(stream, recorder, NULL, 0, NULL, 0, NULL));
    splat4d_renderer_destroy(renderer);
    splat4d_stream_destroy(stream);
    splat4d_frame_destroy(frame);
    splat4d_scene_destroy(scene);
}

int main(void)
{
    splat4d_device *device;
    CHECK(splat4d_last_error()[0] == 0);
    device = open_device();
    structures(device);
    adoption();
    renderers(device);
    ops(device);
    trainers(device);
    check_messages(device);
    splat4d_device_destroy(device);
    order();
    puts("bad: ok");
    return 0;
}
