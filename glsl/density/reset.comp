#version 460
// Opacity reset: no logit stays above the limit.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) buffer OpacityLogits { float opacity_logits[]; };

layout(push_constant) uniform Params {
    uint count;
    float limit;
};

#include "common/grid.glsl"

void main() {
    uint j = group_index() * 64u + gl_LocalInvocationIndex;
    if (j < count) {
        opacity_logits[j] = min(opacity_logits[j], limit);
    }
}
