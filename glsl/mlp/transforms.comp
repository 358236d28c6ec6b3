#version 460
// Converts the last layer's outputs to the control points' motions: translation and padding, then
// the rotation [1, 0, 0, 0] + offset.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer Activations { vec4 activations[]; };
layout(std430, binding = 1) writeonly buffer Transforms { vec4 transforms[]; };

layout(push_constant) uniform Params {
    uint rows;
    uint stride;
    uint head;
};

#include "common/grid.glsl"

float value(uint plane, uint row) {
    return activations[((head + plane) * stride + row) / 4u][row % 4u];
}

void main() {
    uint row = group_index() * 64u + gl_LocalInvocationIndex;
    if (row >= rows) {
        return;
    }
    transforms[2u * row] = vec4(value(0u, row), value(1u, row), value(2u, row), 0.0);
    transforms[2u * row + 1u] =
        vec4(1.0 + value(3u, row), value(4u, row), value(5u, row), value(6u, row));
}
