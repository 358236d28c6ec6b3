#version 460
// Adds one view's screen-space gradients to the statistics of adaptive control.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer ScreenGradients { float screen_gradients[]; };
layout(std430, binding = 1) readonly buffer Visible { uint visible[]; };
layout(std430, binding = 2) buffer Statistics { float statistics[]; };

layout(push_constant) uniform Params {
    uint count;
    float half_width;
    float half_height;
};

#include "common/grid.glsl"
#include "common/quaternion.glsl"

void main() {
    uint j = group_index() * 64u + gl_LocalInvocationIndex;
    if (j >= count || visible[j] == 0u) {
        return;
    }
    float norm = length(vec2(screen_gradients[2u * j] * half_width,
                             screen_gradients[2u * j + 1u] * half_height));
    if (finite(norm)) {
        statistics[2u * j] += norm;
        statistics[2u * j + 1u] += 1.0;
    }
}
