#version 460
// Copies the target slot of each slot to the slot, within one array.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer Totals { uint totals[]; };
layout(std430, binding = 1) readonly buffer RowFromSlot { uint row_from_slot[]; };
layout(std430, binding = 2) readonly buffer TargetFromSlot { uint target_from_slot[]; };
layout(std430, binding = 3) buffer Values { float values[]; };

layout(push_constant) uniform Params {
    uint width;
};

#include "common/grid.glsl"

void main() {
    uint i = group_index() * 64u + gl_LocalInvocationIndex;
    uint slot = i / width;
    if (slot >= totals[1] || target_from_slot[slot] == 0xffffffffu) {
        return;
    }
    uint column = i % width;
    values[row_from_slot[slot] * width + column] = values[target_from_slot[slot] * width + column];
}
