#version 460
// Last pass of the photometric loss: applies the window along columns to the derivatives of the
// SSIM map, and computes the gradient of weighted L1 + D-SSIM with respect to colour and alpha, and
// each workgroup's sum of the weighted L1.
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_EXT_scalar_block_layout : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer Rgba { vec4 rgba[]; };
layout(std430, binding = 1) readonly buffer Reference { uint reference[]; };
// Derivatives with respect to x, x² and x·y of each channel, windowed along rows.
layout(scalar, binding = 2) readonly buffer ByReds { vec3 by_reds[]; };
layout(scalar, binding = 3) readonly buffer ByGreens { vec3 by_greens[]; };
layout(scalar, binding = 4) readonly buffer ByBlues { vec3 by_blues[]; };
layout(std430, binding = 5) writeonly buffer RgbaGradient { vec4 rgba_gradient[]; };
layout(std430, binding = 6) writeonly buffer Partials { float partials[]; };

layout(push_constant) uniform Params {
    int width;
    int height;
    // Number of pixels in an invocation's run.
    int run;
    float background_red;
    float background_green;
    float background_blue;
    // Factors of the weighted sums: share / (3 · sum of weights).
    float l1_factor;
    float ssim_factor;
};

#include "common/grid.glsl"
#include "common/ssim.glsl"
#include "common/workgroup_total.glsl"

// Processes one run, and returns its sum of the weighted L1.
float walk(int x, int first) {
    vec3 background = vec3(background_red, background_green, background_blue);
    vec3 reds[WINDOW], greens[WINDOW], blues[WINDOW];
    [[unroll]] for (int k = 0; k < WINDOW; k++) {
        reds[k] = greens[k] = blues[k] = vec3(0.0);
    }
    float total = 0.0;
    int end = min(first + run, height);
    for (int y = first - HALF; y < end + HALF; y++) {
        vec3 red = vec3(0.0), green = vec3(0.0), blue = vec3(0.0);
        if (y >= 0 && y < height) {
            int at = y * width + x;
            red = by_reds[at];
            green = by_greens[at];
            blue = by_blues[at];
        }
        SLIDE(reds, red);
        SLIDE(greens, green);
        SLIDE(blues, blue);
        int done = y - HALF;
        if (done >= first) {
            int pixel = done * width + x;
            vec4 value = rgba[pixel];
            uint packed_pixel = reference[pixel];
            float weight = unpack(packed_pixel, 3u);
            vec3 rendered = value.rgb + (1.0 - value.a) * background;
            vec3 photo = vec3(unpack(packed_pixel, 0u), unpack(packed_pixel, 1u),
                              unpack(packed_pixel, 2u));
            vec3 by_mean = vec3(reds[0].x, greens[0].x, blues[0].x);
            vec3 by_square = vec3(reds[0].y, greens[0].y, blues[0].y);
            vec3 by_product = vec3(reds[0].z, greens[0].z, blues[0].z);
            vec3 ssim = by_mean + 2.0 * rendered * by_square + photo * by_product;
            vec3 difference = rendered - photo;
            vec3 by_rgb = l1_factor * weight * sign(difference) - ssim_factor * ssim;
            rgba_gradient[pixel] = vec4(by_rgb, -dot(by_rgb, background));
            total += weight * (abs(difference.r) + abs(difference.g) + abs(difference.b));
        }
    }
    return total;
}

void main() {
    uint group = group_index();
    uint id = gl_LocalInvocationIndex;
    int item = int(group * 64u + id);
    int x = item % width, first = item / width * run;
    float total = workgroup_total(first < height ? walk(x, first) : 0.0);
    if (id == 0u && first < height) {
        partials[group] = total;
    }
}
