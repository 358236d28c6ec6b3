#version 460
// The window along rows over the derivatives of the SSIM map: the blur is its own adjoint.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer ByMean { float by_mean[]; };
layout(std430, binding = 1) readonly buffer BySquare { float by_square[]; };
layout(std430, binding = 2) readonly buffer ByProduct { float by_product[]; };
layout(std430, binding = 3) writeonly buffer RowsMean { float rows_mean[]; };
layout(std430, binding = 4) writeonly buffer RowsSquare { float rows_square[]; };
layout(std430, binding = 5) writeonly buffer RowsProduct { float rows_product[]; };

layout(push_constant) uniform Params {
    int width;
    int height;
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
    for (int s = 0; s < 3; s++) {
        float span[SPAN];
        for (int k = 0; k < SPAN; k++) {
            int x = first + k - HALF;
            int at = row * width + x;
            span[k] = 0.0;
            if (x >= 0 && x < width) {
                span[k] = s == 0 ? by_mean[at] : s == 1 ? by_square[at] : by_product[at];
            }
        }
        for (int o = 0; o < RUN; o++) {
            float sum = 0.0;
            for (int k = 0; k < WINDOW; k++) {
                sum += TAPS[k] * span[o + k];
            }
            int at = row * width + first + o;
            if (first + o < width) {
                switch (s) {
                case 0: rows_mean[at] = sum; break;
                case 1: rows_square[at] = sum; break;
                default: rows_product[at] = sum; break;
                }
            }
        }
    }
}
