#version 460
// First pass of SSIM: applies the window along columns to x, y, x² + y² and x·y of every channel,
// where x is the rendered image over its background and y the reference image.
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer Rgba { vec4 rgba[]; };
layout(std430, binding = 1) readonly buffer Reference { uint reference[]; };
// Each channel has its own buffer. One buffer for all channels would exceed the binding size limit
// of some devices, even for images that these devices can process otherwise.
layout(std430, binding = 2) writeonly buffer WindowedReds { vec4 windowed_reds[]; };
layout(std430, binding = 3) writeonly buffer WindowedGreens { vec4 windowed_greens[]; };
layout(std430, binding = 4) writeonly buffer WindowedBlues { vec4 windowed_blues[]; };

layout(push_constant) uniform Params {
    int width;
    int height;
    // Number of pixels in an invocation's run.
    int run;
    float background_red;
    float background_green;
    float background_blue;
};

#include "common/grid.glsl"
#include "common/ssim.glsl"

void main() {
    int item = int(group_index() * 64u + gl_LocalInvocationIndex);
    int x = item % width, first = item / width * run;
    if (first >= height) {
        return;
    }
    vec3 background = vec3(background_red, background_green, background_blue);
    vec4 reds[WINDOW], greens[WINDOW], blues[WINDOW];
    [[unroll]] for (int k = 0; k < WINDOW; k++) {
        reds[k] = greens[k] = blues[k] = vec4(0.0);
    }
    int end = min(first + run, height);
    for (int y = first - HALF; y < end + HALF; y++) {
        vec3 rendered = vec3(0.0), photo = vec3(0.0);
        if (y >= 0 && y < height) {
            vec4 value = rgba[y * width + x];
            uint packed_pixel = reference[y * width + x];
            rendered = value.rgb + (1.0 - value.a) * background;
            photo = vec3(unpack(packed_pixel, 0u), unpack(packed_pixel, 1u),
                         unpack(packed_pixel, 2u));
        }
        vec3 squares = rendered * rendered + photo * photo, products = rendered * photo;
        SLIDE(reds, vec4(rendered.r, photo.r, squares.r, products.r));
        SLIDE(greens, vec4(rendered.g, photo.g, squares.g, products.g));
        SLIDE(blues, vec4(rendered.b, photo.b, squares.b, products.b));
        int done = y - HALF;
        if (done >= first) {
            int at = done * width + x;
            windowed_reds[at] = reds[0];
            windowed_greens[at] = greens[0];
            windowed_blues[at] = blues[0];
        }
    }
}
