#version 460
// Adds up what project/backward's workgroups left of the pose's gradient.

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer PosePartials { float pose_partials[]; };
layout(std430, binding = 1) writeonly buffer Pose { float pose[]; };

layout(push_constant) uniform Params { uint groups; };

shared float sums[6][64];

void main() {
    uint id = gl_LocalInvocationIndex;
    float own[6] = float[](0.0, 0.0, 0.0, 0.0, 0.0, 0.0);
    for (uint group = id; group < groups; group += 64u) {
        for (uint k = 0u; k < 6u; k++) {
            own[k] += pose_partials[8u * group + k];
        }
    }
    for (uint k = 0u; k < 6u; k++) {
        sums[k][id] = own[k];
    }
    for (uint step = 32u; step > 0u; step /= 2u) {
        barrier();
        if (id < step) {
            for (uint k = 0u; k < 6u; k++) {
                sums[k][id] += sums[k][id + step];
            }
        }
    }
    barrier();
    if (id < 6u) {
        pose[id] = sums[id][0];
    }
}
