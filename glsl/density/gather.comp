#version 460
// Copies one array into the order of the new rows. With `fresh_zero`, which is set for optimiser
// moments, only rows of origin 0 (kept) carry values, and all others become zero.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer Totals { uint totals[]; };
layout(std430, binding = 1) readonly buffer SourceFromRow { uint source_from_row[]; };
layout(std430, binding = 2) readonly buffer Values { float values[]; };
layout(std430, binding = 3) writeonly buffer Gathered { float gathered[]; };

layout(push_constant) uniform Params {
    uint width;
    uint fresh_zero;
};

#include "common/grid.glsl"

void main() {
    uint i = group_index() * 64u + gl_LocalInvocationIndex;
    uint row = i / width;
    if (row >= totals[2]) {
        return;
    }
    uint code = source_from_row[row];
    bool zero = fresh_zero != 0u && code >= 1u << 30u;
    gathered[i] = zero ? 0.0 : values[(code & 0x3fffffffu) * width + i % width];
}
