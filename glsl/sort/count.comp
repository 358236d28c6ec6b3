#version 460
// Counts the digits of each run of keys. One invocation a run, with counters of its own: nothing is
// shared between invocations, so there is no order among them to depend on.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 32) in;

layout(std430, binding = 0) readonly buffer Plan { uint plan[]; };
layout(std430, binding = 1) readonly buffer Keys { uint keys[]; };
// Digit by digit, run by run.
layout(std430, binding = 2) writeonly buffer Table { uint table[]; };

layout(push_constant) uniform Params {
    uint shift;
    uint mask;
    uint bins;
};

#include "common/grid.glsl"

// Invocation by invocation within a digit, so that neighbours use different banks.
shared uint counters[256 * 32];

void main() {
    uint lane = gl_LocalInvocationIndex;
    uint run = group_index() * 32u + lane;
    uint runs = plan[2];
    if (run >= runs) {
        return;
    }
    for (uint digit = 0u; digit < bins; digit++) {
        counters[digit * 32u + lane] = 0u;
    }
    uint begin = run * plan[1];
    uint end = begin + min(plan[1], plan[0] - begin);
    for (uint i = begin; i < end; i++) {
        counters[((keys[i] >> shift) & mask) * 32u + lane] += 1u;
    }
    for (uint digit = 0u; digit < bins; digit++) {
        table[digit * runs + run] = counters[digit * 32u + lane];
    }
}
