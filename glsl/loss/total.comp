#version 460
// Sums the workgroups' sums of one term, in a fixed order.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer Partials { float partials[]; };
layout(std430, binding = 1) buffer Totals { float totals[]; };

layout(push_constant) uniform Params {
    uint count;
    uint slot;
};

#include "common/workgroup_total.glsl"

void main() {
    uint id = gl_LocalInvocationIndex;
    float own = 0.0;
    for (uint k = id; k < count; k += 64u) {
        own += partials[k];
    }
    float total = workgroup_total(own);
    if (id == 0u) {
        totals[slot] = total;
    }
}
