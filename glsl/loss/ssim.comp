#version 460
// Second pass of SSIM: the window along columns, the map, and its derivatives by the windowed mean
// of x, of x² and of x·y. Each workgroup leaves its sum of the weighted map.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer MeanX { float mean_x[]; };
layout(std430, binding = 1) readonly buffer MeanY { float mean_y[]; };
layout(std430, binding = 2) readonly buffer SquareX { float square_x[]; };
layout(std430, binding = 3) readonly buffer SquareY { float square_y[]; };
layout(std430, binding = 4) readonly buffer Product { float product[]; };
layout(std430, binding = 5) readonly buffer Photograph { uint photograph[]; };
layout(std430, binding = 6) writeonly buffer ByMean { float by_mean[]; };
layout(std430, binding = 7) writeonly buffer BySquare { float by_square[]; };
layout(std430, binding = 8) writeonly buffer ByProduct { float by_product[]; };
layout(std430, binding = 9) writeonly buffer Partials { float partials[]; };

layout(push_constant) uniform Params {
    int width;
    int height;
};

#include "common/grid.glsl"
#include "common/ssim.glsl"

shared float sums[64];

// The weighted map's sum over one run.
float run(int channel, int first, int x) {
    float windowed[5][RUN];
    for (int s = 0; s < 5; s++) {
        float column[SPAN];
        for (int k = 0; k < SPAN; k++) {
            int y = first + k - HALF;
            column[k] = 0.0;
            if (y >= 0 && y < height) {
                int at = (channel * height + y) * width + x;
                switch (s) {
                case 0: column[k] = mean_x[at]; break;
                case 1: column[k] = mean_y[at]; break;
                case 2: column[k] = square_x[at]; break;
                case 3: column[k] = square_y[at]; break;
                default: column[k] = product[at]; break;
                }
            }
        }
        for (int o = 0; o < RUN; o++) {
            float sum = 0.0;
            for (int k = 0; k < WINDOW; k++) {
                sum += TAPS[k] * column[o + k];
            }
            windowed[s][o] = sum;
        }
    }
    float total = 0.0;
    for (int o = 0; o < RUN; o++) {
        if (first + o < height) {
            float mx = windowed[0][o], my = windowed[1][o];
            float variance_x = windowed[2][o] - mx * mx, variance_y = windowed[3][o] - my * my;
            float covariance = windowed[4][o] - mx * my;
            float a1 = 2.0 * mx * my + C1, a2 = 2.0 * covariance + C2;
            float b1 = mx * mx + my * my + C1, b2 = variance_x + variance_y + C2;
            float map = a1 * a2 / (b1 * b2);
            int pixel = (first + o) * width + x;
            float weight = unpack(photograph[pixel], 3u);
            float square = -weight * map / b2;
            float cross_term = weight * 2.0 * a1 / (b1 * b2);
            int at = channel * width * height + pixel;
            by_square[at] = square;
            by_product[at] = cross_term;
            by_mean[at] = weight * (2.0 * my * a2 / (b1 * b2) - 2.0 * mx * map / b1)
                          - 2.0 * mx * square - my * cross_term;
            total += weight * map;
        }
    }
    return total;
}

void main() {
    uint group = group_index();
    uint id = gl_LocalInvocationIndex;
    int item = int(group * 64u + id);
    int runs = (height + RUN - 1) / RUN;
    int per_channel = runs * width;
    sums[id] = item < 3 * per_channel ? run(item / per_channel, item % per_channel / width * RUN,
                                            item % width)
                                      : 0.0;
    for (uint step = 32u; step > 0u; step /= 2u) {
        barrier();
        if (id < step) {
            sums[id] += sums[id + step];
        }
    }
    if (id == 0u && int(group * 64u) < 3 * per_channel) {
        partials[group] = sums[0];
    }
}
