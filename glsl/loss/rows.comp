#version 460
// First pass of SSIM: the window along rows over x, y, x², y² and x·y, x the rendered image over its
// background and y the photograph.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer Rgba { vec4 rgba[]; };
layout(std430, binding = 1) readonly buffer Photograph { uint photograph[]; };
// One plane per channel each.
layout(std430, binding = 2) writeonly buffer MeanX { float mean_x[]; };
layout(std430, binding = 3) writeonly buffer MeanY { float mean_y[]; };
layout(std430, binding = 4) writeonly buffer SquareX { float square_x[]; };
layout(std430, binding = 5) writeonly buffer SquareY { float square_y[]; };
layout(std430, binding = 6) writeonly buffer Product { float product[]; };

layout(push_constant) uniform Params {
    int width;
    int height;
    float background_red;
    float background_green;
    float background_blue;
};

#include "common/grid.glsl"
#include "common/ssim.glsl"

void main() {
    uint item = group_index() * 64u + gl_LocalInvocationIndex;
    int runs = (width + RUN - 1) / RUN;
    int row = int(item) / runs;
    if (row >= 3 * height) {
        return;
    }
    int first = (int(item) % runs) * RUN;
    int channel = row / height, y = row % height;
    float background = vec3(background_red, background_green, background_blue)[channel];
    float xs[SPAN], ys[SPAN];
    for (int k = 0; k < SPAN; k++) {
        int x = first + k - HALF;
        xs[k] = 0.0;
        ys[k] = 0.0;
        if (x >= 0 && x < width) {
            int pixel = y * width + x;
            xs[k] = rgba[pixel][channel] + (1.0 - rgba[pixel].a) * background;
            ys[k] = unpack(photograph[pixel], uint(channel));
        }
    }
    for (int o = 0; o < RUN; o++) {
        float sums[5] = float[](0.0, 0.0, 0.0, 0.0, 0.0);
        for (int k = 0; k < WINDOW; k++) {
            float tap_x = TAPS[k] * xs[o + k], tap_y = TAPS[k] * ys[o + k];
            sums[0] += tap_x;
            sums[1] += tap_y;
            sums[2] += tap_x * xs[o + k];
            sums[3] += tap_y * ys[o + k];
            sums[4] += tap_x * ys[o + k];
        }
        if (first + o < width) {
            int at = row * width + first + o;
            mean_x[at] = sums[0];
            mean_y[at] = sums[1];
            square_x[at] = sums[2];
            square_y[at] = sums[3];
            product[at] = sums[4];
        }
    }
}
