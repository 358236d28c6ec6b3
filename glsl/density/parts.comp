#version 460
// Draws the parts of split Gaussians: displaced by a sample of their source, and smaller.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer Totals { uint totals[]; };
layout(std430, binding = 1) readonly buffer Rows { uint rows[]; };
layout(std430, binding = 2) readonly buffer Rotations { vec4 rotations[]; };
layout(std430, binding = 3) buffer Positions { float positions[]; };
layout(std430, binding = 4) buffer LogScales { float log_scales[]; };

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
    if (j >= totals[2] || rows[j] >> 30u != 2u) {
        return;
    }
    vec3 log_scale = vec3(log_scales[3u * j], log_scales[3u * j + 1u], log_scales[3u * j + 2u]);
    vec3 local = random_normals(uvec4(j, step_number, seed, 2u)) * exp(log_scale);
    vec4 q;
    float norm;
    unit_quaternion(rotations[j], q, norm);
    vec3 moved = local + turn_offset(q, local);
    for (uint c = 0u; c < 3u; c++) {
        positions[3u * j + c] += moved[c];
        log_scales[3u * j + c] = log_scale[c] - log_shrink;
    }
}
