#version 460
// Replaces the blocks' sums by their exclusive prefix sums, and writes the sum of all values. A
// single workgroup processes 4096 blocks at a time.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 256) in;

layout(std430, binding = 0) readonly buffer Count { uint count[]; };
layout(std430, binding = 1) buffer Sums { uint sums[]; };
layout(std430, binding = 2) writeonly buffer Total { uint total[]; };

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
    uint blocks = n / BLOCK + (n % BLOCK == 0u ? 0u : 1u);
    uint carry = 0u;
    for (uint base = 0u; base < blocks; base += BLOCK) {
        uint begin = min(base + ITEMS * sum_index(), blocks);
        uint end = min(begin + ITEMS, blocks);
        uint sum = 0u;
        for (uint k = begin; k < end; k++) {
            sum += sums[k];
        }
        uint chunk;
        uint running = carry + exclusive_sum(sum, chunk);
        for (uint k = begin; k < end; k++) {
            uint v = sums[k];
            sums[k] = running;
            running += v;
        }
        carry += chunk;
    }
    if (sum_index() == 0u) {
        total[total_at] = carry;
    }
}
