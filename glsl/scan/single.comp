#version 460
// Exclusive prefix sums by a single workgroup, which walks over the values 4096 at a time: for so few
// that further dispatches would cost more than they share.
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_EXT_scalar_block_layout : require

layout(local_size_x = 256) in;

layout(std430, binding = 0) readonly buffer Count { uint count[]; };
layout(scalar, binding = 1) readonly buffer Values { uvec4 values[]; };
layout(scalar, binding = 2) writeonly buffer Prefix { uvec4 prefix[]; };
layout(std430, binding = 3) writeonly buffer Total { uint total[]; };

layout(push_constant) uniform Params {
    uint count_at;
    uint capacity;
    uint total_at;
};

#include "common/workgroup_sum.glsl"
#include "scan/fours.glsl"
#include "scan/prefix.glsl"

const uint BLOCK = 4096u;
const uint FOURS = 4u;

void main() {
    uint n = min(count[count_at], capacity);
    uint carry = 0u;
    for (uint base = 0u; base < n; base += BLOCK) {
        uint begin = base + 4u * FOURS * gl_LocalInvocationIndex;
        uvec4 own[FOURS];
        uint sum = 0u;
        [[unroll]] for (uint k = 0u; k < FOURS; k++) {
            own[k] = load_four(begin + 4u * k, n);
            sum += own[k].x + own[k].y + own[k].z + own[k].w;
        }
        uint chunk;
        uint running = carry + exclusive_sum(sum, chunk);
        [[unroll]] for (uint k = 0u; k < FOURS; k++) {
            store_four(begin + 4u * k, n, own[k], running);
        }
        carry += chunk;
    }
    if (gl_LocalInvocationIndex == 0u) {
        total[total_at] = carry;
    }
}
