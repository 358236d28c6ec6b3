#version 460
// Moves every dynamic Gaussian with its nearest control points (linear blend skinning). All other
// Gaussians stay unchanged.
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_scalar_block_layout : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer GaussianFromDynamic { uint gaussian_from_dynamic[]; };
layout(std430, binding = 1) readonly buffer Neighbours { uint neighbours[]; };
layout(scalar, binding = 2) readonly buffer Positions { vec3 positions[]; };
layout(std430, binding = 3) readonly buffer Rotations { vec4 rotations[]; };
layout(std430, binding = 4) readonly buffer MotionLogits { float motion_logits[]; };
layout(std430, binding = 5) readonly buffer Evidence { float evidence[]; };
layout(scalar, binding = 6) readonly buffer Nodes { vec3 nodes[]; };
layout(std430, binding = 7) readonly buffer LogRadii { float log_radii[]; };
layout(std430, binding = 8) readonly buffer Transforms { vec4 transforms[]; };
layout(std430, binding = 9) readonly buffer OpacityLogits { float opacity_logits[]; };
layout(scalar, binding = 10) writeonly buffer MovedPositions { vec3 moved_positions[]; };
layout(std430, binding = 11) writeonly buffer MovedRotations { vec4 moved_rotations[]; };
layout(std430, binding = 12) writeonly buffer MovedOpacityLogits { float moved_opacity_logits[]; };
layout(std430, binding = 13) writeonly buffer Rigidity { float rigidity[]; };

layout(push_constant) uniform Params {
    uint rows;
    uint transforms_at;
    uint soft;
};

#include "common/grid.glsl"
#include "common/sigmoid.glsl"
#include "common/quaternion.glsl"
#include "deform/skin.glsl"

void main() {
    uint row = group_index() * 64u + gl_LocalInvocationIndex;
    if (row >= rows) {
        return;
    }
    uint j = gaussian_from_dynamic[row];
    vec3 point = positions[j];
    vec4 q = rotations[j];
    float rigid = 0.0;
    float fade = 0.0;
    Neighbour near[MOST_FOLLOWED];
    uint heaviest;
    if (load_neighbours(row, point, near, heaviest)) {
        vec3 delta;
        vec4 sum, r;
        float norm;
        blend(near, heaviest, delta, sum);
        unit_quaternion(sum, r, norm);
        float m = 1.0;
        if (soft != 0u) {
            m = sigmoid(motion_logits[j]);
            float side;
            unit_quaternion(soften(r, m, side), r, norm);
            rigid = (1.0 - evidence[j]) * dot(delta, delta);
        }
        for (uint s = 0u; s < K; s++) {
            fade = s == heaviest ? m * near[s].fade : fade;
        }
        point += m * delta;
        vec4 u;
        q = unit_quaternion(q, u, norm) ? multiply(r, q) : r;
    }
    moved_positions[j] = point;
    moved_rotations[j] = q;
    // Interpolated values may overshoot to above 0. Such values and NaN leave the opacity
    // unchanged.
    moved_opacity_logits[j] = opacity_logits[j] + (fade < 0.0 ? fade : 0.0);
    rigidity[row] = rigid;
}
