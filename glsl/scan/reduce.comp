#version 460
// Sums each block of 4096 values.
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_EXT_scalar_block_layout : require

layout(local_size_x = 256) in;

layout(std430, binding = 0) readonly buffer Count { uint count[]; };
layout(scalar, binding = 1) readonly buffer Values { uvec4 values[]; };
layout(std430, binding = 2) writeonly buffer Sums { uint sums[]; };

layout(push_constant) uniform Params {
    uint count_at;
    uint capacity;
};

#include "common/grid.glsl"
#include "common/workgroup_sum.glsl"
#include "scan/vec4.glsl"

const uint BLOCK = 4096u;

void main() {
    uint block = group_index();
    uint n = min(count[count_at], capacity);
    uint blocks = n / BLOCK + (n % BLOCK == 0u ? 0u : 1u);
    // The condition is the same for the whole workgroup, so that no invocation misses a barrier.
    if (block >= blocks) {
        return;
    }
    uint begin = block * BLOCK;
    uint end = min(begin + BLOCK, n);
    uint rest = end - end % 4u;
    uint sum = 0u;
    [[unroll]] for (uint k = 0u; k < BLOCK; k += 1024u) {
        uint at = begin + k + 4u * sum_index();
        if (at < rest) {
            sum += sum_of(values[at / 4u]);
        }
    }
    if (sum_index() < end - rest) {
        sum += value(rest + sum_index());
    }
    uint total;
    exclusive_sum(sum, total);
    if (sum_index() == 0u) {
        sums[block] = total;
    }
}
