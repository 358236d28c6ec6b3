// Loads of four values that adjacent invocations have in common.
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_shuffle : require

// Whether all invocations of a subgroup (at least four) need the same four values. Each invocation
// then loads one of the four. This is faster on software devices, which load lane by lane.
layout(constant_id = 0) const bool SHARED = false;

// The linear index of the invocation, in the order of subgroups.
uint shared_index() {
    return group_index() * 64u + gl_SubgroupID * gl_SubgroupSize + gl_SubgroupInvocationID;
}

// The one of the four values that this invocation loads.
uint own_of(uvec4 four) {
    return four[gl_SubgroupInvocationID & 3u];
}

float own_of(vec4 four) {
    return four[gl_SubgroupInvocationID & 3u];
}

// All four values, from the invocations that loaded them.
vec4 all_four(float own) {
    return vec4(subgroupShuffle(own, 0u), subgroupShuffle(own, 1u), subgroupShuffle(own, 2u),
                subgroupShuffle(own, 3u));
}

mat4 all_four(vec4 own) {
    return mat4(subgroupShuffle(own, 0u), subgroupShuffle(own, 1u), subgroupShuffle(own, 2u),
                subgroupShuffle(own, 3u));
}
