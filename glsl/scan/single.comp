#version 460
// Exclusive prefix sums by a single workgroup, which walks over the values 4096 at a time: for so few
// that further dispatches would cost more than they share.
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require

layout(local_size_x = 256) in;

layout(std430, binding = 0) readonly buffer Count { uint count[]; };
layout(std430, binding = 1) readonly buffer Values { uint values[]; };
layout(std430, binding = 2) writeonly buffer Prefix { uint prefix[]; };
layout(std430, binding = 3) writeonly buffer Total { uint total[]; };

layout(push_constant) uniform Params {
    uint count_at;
    uint capacity;
    uint total_at;
};

#include "common/workgroup_sum.glsl"

const uint BLOCK = 4096u;
const uint ITEMS = 16u;

void main() {
    uint n = min(count[count_at], capacity);
    uint carry = 0u;
    for (uint base = 0u; base < n; base += BLOCK) {
        uint begin = base + ITEMS * gl_LocalInvocationIndex;
        uint own[ITEMS];
        uint sum = 0u;
        [[unroll]] for (uint k = 0u; k < ITEMS; k++) {
            own[k] = begin + k < n ? values[begin + k] : 0u;
            sum += own[k];
        }
        uint chunk;
        uint running = carry + exclusive_sum(sum, chunk);
        [[unroll]] for (uint k = 0u; k < ITEMS; k++) {
            if (begin + k < n) {
                prefix[begin + k] = running;
            }
            running += own[k];
        }
        carry += chunk;
    }
    if (gl_LocalInvocationIndex == 0u) {
        total[total_at] = carry;
    }
}
