#version 460
// Finds where each control point's places begin among the sorted keys: the first key that is not
// smaller.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer Keys { uint keys[]; };
layout(std430, binding = 1) writeonly buffer Starts { uint starts[]; };

layout(push_constant) uniform Params {
    uint count;
    uint node_count;
};

#include "common/grid.glsl"

void main() {
    uint node = group_index() * 64u + gl_LocalInvocationIndex;
    if (node > node_count) {
        return;
    }
    uint low = 0u;
    uint high = count;
    while (low < high) {
        uint middle = (low + high) / 2u;
        bool smaller = keys[middle] < node;
        low = smaller ? middle + 1u : low;
        high = smaller ? high : middle;
    }
    starts[node] = low;
}
