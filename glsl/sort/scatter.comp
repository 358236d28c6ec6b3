#version 460
// Moves each run's pairs to their places. `offsets` is the exclusive prefix sum of the table that
// `count.comp` wrote: the destination of the run's first key of each digit. A run is processed in
// order, so pairs of equal digits keep their order.
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_EXT_scalar_block_layout : require

layout(local_size_x = 32) in;

layout(std430, binding = 0) readonly buffer Plan { uint plan[]; };
layout(std430, binding = 1) readonly buffer Offsets { uint offsets[]; };
layout(scalar, binding = 2) readonly buffer Keys { uvec4 keys[]; };
layout(scalar, binding = 3) readonly buffer Payload { uvec4 payload[]; };
layout(std430, binding = 4) writeonly buffer SortedKeys { uint sorted_keys[]; };
layout(std430, binding = 5) writeonly buffer SortedPayload { uint sorted_payload[]; };

layout(push_constant) uniform Params {
    uint shift;
    uint mask;
    uint bins;
};

#include "common/grid.glsl"
#include "sort/counters.glsl"

void move(uint key, uint load) {
    uint digit = (key >> shift) & mask;
    uint to = counter(digit);
    set_counter(digit, to + 1u);
    sorted_keys[to] = key;
    sorted_payload[to] = load;
}

void main() {
    uint run = group_index() * RUNS_PER_GROUP + gl_LocalInvocationIndex;
    uint runs = plan[2];
    if (run >= runs) {
        return;
    }
    for (uint digit = 0u; digit < bins; digit++) {
        set_counter(digit, offsets[digit * runs + run]);
    }
    uint i = run * plan[1];
    uint end = i + min(plan[1], plan[0] - i);
    for (; end - i >= 4u; i += 4u) {
        uvec4 four = keys[i / 4u];
        uvec4 loads = payload[i / 4u];
        [[unroll]] for (int k = 0; k < 4; k++) {
            move(four[k], loads[k]);
        }
    }
    for (; i < end; i++) {
        move(keys[i / 4u][i % 4u], payload[i / 4u][i % 4u]);
    }
}
