#version 460
// Sums the contributions of the Gaussians to each control point, with one workgroup per control
// point and always in the same order.
#extension GL_GOOGLE_include_directive : require
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_arithmetic : require

layout(local_size_x = 64) in;

// The places (row, neighbour) that hold control point n are
// place_from_sorted[starts[n] .. starts[n + 1]].
layout(std430, binding = 0) readonly buffer Starts { uint starts[]; };
layout(std430, binding = 1) readonly buffer PlaceFromSorted { uint place_from_sorted[]; };
layout(std430, binding = 2) readonly buffer Contributions { vec4 contributions[]; };
layout(std430, binding = 3) readonly buffer Transforms { vec4 transforms[]; };
layout(std430, binding = 4) buffer TransformGradients { vec4 transform_gradients[]; };
layout(std430, binding = 5) buffer RadiusGradients { float radius_gradients[]; };

layout(push_constant) uniform Params {
    uint node_count;
    uint transforms_at;
    uint accumulate;
};

#include "common/grid.glsl"
#include "common/quaternion.glsl"

shared vec4 first_half[64];
shared vec4 second_half[64];

void main() {
    uint node = group_index();
    uint lane = gl_LocalInvocationIndex;
    bool real = node < node_count;
    vec4 a = vec4(0.0);
    vec4 b = vec4(0.0);
    uint end = real ? starts[node + 1u] : 0u;
    for (uint i = (real ? starts[node] : 0u) + lane; i < end; i += 64u) {
        uint place = place_from_sorted[i];
        a += contributions[2u * place];
        b += contributions[2u * place + 1u];
    }
    a = subgroupAdd(a);
    b = subgroupAdd(b);
    if (gl_SubgroupInvocationID == 0u) {
        first_half[gl_SubgroupID] = a;
        second_half[gl_SubgroupID] = b;
    }
    barrier();
    if (lane == 0u && real) {
        a = first_half[0];
        b = second_half[0];
        for (uint k = 1u; k < gl_NumSubgroups; k++) {
            a += first_half[k];
            b += second_half[k];
        }
        // Converts the gradient with respect to the unit rotation to that with respect to the
        // stored rotation.
        uint at = 2u * (transforms_at + node);
        b = unit_quaternion_backward(transforms[at + 1u], b);
        vec4 t = vec4(a.xyz, 0.0);
        if (accumulate != 0u) {
            t += transform_gradients[at];
            b += transform_gradients[at + 1u];
            a.w += radius_gradients[node];
        }
        transform_gradients[at] = t;
        transform_gradients[at + 1u] = b;
        radius_gradients[node] = a.w;
    }
}
