#version 460
// Moves each run's pairs to their places. `offsets` is the exclusive prefix sum of the table that
// `count.comp` wrote: where the run's first key of each digit goes. A run is walked in order, so
// equal digits keep theirs.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 32) in;

layout(std430, binding = 0) readonly buffer Plan { uint plan[]; };
layout(std430, binding = 1) readonly buffer Offsets { uint offsets[]; };
layout(std430, binding = 2) readonly buffer Keys { uint keys[]; };
layout(std430, binding = 3) readonly buffer Payload { uint payload[]; };
layout(std430, binding = 4) writeonly buffer SortedKeys { uint sorted_keys[]; };
layout(std430, binding = 5) writeonly buffer SortedPayload { uint sorted_payload[]; };

layout(push_constant) uniform Params {
    uint shift;
    uint mask;
    uint bins;
};

#include "common/grid.glsl"

shared uint next[256 * 32];

void main() {
    uint lane = gl_LocalInvocationIndex;
    uint run = group_index() * 32u + lane;
    uint runs = plan[2];
    if (run >= runs) {
        return;
    }
    for (uint digit = 0u; digit < bins; digit++) {
        next[digit * 32u + lane] = offsets[digit * runs + run];
    }
    uint begin = run * plan[1];
    uint end = begin + min(plan[1], plan[0] - begin);
    for (uint i = begin; i < end; i++) {
        uint key = keys[i];
        uint slot = ((key >> shift) & mask) * 32u + lane;
        uint to = next[slot];
        next[slot] = to + 1u;
        sorted_keys[to] = key;
        sorted_payload[to] = payload[i];
    }
}
