#version 460
// Writes the exclusive prefix sums of each block of 4096 values, from the sum before the block on.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 256) in;

layout(std430, binding = 0) readonly buffer Count { uint count[]; };
layout(std430, binding = 1) readonly buffer Values { uint values[]; };
layout(std430, binding = 2) readonly buffer Sums { uint sums[]; };
layout(std430, binding = 3) writeonly buffer Prefix { uint prefix[]; };

layout(push_constant) uniform Params {
    uint count_at;
    uint capacity;
};

#include "common/grid.glsl"
#include "common/workgroup_sum.glsl"

const uint BLOCK = 4096u;
const uint ITEMS = 16u;

void main() {
    uint block = group_index();
    uint n = min(count[count_at], capacity);
    uint blocks = n / BLOCK + (n % BLOCK == 0u ? 0u : 1u);
    // The same for the whole workgroup.
    if (block >= blocks) {
        return;
    }
    uint left = n - block * BLOCK;
    uint begin = min(ITEMS * gl_LocalInvocationIndex, left);
    uint end = min(begin + ITEMS, left);
    uint sum = 0u;
    for (uint k = begin; k < end; k++) {
        sum += values[block * BLOCK + k];
    }
    uint total;
    uint running = sums[block] + exclusive_sum(sum, total);
    for (uint k = begin; k < end; k++) {
        uint at = block * BLOCK + k;
        prefix[at] = running;
        running += values[at];
    }
}
