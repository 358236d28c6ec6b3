#version 460
// Adds the gradients of the two regularisers of 3DGS-MCMC: the mean opacity and the mean scale.
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_scalar_block_layout : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer OpacityLogits { float opacity_logits[]; };
layout(scalar, binding = 1) readonly buffer LogScales { vec3 log_scales[]; };
layout(std430, binding = 2) buffer OpacityGradients { float opacity_gradients[]; };
layout(scalar, binding = 3) buffer LogScaleGradients { vec3 log_scale_gradients[]; };

layout(push_constant) uniform Params {
    uint count;
    // Weight of each mean, divided by the number of its values.
    float opacity_factor;
    float scale_factor;
};

#include "common/grid.glsl"

void main() {
    uint i = group_index() * 64u + gl_LocalInvocationIndex;
    if (i >= count) {
        return;
    }
    // e / (1 + e)² is even in the logit, so the exponential can be kept at most 1.
    float e = exp(-abs(opacity_logits[i]));
    opacity_gradients[i] += opacity_factor * e / ((1.0 + e) * (1.0 + e));
    log_scale_gradients[i] += scale_factor * exp(log_scales[i]);
}
