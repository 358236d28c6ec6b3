#version 460
// Copies vectors, to measure a device's peak bandwidth.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer Source { vec4 source[]; };
layout(std430, binding = 1) writeonly buffer Target { vec4 target[]; };

layout(push_constant) uniform Params {
    uint count;
};

#include "common/grid.glsl"

// Number of vectors per invocation. Adjacent invocations access adjacent vectors.
const uint EACH = 8u;

void main() {
    uint first = group_index() * 64u * EACH + gl_LocalInvocationIndex;
    for (uint k = 0u; k < EACH; k++) {
        uint i = first + 64u * k;
        if (i < count) {
            target[i] = source[i];
        }
    }
}
