#version 460
// The gradient of the mean absolute difference between the rendered probability of motion and a
// motion mask. The other channels hold the mask and 1. The same backward pass weights them by a
// Gaussian's contributions to the pixels, and their sums are the Gaussian's votes.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer Rgba { vec4 rgba[]; };
layout(std430, binding = 1) readonly buffer Mask { float mask[]; };
layout(std430, binding = 2) writeonly buffer RgbaGradient { vec4 rgba_gradient[]; };

layout(push_constant) uniform Params {
    uint pixels;
    float factor;
};

#include "common/grid.glsl"

void main() {
    uint p = group_index() * 64u + gl_LocalInvocationIndex;
    if (p >= pixels) {
        return;
    }
    float difference = rgba[p].r - mask[p];
    float slope = difference > 0.0 ? factor : (difference < 0.0 ? -factor : 0.0);
    rgba_gradient[p] = vec4(slope, mask[p], 1.0, 0.0);
}
