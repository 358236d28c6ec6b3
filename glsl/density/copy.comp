#version 460
// Copies the target row of each slot to the slot, within one array.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer Totals { uint totals[]; };
layout(std430, binding = 1) readonly buffer Slots { uint slots[]; };
layout(std430, binding = 2) readonly buffer Targets { uint targets[]; };
layout(std430, binding = 3) buffer Values { float values[]; };

layout(push_constant) uniform Params {
    uint width;
};

#include "common/grid.glsl"

void main() {
    uint i = group_index() * 64u + gl_LocalInvocationIndex;
    uint row = i / width;
    if (row >= totals[1] || targets[row] == 0xffffffffu) {
        return;
    }
    uint column = i % width;
    values[slots[row] * width + column] = values[targets[row] * width + column];
}
