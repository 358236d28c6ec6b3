#version 460
// Adds noise to every centre (3DGS-MCMC): the Gaussian's covariance times a standard normal vector.
// The fainter the Gaussian, the larger the factor.
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_scalar_block_layout : require

layout(local_size_x = 64) in;

layout(scalar, binding = 0) readonly buffer LogScales { vec3 log_scales[]; };
layout(std430, binding = 1) readonly buffer Rotations { vec4 rotations[]; };
layout(std430, binding = 2) readonly buffer OpacityLogits { float opacity_logits[]; };
layout(scalar, binding = 3) buffer Positions { vec3 positions[]; };

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
    vec3 log_scale = log_scales[j];
    vec3 stretched = local * exp(2.0 * log_scale);
    vec3 moved = (stretched + turn_offset(q, stretched)) * (gate * size);
    if (finite(moved)) {
        positions[j] += moved;
    }
}
