#version 460
// Computes the integer weights of the draw from the opacities, and which Gaussians are dead.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer OpacityLogits { float opacity_logits[]; };
layout(std430, binding = 1) readonly buffer MotionLogits { float motion_logits[]; };
layout(std430, binding = 2) writeonly buffer Weights { uint weights[]; };
layout(std430, binding = 3) writeonly buffer Dead { uint dead[]; };

layout(push_constant) uniform Params {
    uint count;
    uint motion_class;  // 0: all, 1: static, 2: dynamic
    uint has_motion;
    uint largest;       // weight of an opaque Gaussian; keeps the sum below 2^32
    float dead_logit;
};

#include "common/grid.glsl"
#include "common/sigmoid.glsl"

void main() {
    uint j = group_index() * 64u + gl_LocalInvocationIndex;
    if (j >= count) {
        return;
    }
    float logit = opacity_logits[j];
    bool moves = has_motion != 0u && motion_logits[j] > 0.0;
    bool member = motion_class == 0u || moves == (motion_class == 2u);
    // A Gaussian with a NaN logit is dead, too.
    bool alive = logit > dead_logit;
    uint weight = clamp(uint(sigmoid(logit) * float(largest)), 1u, largest);
    weights[j] = member && alive ? weight : 0u;
    dead[j] = member && !alive ? 1u : 0u;
}
