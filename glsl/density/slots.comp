#version 460
// Lists the rows that receive new Gaussians: the dead Gaussians in order, or the rows after the
// last.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer Dead { uint dead[]; };
layout(std430, binding = 1) readonly buffer DeadPrefix { uint dead_prefix[]; };
layout(std430, binding = 2) writeonly buffer RowFromSlot { uint row_from_slot[]; };

layout(push_constant) uniform Params {
    uint count;
    uint grown;     // if not 0, this many rows after the last are the slots
};

#include "common/grid.glsl"

void main() {
    uint j = group_index() * 64u + gl_LocalInvocationIndex;
    if (grown != 0u) {
        if (j < grown) {
            row_from_slot[j] = count + j;
        }
        return;
    }
    if (j < count && dead[j] != 0u) {
        row_from_slot[dead_prefix[j]] = j;
    }
}
