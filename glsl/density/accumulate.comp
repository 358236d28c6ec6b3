#version 460
// Adds one view's screen-space gradients to the statistics of adaptive control.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 64) in;

// Gradients with respect to mean x, mean y (pixels), depth and opacity.
layout(std430, binding = 0) readonly buffer MeanGradients { vec4 mean_gradients[]; };
layout(std430, binding = 1) readonly buffer Visible { uint visible[]; };
// 0 if the view's intersections did not all fit into the buffers.
layout(std430, binding = 2) readonly buffer Fits { uint fits[]; };
layout(std430, binding = 3) buffer Statistics { float statistics[]; };

layout(push_constant) uniform Params {
    uint count;
    float half_width;
    float half_height;
};

#include "common/grid.glsl"
#include "common/quaternion.glsl"

void main() {
    uint j = group_index() * 64u + gl_LocalInvocationIndex;
    if (j >= count || visible[j] == 0u || fits[0] == 0u) {
        return;
    }
    float norm = length(mean_gradients[j].xy * vec2(half_width, half_height));
    if (finite(norm)) {
        statistics[2u * j] += norm;
        statistics[2u * j + 1u] += 1.0;
    }
}
