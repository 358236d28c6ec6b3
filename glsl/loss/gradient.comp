#version 460
// Last pass of the photometric loss: the window along columns over the derivatives, the gradient of
// weighted L1 + D-SSIM to colour and alpha, and each workgroup's sum of the weighted L1.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer Rgba { vec4 rgba[]; };
layout(std430, binding = 1) readonly buffer Photograph { uint photograph[]; };
layout(std430, binding = 2) readonly buffer RowsMean { float rows_mean[]; };
layout(std430, binding = 3) readonly buffer RowsSquare { float rows_square[]; };
layout(std430, binding = 4) readonly buffer RowsProduct { float rows_product[]; };
layout(std430, binding = 5) writeonly buffer RgbaGradient { vec4 rgba_gradient[]; };
layout(std430, binding = 6) writeonly buffer Partials { float partials[]; };

layout(push_constant) uniform Params {
    int width;
    int height;
    float background_red;
    float background_green;
    float background_blue;
    // Factors of the weighted sums: share / (3 · sum of weights).
    float l1_factor;
    float ssim_factor;
};

#include "common/grid.glsl"
#include "common/ssim.glsl"

shared float sums[64];

float run(int first, int x) {
    vec3 background = vec3(background_red, background_green, background_blue);
    vec3 gradient[RUN];
    for (int o = 0; o < RUN; o++) {
        gradient[o] = vec3(0.0);
    }
    vec3 rendered[RUN], photo[RUN];
    float weight[RUN];
    for (int o = 0; o < RUN; o++) {
        rendered[o] = vec3(0.0);
        photo[o] = vec3(0.0);
        weight[o] = 0.0;
        if (first + o < height) {
            int pixel = (first + o) * width + x;
            vec4 value = rgba[pixel];
            uint packed_pixel = photograph[pixel];
            rendered[o] = value.rgb + (1.0 - value.a) * background;
            photo[o] = vec3(unpack(packed_pixel, 0u), unpack(packed_pixel, 1u),
                            unpack(packed_pixel, 2u));
            weight[o] = unpack(packed_pixel, 3u);
        }
    }
    for (int channel = 0; channel < 3; channel++) {
        for (int s = 0; s < 3; s++) {
            float column[SPAN];
            for (int k = 0; k < SPAN; k++) {
                int y = first + k - HALF;
                int at = (channel * height + y) * width + x;
                column[k] = 0.0;
                if (y >= 0 && y < height) {
                    column[k] = s == 0 ? rows_mean[at] : s == 1 ? rows_square[at]
                                                                : rows_product[at];
                }
            }
            for (int o = 0; o < RUN; o++) {
                float sum = 0.0;
                for (int k = 0; k < WINDOW; k++) {
                    sum += TAPS[k] * column[o + k];
                }
                gradient[o][channel] += s == 0   ? sum
                                        : s == 1 ? 2.0 * rendered[o][channel] * sum
                                                 : photo[o][channel] * sum;
            }
        }
    }
    float total = 0.0;
    for (int o = 0; o < RUN; o++) {
        if (first + o < height) {
            vec3 difference = rendered[o] - photo[o];
            vec3 by_rgb = l1_factor * weight[o] * sign(difference) - ssim_factor * gradient[o];
            rgba_gradient[(first + o) * width + x] = vec4(by_rgb, -dot(by_rgb, background));
            total += weight[o] * (abs(difference.r) + abs(difference.g) + abs(difference.b));
        }
    }
    return total;
}

void main() {
    uint group = group_index();
    uint id = gl_LocalInvocationIndex;
    int item = int(group * 64u + id);
    int items = (height + RUN - 1) / RUN * width;
    sums[id] = item < items ? run(item / width * RUN, item % width) : 0.0;
    for (uint step = 32u; step > 0u; step /= 2u) {
        barrier();
        if (id < step) {
            sums[id] += sums[id + step];
        }
    }
    if (id == 0u && int(group * 64u) < items) {
        partials[group] = sums[0];
    }
}
