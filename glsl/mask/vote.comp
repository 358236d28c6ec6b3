#version 460
// Adds the gradients with respect to the motion logits and the votes of one image, for every
// Gaussian that is visible in it.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 64) in;

// The outputs of mask/compare, summed over the pixels with the Gaussian's contributions as weights:
// the loss's gradient, the mask, 1.
layout(std430, binding = 0) readonly buffer ColourGradients { vec4 colour_gradients[]; };
layout(std430, binding = 1) readonly buffer Visible { uint visible[]; };
// 0 if the image's intersections did not all fit into the buffers.
layout(std430, binding = 2) readonly buffer Fits { uint fits[]; };
layout(std430, binding = 3) readonly buffer MotionLogits { float motion_logits[]; };
layout(std430, binding = 4) buffer MotionGradients { float motion_gradients[]; };
// Votes for motion; all votes.
layout(std430, binding = 5) buffer Votes { float votes[]; };
layout(std430, binding = 6) writeonly buffer Evidence { float evidence[]; };

layout(push_constant) uniform Params {
    uint count;
};

#include "common/grid.glsl"
#include "common/quaternion.glsl"
#include "common/sigmoid.glsl"

void main() {
    uint i = group_index() * 64u + gl_LocalInvocationIndex;
    if (i >= count || visible[i] == 0u || fits[0] == 0u) {
        return;
    }
    vec3 g = colour_gradients[i].rgb;
    if (!finite(g)) {
        return;
    }
    float m = sigmoid(motion_logits[i]);
    motion_gradients[i] += g.r * m * (1.0 - m);
    float moving = votes[2u * i] + g.g;
    float all = votes[2u * i + 1u] + g.b;
    votes[2u * i] = moving;
    votes[2u * i + 1u] = all;
    if (all > 0.0) {
        evidence[i] = clamp(moving / all, 0.0, 1.0);
    }
}
