#version 460
// Decides what adaptive control does with every Gaussian: 0 prune, 1 keep, 2 clone, 3 split.
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_scalar_block_layout : require

layout(local_size_x = 64) in;

// Sum of screen-space gradient norms and number of views of each Gaussian.
layout(std430, binding = 0) readonly buffer Statistics { float statistics[]; };
layout(std430, binding = 1) readonly buffer OpacityLogits { float opacity_logits[]; };
layout(scalar, binding = 2) readonly buffer LogScales { vec3 log_scales[]; };
layout(std430, binding = 3) writeonly buffer Actions { uint actions[]; };
layout(std430, binding = 4) writeonly buffer Kept { uint kept[]; };
layout(std430, binding = 5) writeonly buffer Added { uint added[]; };

layout(push_constant) uniform Params {
    uint count;
    float gradient;
    float log_small;
    float log_large;
    float prune_logit;
};

#include "common/grid.glsl"

void main() {
    uint j = group_index() * 64u + gl_LocalInvocationIndex;
    if (j >= count) {
        return;
    }
    vec3 log_scale = log_scales[j];
    float logit = opacity_logits[j];
    float largest = max(log_scale.x, max(log_scale.y, log_scale.z));
    bool broken = any(isnan(log_scale)) || isnan(logit);
    uint action = 1u;
    if (broken || logit < prune_logit || largest > log_large) {
        action = 0u;
    } else {
        float sum = statistics[2u * j];
        float views = statistics[2u * j + 1u];
        if (views > 0.0 && sum / views > gradient) {
            action = largest <= log_small ? 2u : 3u;
        }
    }
    actions[j] = action;
    kept[j] = action != 0u ? 1u : 0u;
    added[j] = action >= 2u ? 1u : 0u;
}
