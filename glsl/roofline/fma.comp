#version 460
// Sixteen independent chains of multiply-adds per invocation, to measure a device's peak
// arithmetic. Chain c of invocation i starts at (c + 1) · seed and computes x · 0.75 + seed four
// times per round.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer Seeds { float seeds[]; };
layout(std430, binding = 1) writeonly buffer Sums { float sums[]; };

layout(push_constant) uniform Params {
    uint count;
    uint rounds;
};

#include "common/grid.glsl"

void main() {
    uint i = group_index() * 64u + gl_LocalInvocationIndex;
    if (i >= count) {
        return;
    }
    vec4 seed = vec4(seeds[i]);
    vec4 a = seed * vec4(1.0, 2.0, 3.0, 4.0);
    vec4 b = seed * vec4(5.0, 6.0, 7.0, 8.0);
    vec4 c = seed * vec4(9.0, 10.0, 11.0, 12.0);
    vec4 d = seed * vec4(13.0, 14.0, 15.0, 16.0);
    for (uint turn = 0u; turn < rounds; turn++) {
        for (uint k = 0u; k < 4u; k++) {
            a = a * 0.75 + seed;
            b = b * 0.75 + seed;
            c = c * 0.75 + seed;
            d = d * 0.75 + seed;
        }
    }
    vec4 sum = (a + b) + (c + d);
    sums[i] = (sum.x + sum.y) + (sum.z + sum.w);
}
