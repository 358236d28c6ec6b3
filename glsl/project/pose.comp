#version 460
// Sums the contributions of project/backward's workgroups to the pose's gradient.
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_arithmetic : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer PosePartials { float pose_partials[]; };
layout(std430, binding = 1) writeonly buffer Pose { float pose[]; };

layout(push_constant) uniform Params { uint groups; };

// Sums of each subgroup: translation, rotation.
shared float sums[64][6];

void main() {
    uint id = gl_LocalInvocationIndex;
    float own[6] = float[](0.0, 0.0, 0.0, 0.0, 0.0, 0.0);
    for (uint group = id; group < groups; group += 64u) {
        for (uint k = 0u; k < 6u; k++) {
            own[k] += pose_partials[8u * group + k];
        }
    }
    vec3 translation = subgroupAdd(vec3(own[0], own[1], own[2]));
    vec3 twist = subgroupAdd(vec3(own[3], own[4], own[5]));
    if (gl_SubgroupInvocationID == 0u) {
        for (uint k = 0u; k < 3u; k++) {
            sums[gl_SubgroupID][k] = translation[k];
            sums[gl_SubgroupID][k + 3u] = twist[k];
        }
    }
    barrier();
    if (id < 6u) {
        float sum = 0.0;
        for (uint k = 0u; k < gl_NumSubgroups; k++) {
            sum += sums[k][id];
        }
        pose[id] = sum;
    }
}
