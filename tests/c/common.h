/* What the programs share: checks that say where they failed, and files of floats. */
#ifndef COMMON_H
#define COMMON_H

#include "splat4d.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define CHECK(condition)                                                                           \
    do {                                                                                           \
        if (!(condition)) {                                                                        \
            fprintf(stderr, "%s:%d: %s (last error: %s)\n", __FILE__, __LINE__, #condition,        \
                    splat4d_last_error());                                                         \
            exit(1);                                                                               \
        }                                                                                          \
    } while (0)

#define OK(call) CHECK((call) == SPLAT4D_OK)

/* A call that must fail with this code, and with a message that holds this text. */
#define FAILS(code, text, call)                                                                    \
    do {                                                                                           \
        splat4d_result result_ = (call);                                                           \
        if (result_ != (code) || !strstr(splat4d_last_error(), (text))) {                          \
            fprintf(stderr, "%s:%d: %s gave %d (%s)\n", __FILE__, __LINE__, #call, (int)result_,   \
                    splat4d_last_error());                                                         \
            exit(1);                                                                               \
        }                                                                                          \
    } while (0)

/* What a program is called with: PROGRAM FOLDER WIDTH HEIGHT COUNT. */
typedef struct {
    const char *folder;
    uint32_t width, height;
    size_t count, area;
} Job;

static inline Job job_of(int argc, char **argv)
{
    Job job;
    OK(splat4d_check_abi(SPLAT4D_ABI_VERSION));
    CHECK(argc == 5);
    job.folder = argv[1];
    job.width = (uint32_t)atoi(argv[2]);
    job.height = (uint32_t)atoi(argv[3]);
    job.count = (size_t)atoi(argv[4]);
    job.area = (size_t)job.width * job.height;
    return job;
}

/* A structure of zeros with its size. */
#define NEW(type, name)                                                                            \
    type name;                                                                                     \
    memset(&name, 0, sizeof name);                                                                 \
    name.struct_size = sizeof name

/* All floats of a file; the caller frees them. */
static inline float *read_floats(const char *folder, const char *name, size_t count)
{
    char path[1024];
    float *floats = (float *)malloc(count * sizeof *floats);
    size_t found;
    FILE *file;
    snprintf(path, sizeof path, "%s/%s", folder, name);
    file = fopen(path, "rb");
    CHECK(file && floats);
    found = fread(floats, sizeof *floats, count + 1, file) == count + 1 ? count + 1 : count;
    fclose(file);
    CHECK(found == count);
    return floats;
}

/* Fails where floats differ in a bit. */
static inline void same_floats(const char *what, const float *a, const float *b, size_t count)
{
    size_t i;
    for (i = 0; i < count; i++) {
        if (memcmp(&a[i], &b[i], sizeof *a) != 0) {
            fprintf(stderr, "%s: float %zu is %g, expected %g\n", what, i, a[i], b[i]);
            exit(1);
        }
    }
}

/* The camera of tests/host: at the origin, looking along z. */
static inline splat4d_camera camera_of(uint32_t width, uint32_t height)
{
    NEW(splat4d_camera, camera);
    camera.fx = width;
    camera.cx = width / 2.0;
    camera.cy = height / 2.0;
    camera.width = width;
    camera.height = height;
    return camera;
}

/* Room for Gaussians of degree 0, in one piece of memory. */
typedef struct {
    float *all, *positions, *log_scales, *rotations, *opacity_logits, *sh;
    size_t count, floats;
} Arrays;

static inline Arrays arrays_of(size_t count)
{
    Arrays a;
    a.count = count;
    a.floats = (3 + 3 + 4 + 1 + 3) * count;
    a.all = (float *)calloc(a.floats, sizeof(float));
    CHECK(a.all);
    a.positions = a.all;
    a.log_scales = a.positions + 3 * count;
    a.rotations = a.log_scales + 3 * count;
    a.opacity_logits = a.rotations + 4 * count;
    a.sh = a.opacity_logits + count;
    return a;
}

static inline splat4d_gaussians gaussians_in(const Arrays *a)
{
    NEW(splat4d_gaussians, g);
    g.count = a->count;
    g.positions = a->positions;
    g.log_scales = a->log_scales;
    g.rotations = a->rotations;
    g.opacity_logits = a->opacity_logits;
    g.sh = a->sh;
    return g;
}

static inline splat4d_gaussians_out gaussians_out(const Arrays *a)
{
    NEW(splat4d_gaussians_out, g);
    g.capacity = a->count;
    g.positions = a->positions;
    g.log_scales = a->log_scales;
    g.rotations = a->rotations;
    g.opacity_logits = a->opacity_logits;
    g.sh = a->sh;
    return g;
}

/* The settings under which the Rust side trains too. */
static inline splat4d_train_settings settings_of(void)
{
    NEW(splat4d_train_settings, s);
    s.steps = 100;
    s.growth = SPLAT4D_GROWTH_NONE;
    s.sh_bands = 1;
    s.sh_interval = -1;
    return s;
}

static inline splat4d_device *open_device(void)
{
    splat4d_device *device = NULL;
    const char *validation = getenv("SPLAT4D_VALIDATION");
    NEW(splat4d_request, request);
    request.selector = getenv("SPLAT4D_DEVICE") ? getenv("SPLAT4D_DEVICE") : "software";
    request.validation = validation && strcmp(validation, "1") == 0;
    OK(splat4d_device_open(&request, &device));
    return device;
}

/* The folder's scene, on a device. */
static inline splat4d_renderer *open_renderer(const splat4d_device *device, const Job *job)
{
    char path[1024];
    splat4d_scene *scene = NULL;
    splat4d_renderer *renderer = NULL;
    snprintf(path, sizeof path, "%s/scene.safetensors", job->folder);
    OK(splat4d_scene_open(path, 0, &scene));
    OK(splat4d_renderer_create(device, scene, &renderer));
    splat4d_scene_destroy(scene);
    return renderer;
}

/* Fails where the validation layer has said anything. */
static inline void check_messages(const splat4d_device *device)
{
    static char text[4096];
    size_t length = 1;
    OK(splat4d_device_take_validation_messages(device, text, sizeof text, &length));
    if (length) {
        fprintf(stderr, "the validation layer complains:\n%s\n", text);
        exit(1);
    }
}

#endif
