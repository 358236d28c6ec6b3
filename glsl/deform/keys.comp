#version 460
// Writes sort keys that order the places of a list of neighbours by their control points. Empty
// places sort last.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer Neighbours { uint neighbours[]; };
layout(std430, binding = 1) writeonly buffer Keys { uint keys[]; };
layout(std430, binding = 2) writeonly buffer Places { uint places[]; };

layout(push_constant) uniform Params {
    uint count;
    uint node_count;
};

#include "common/grid.glsl"

void main() {
    uint i = group_index() * 64u + gl_LocalInvocationIndex;
    if (i >= count) {
        return;
    }
    keys[i] = min(neighbours[i], node_count);
    places[i] = i;
}
