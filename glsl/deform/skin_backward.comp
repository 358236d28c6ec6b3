#version 460
// The gradient of skinning for every dynamic Gaussian. Converts the Gaussian's gradients to those
// with respect to its canonical values in place, and writes its contribution to each of its control
// points, which deform/gather sums. Weights carry gradient to the radii only.
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
layout(scalar, binding = 9) buffer PositionGradients { vec3 position_gradients[]; };
layout(std430, binding = 10) buffer RotationGradients { vec4 rotation_gradients[]; };
layout(std430, binding = 11) buffer MotionGradients { float motion_gradients[]; };
// Two vectors per (row, neighbour), gradients with respect to: translation and log-radius; unit
// rotation.
layout(std430, binding = 12) writeonly buffer Contributions { vec4 contributions[]; };

layout(push_constant) uniform Params {
    uint rows;
    uint transforms_at;
    uint soft;
    float rigid_scale;
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
    Neighbour near[MOST_FOLLOWED];
    uint heaviest;
    // A Gaussian without a neighbour keeps its gradients. It uses the same stores, because software
    // devices also execute branches that are not taken.
    bool moves = load_neighbours(row, point, near, heaviest);
    vec3 by_position = position_gradients[j];
    vec4 by_rotation = rotation_gradients[j];
    vec3 delta;
    vec4 sum, blended;
    float norm;
    blend(near, heaviest, delta, sum);
    unit_quaternion(sum, blended, norm);

    float m = 1.0;
    float side = 1.0;
    vec4 r = blended;
    vec4 mixture = blended;
    if (soft != 0u) {
        m = sigmoid(motion_logits[j]);
        mixture = soften(blended, m, side);
        unit_quaternion(mixture, r, norm);
    }
    vec4 q = rotations[j];
    vec4 ignored;
    bool real = unit_quaternion(q, ignored, norm);
    q = real ? q : NO_ROTATION;
    vec4 by_own_rotation = real ? multiply(conjugate(r), by_rotation) : vec4(0.0);
    rotation_gradients[j] = moves ? by_own_rotation : by_rotation;
    vec4 by_blended = multiply(by_rotation, conjugate(q));
    vec3 by_delta = m * by_position;
    if (soft != 0u) {
        vec4 by_mixture = unit_quaternion_backward(mixture, by_blended);
        float by_m = dot(by_position, delta) + dot(by_mixture, side * blended - NO_ROTATION);
        motion_gradients[j] += moves ? by_m * sigmoid_slope(motion_logits[j]) : 0.0;
        by_blended = m * side * by_mixture;
        by_delta += 2.0 * rigid_scale * (1.0 - evidence[j]) * delta;
    }
    vec4 by_sum = unit_quaternion_backward(sum, by_blended);

    float by_weight[MOST_FOLLOWED];
    for (uint s = 0u; s < K; s++) {
        by_weight[s] = dot(by_delta, near[s].moved) + dot(by_sum, near[s].rotation);
    }
    for (uint s = 0u; s < K; s++) {
        Neighbour n = near[s];
        // The conjugates of -rotation and rotation are the same rotation, so the sign has no effect
        // here.
        vec3 turned = n.weight * turn_offset(conjugate(n.rotation), by_delta);
        by_position += moves ? turned : vec3(0.0);
        // This is the mean of the differences, not the difference from the mean. If this neighbour
        // has nearly all the weight, the latter would be rounding error times a slope of thousands
        // (case deform/underflow).
        float by_exponent = 0.0;
        for (uint t = 0u; t < K; t++) {
            by_exponent += near[t].weight * (by_weight[s] - by_weight[t]);
        }
        float by_log_radius = n.weight > 0.0 ? n.weight * by_exponent * n.slope : 0.0;
        // The gradient with respect to the aligned rotation, converted to the sign of the stored
        // rotation.
        vec4 own = transforms[2u * (transforms_at + (n.node != NONE ? n.node : 0u)) + 1u];
        vec4 by_own = turn_backward(n.rotation, n.offset, by_delta) + by_sum;
        by_own = dot(own, n.rotation) < 0.0 ? -by_own : by_own;
        vec4 by_motion = vec4(n.weight * by_delta, by_log_radius);
        contributions[2u * (row * K + s)] = moves ? by_motion : vec4(0.0);
        contributions[2u * (row * K + s) + 1u] = moves ? n.weight * by_own : vec4(0.0);
    }
    position_gradients[j] = by_position;
}
