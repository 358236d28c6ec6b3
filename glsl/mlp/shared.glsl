// Four values that neighbouring invocations need alike.
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_shuffle : require

// Whether the invocations of a subgroup, four at least, all need the same: each then loads one of the
// four. It pays on software devices, which load lane by lane.
layout(constant_id = 0) const bool SHARED = false;

// The invocation's place, in the order of subgroups.
uint shared_index() {
    return group_index() * 64u + gl_SubgroupID * gl_SubgroupSize + gl_SubgroupInvocationID;
}

// Which of four the invocation loads.
uint own_of(uvec4 four) {
    return four[gl_SubgroupInvocationID & 3u];
}

float own_of(vec4 four) {
    return four[gl_SubgroupInvocationID & 3u];
}

// The four that invocations have loaded.
vec4 all_four(float own) {
    return vec4(subgroupShuffle(own, 0u), subgroupShuffle(own, 1u), subgroupShuffle(own, 2u),
                subgroupShuffle(own, 3u));
}

mat4 all_four(vec4 own) {
    return mat4(subgroupShuffle(own, 0u), subgroupShuffle(own, 1u), subgroupShuffle(own, 2u),
                subgroupShuffle(own, 3u));
}
