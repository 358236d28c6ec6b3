#version 460
// Sums the gradients of one layer over the segments, in order.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer Partials { float partials[]; };
layout(std430, binding = 1) buffer Gradients { float gradients[]; };

layout(push_constant) uniform Params {
    uint inputs;
    uint outputs;
    uint segments;
    uint weights_at;
    uint accumulate;
};

#include "common/grid.glsl"

void main() {
    uint i = group_index() * 64u + gl_LocalInvocationIndex;
    uint columns = inputs + 1u;
    uint count = columns * outputs;
    if (i >= count) {
        return;
    }
    float sum = 0.0;
    for (uint s = 0u; s < segments; s++) {
        sum += partials[s * count + i];
    }
    uint o = i / columns;
    uint k = i % columns;
    uint at = weights_at + (k < inputs ? o * inputs + k : inputs * outputs + o);
    gradients[at] = accumulate != 0u ? gradients[at] + sum : sum;
}
