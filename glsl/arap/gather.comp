#version 460
// Sums the edges' gradients at both of their ends, always in the same order.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 64) in;

// The places whose neighbour is control point n are place_from_sorted[starts[n] .. starts[n + 1]].
layout(std430, binding = 0) readonly buffer Starts { uint starts[]; };
layout(std430, binding = 1) readonly buffer PlaceFromSorted { uint place_from_sorted[]; };
layout(std430, binding = 2) readonly buffer EdgeGradients { vec4 edge_gradients[]; };
layout(std430, binding = 3) buffer TransformGradients { vec4 transform_gradients[]; };

layout(push_constant) uniform Params {
    uint node_count;
    uint k;
    uint first_at;
    uint second_at;
};

#include "common/grid.glsl"

void main() {
    uint i = group_index() * 64u + gl_LocalInvocationIndex;
    if (i >= node_count) {
        return;
    }
    vec3 by_second = vec3(0.0);
    vec3 by_first = vec3(0.0);
    for (uint p = starts[i]; p < starts[i + 1u]; p++) {
        by_second += edge_gradients[2u * place_from_sorted[p]].xyz;
        by_first += edge_gradients[2u * place_from_sorted[p] + 1u].xyz;
    }
    for (uint s = 0u; s < k; s++) {
        by_second -= edge_gradients[2u * (i * k + s)].xyz;
        by_first -= edge_gradients[2u * (i * k + s) + 1u].xyz;
    }
    transform_gradients[2u * (first_at + i)].xyz += by_first;
    transform_gradients[2u * (second_at + i)].xyz += by_second;
}
