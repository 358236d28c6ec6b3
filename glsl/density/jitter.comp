#version 460
// Moves every centre by noise of the Gaussian's own covariance, the more the fainter it is.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer LogScales { float log_scales[]; };
layout(std430, binding = 1) readonly buffer Rotations { vec4 rotations[]; };
layout(std430, binding = 2) readonly buffer OpacityLogits { float opacity_logits[]; };
layout(std430, binding = 3) buffer Positions { float positions[]; };

layout(push_constant) uniform Params {
    uint count;
    uint seed;
    uint step_number;
    float size;
};

#include "common/grid.glsl"
#include "common/sigmoid.glsl"
#include "common/quaternion.glsl"
#include "common/sine.glsl"
#include "common/random.glsl"

void main() {
    uint j = group_index() * 64u + gl_LocalInvocationIndex;
    if (j >= count) {
        return;
    }
    vec3 noise = random_normals(uvec4(j, step_number, seed, 1u));
    float gate = sigmoid(100.0 * (0.005 - sigmoid(opacity_logits[j])));
    vec4 q;
    float norm;
    unit_quaternion(rotations[j], q, norm);
    vec3 local = noise + turn_offset(conjugate(q), noise);
    vec3 log_scale = vec3(log_scales[3u * j], log_scales[3u * j + 1u], log_scales[3u * j + 2u]);
    vec3 stretched = local * exp(2.0 * log_scale);
    vec3 moved = (stretched + turn_offset(q, stretched)) * (gate * size);
    if (finite(moved)) {
        for (uint c = 0u; c < 3u; c++) {
            positions[3u * j + c] += moved[c];
        }
    }
}
