#version 460
// Writes every Gaussian's probability of motion as the red channel of a colour, which is blended
// like a colour.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer MotionLogits { float motion_logits[]; };
layout(std430, binding = 1) writeonly buffer Colours { vec4 colours[]; };

layout(push_constant) uniform Params {
    uint count;
};

#include "common/grid.glsl"
#include "common/sigmoid.glsl"

void main() {
    uint i = group_index() * 64u + gl_LocalInvocationIndex;
    if (i < count) {
        colours[i] = vec4(sigmoid(motion_logits[i]), 0.0, 0.0, 0.0);
    }
}
