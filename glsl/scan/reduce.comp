#version 460
// Sums each block of 4096 values.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 256) in;

layout(std430, binding = 0) readonly buffer Count { uint count[]; };
layout(std430, binding = 1) readonly buffer Values { uint values[]; };
layout(std430, binding = 2) writeonly buffer Sums { uint sums[]; };

layout(push_constant) uniform Params {
    uint count_at;
    uint capacity;
};

#include "common/grid.glsl"
#include "common/workgroup_sum.glsl"

const uint BLOCK = 4096u;

void main() {
    uint block = group_index();
    uint n = min(count[count_at], capacity);
    uint blocks = n / BLOCK + (n % BLOCK == 0u ? 0u : 1u);
    // The same for the whole workgroup.
    if (block >= blocks) {
        return;
    }
    uint end = min(n - block * BLOCK, BLOCK);
    uint sum = 0u;
    for (uint k = gl_LocalInvocationIndex; k < end; k += 256u) {
        sum += values[block * BLOCK + k];
    }
    uint total;
    exclusive_sum(sum, total);
    if (gl_LocalInvocationIndex == 0u) {
        sums[block] = total;
    }
}
