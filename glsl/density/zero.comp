#version 460
// Zeroes the rows of Gaussians that were drawn or replaced, so that their optimiser moments
// restart.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer Touched { uint touched[]; };
layout(std430, binding = 1) writeonly buffer Values { float values[]; };

layout(push_constant) uniform Params {
    uint count;
    uint width;
};

#include "common/grid.glsl"

void main() {
    uint i = group_index() * 64u + gl_LocalInvocationIndex;
    if (i < count * width && touched[i / width] != 0u) {
        values[i] = 0.0;
    }
}
