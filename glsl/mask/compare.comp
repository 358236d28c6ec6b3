#version 460
// The gradient of the mean absolute difference between the rendered probability of motion and a
// motion mask; and, in the other channels, what lets the same backward pass collect every
// Gaussian's votes: the mask and 1, whose sums over a Gaussian's share of the pixels make its vote.
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
