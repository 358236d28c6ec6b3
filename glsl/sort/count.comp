#version 460
// Counts the digits of each run of keys. Each invocation processes one run and has its own
// counters. Invocations share no data, so the result does not depend on their order.
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_EXT_scalar_block_layout : require

layout(local_size_x = 32) in;

layout(std430, binding = 0) readonly buffer Plan { uint plan[]; };
layout(scalar, binding = 1) readonly buffer Keys { uvec4 keys[]; };
// Indexed [digit][run].
layout(std430, binding = 2) writeonly buffer Table { uint table[]; };

layout(push_constant) uniform Params {
    uint shift;
    uint mask;
    uint bins;
};

#include "common/grid.glsl"
#include "sort/counters.glsl"

void count_digit(uint key) {
    uint digit = (key >> shift) & mask;
    set_counter(digit, counter(digit) + 1u);
}

void main() {
    uint run = group_index() * RUNS_PER_GROUP + gl_LocalInvocationIndex;
    uint runs = plan[2];
    if (run >= runs) {
        return;
    }
    for (uint digit = 0u; digit < bins; digit++) {
        set_counter(digit, 0u);
    }
    uint i = run * plan[1];
    uint end = i + min(plan[1], plan[0] - i);
    for (; end - i >= 4u; i += 4u) {
        uvec4 four = keys[i / 4u];
        [[unroll]] for (int k = 0; k < 4; k++) {
            count_digit(four[k]);
        }
    }
    for (; i < end; i++) {
        count_digit(keys[i / 4u][i % 4u]);
    }
    for (uint digit = 0u; digit < bins; digit++) {
        table[digit * runs + run] = counter(digit);
    }
}
