#version 460
// Draws the parts of split Gaussians: each is displaced by a sample from its source's distribution,
// and smaller than its source.
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_scalar_block_layout : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer Totals { uint totals[]; };
layout(std430, binding = 1) readonly buffer SourceFromRow { uint source_from_row[]; };
layout(std430, binding = 2) readonly buffer Rotations { vec4 rotations[]; };
layout(scalar, binding = 3) buffer Positions { vec3 positions[]; };
layout(scalar, binding = 4) buffer LogScales { vec3 log_scales[]; };

layout(push_constant) uniform Params {
    uint seed;
    uint step_number;
    float log_shrink;
};

#include "common/grid.glsl"
#include "common/quaternion.glsl"
#include "common/sine.glsl"
#include "common/random.glsl"

void main() {
    uint j = group_index() * 64u + gl_LocalInvocationIndex;
    if (j >= totals[2] || source_from_row[j] >> 30u != 2u) {
        return;
    }
    vec3 log_scale = log_scales[j];
    vec3 local = random_normals(uvec4(j, step_number, seed, 2u)) * exp(log_scale);
    vec4 q;
    float norm;
    unit_quaternion(rotations[j], q, norm);
    vec3 moved = local + turn_offset(q, local);
    positions[j] += moved;
    log_scales[j] = log_scale - log_shrink;
}
