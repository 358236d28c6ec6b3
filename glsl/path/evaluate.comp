#version 460
// Evaluates the control points' motions from their paths. Each invocation computes one half of a
// row: the translation, or the rotation, which a path stores as an offset from [1, 0, 0, 0].
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer Paths { float paths[]; };
layout(std430, binding = 1) readonly buffer Times { float times[]; };
layout(std430, binding = 2) writeonly buffer Transforms { vec4 transforms[]; };

layout(push_constant) uniform Params {
    uint node_count;
    uint key_count;
    uint rows;          // control points times times
};

#include "common/grid.glsl"
#include "common/keys.glsl"

void main() {
    uint i = group_index() * 64u + gl_LocalInvocationIndex;
    if (i >= 2u * rows) {
        return;
    }
    Keys keys = keys_at(times[i / 2u / node_count], key_count);
    uint column = i % (2u * node_count);
    vec4 sum = column % 2u == 0u ? vec4(0.0) : vec4(1.0, 0.0, 0.0, 0.0);
    for (int slot = 0; slot < 4; slot++) {
        uint at = 4u * (key_of(keys, slot, key_count) * 2u * node_count + column);
        sum += keys.weights[slot]
            * vec4(paths[at], paths[at + 1u], paths[at + 2u], paths[at + 3u]);
    }
    transforms[i] = sum;
}
