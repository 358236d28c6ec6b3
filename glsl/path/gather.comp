#version 460
// The gradient with respect to the control points' paths. Each invocation computes one half of one
// key of one control point, and sums over all times in order.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer Times { float times[]; };
layout(std430, binding = 1) readonly buffer TransformGradients { vec4 transform_gradients[]; };
layout(std430, binding = 2) writeonly buffer Gradients { float gradients[]; };

layout(push_constant) uniform Params {
    uint node_count;
    uint key_count;
    uint time_count;
};

#include "common/grid.glsl"
#include "common/keys.glsl"

void main() {
    uint i = group_index() * 64u + gl_LocalInvocationIndex;
    if (i >= 2u * key_count * node_count) {
        return;
    }
    uint key = i / (2u * node_count);
    uint column = i % (2u * node_count);
    vec4 sum = vec4(0.0);
    for (uint time = 0u; time < time_count; time++) {
        Keys keys = keys_at(times[time], key_count);
        float weight = 0.0;
        for (int slot = 0; slot < 4; slot++) {
            weight += key_of(keys, slot, key_count) == key ? keys.weights[slot] : 0.0;
        }
        if (weight != 0.0) {
            sum += weight * transform_gradients[time * 2u * node_count + column];
        }
    }
    // The fourth value of the translation half is added to opacity logits. It is given and not
    // learnt.
    sum.w = column % 2u == 0u ? 0.0 : sum.w;
    for (uint k = 0u; k < 4u; k++) {
        gradients[4u * i + k] = sum[k];
    }
}
