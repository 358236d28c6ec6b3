#version 460
// Converts the gradients with respect to the control points' motions to planes of the gradient with
// respect to the last layer's outputs. Padding rows get zeros, so that they add nothing to the
// weights' gradients.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer TransformGradients { vec4 transform_gradients[]; };
layout(std430, binding = 1) writeonly buffer Deltas { vec4 deltas[]; };

layout(push_constant) uniform Params {
    uint rows;
    uint stride;
    uint target;
};

#include "common/grid.glsl"

void put(uint plane, uint row, float value) {
    deltas[((target + plane) * stride + row) / 4u][row % 4u] = value;
}

void main() {
    uint row = group_index() * 64u + gl_LocalInvocationIndex;
    if (row >= stride) {
        return;
    }
    bool real = row < rows;
    vec4 t = real ? transform_gradients[2u * row] : vec4(0.0);
    vec4 r = real ? transform_gradients[2u * row + 1u] : vec4(0.0);
    put(0u, row, t.x);
    put(1u, row, t.y);
    put(2u, row, t.z);
    put(3u, row, r.x);
    put(4u, row, r.y);
    put(5u, row, r.z);
    put(6u, row, r.w);
}
