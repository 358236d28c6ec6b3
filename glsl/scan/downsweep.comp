#version 460
// Writes the exclusive prefix sums of each block of 4096 values, starting with the sum before the
// block.
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_EXT_scalar_block_layout : require

layout(local_size_x = 256) in;

layout(std430, binding = 0) readonly buffer Count { uint count[]; };
layout(scalar, binding = 1) readonly buffer Values { uvec4 values[]; };
layout(std430, binding = 2) readonly buffer Sums { uint sums[]; };
layout(scalar, binding = 3) writeonly buffer Prefix { uvec4 prefix[]; };

layout(push_constant) uniform Params {
    uint count_at;
    uint capacity;
};

#include "common/grid.glsl"
#include "common/workgroup_sum.glsl"
#include "scan/vec4.glsl"
#include "scan/prefix.glsl"

const uint BLOCK = 4096u;
const uint VECTORS = 4u;

void main() {
    uint block = group_index();
    uint n = min(count[count_at], capacity);
    uint blocks = n / BLOCK + (n % BLOCK == 0u ? 0u : 1u);
    // The condition is the same for the whole workgroup, so that no invocation misses a barrier.
    if (block >= blocks) {
        return;
    }
    uint begin = min(block * BLOCK + 4u * VECTORS * sum_index(), n);
    uint end = min(begin + 4u * VECTORS, n);
    uint tail = max(begin, end - end % 4u);
    uvec4 own[VECTORS];
    uint sum = 0u;
    [[unroll]] for (uint k = 0u; k < VECTORS; k++) {
        own[k] = uvec4(0u);
        if (begin + 4u * k < tail) {
            own[k] = values[begin / 4u + k];
        }
        sum += sum_of(own[k]);
    }
    for (uint at = tail; at < end; at++) {
        sum += value(at);
    }
    uint total;
    uint running = sums[block] + exclusive_sum(sum, total);
    [[unroll]] for (uint k = 0u; k < VECTORS; k++) {
        if (begin + 4u * k < tail) {
            write_vec4(begin + 4u * k, own[k], running);
        }
    }
    write_tail(tail, end, running);
}
