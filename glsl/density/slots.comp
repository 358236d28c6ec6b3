#version 460
// The rows that get new Gaussians: the dead ones in order, or those behind the last.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer Dead { uint dead[]; };
layout(std430, binding = 1) readonly buffer DeadPrefix { uint dead_prefix[]; };
layout(std430, binding = 2) writeonly buffer Slots { uint slots[]; };

layout(push_constant) uniform Params {
    uint count;
    uint grown;     // where not 0: so many behind the last
};

#include "common/grid.glsl"

void main() {
    uint j = group_index() * 64u + gl_LocalInvocationIndex;
    if (grown != 0u) {
        if (j < grown) {
            slots[j] = count + j;
        }
        return;
    }
    if (j < count && dead[j] != 0u) {
        slots[dead_prefix[j]] = j;
    }
}
