#version 460
// Adds up the workgroups' sums of one term, in a fixed order.

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer Partials { float partials[]; };
layout(std430, binding = 1) buffer Totals { float totals[]; };

layout(push_constant) uniform Params {
    uint count;
    uint slot;
};

shared float sums[64];

void main() {
    uint id = gl_LocalInvocationIndex;
    float own = 0.0;
    for (uint k = id; k < count; k += 64u) {
        own += partials[k];
    }
    sums[id] = own;
    for (uint step = 32u; step > 0u; step /= 2u) {
        barrier();
        if (id < step) {
            sums[id] += sums[id + step];
        }
    }
    if (id == 0u) {
        totals[slot] = sums[0];
    }
}
