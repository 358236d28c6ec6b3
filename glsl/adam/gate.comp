#version 460
// Determines which Gaussians a step may change: none if the frame's intersections did not fit,
// otherwise those that are trained.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer Fits { uint fits[]; };
layout(std430, binding = 1) readonly buffer Trainable { uint trainable[]; };
layout(std430, binding = 2) writeonly buffer Gate { uint gate[]; };

layout(push_constant) uniform Params { uint count; };

#include "common/grid.glsl"

void main() {
    uint i = group_index() * 64u + gl_LocalInvocationIndex;
    if (i < count) {
        gate[i] = fits[0] & trainable[i];
    }
}
