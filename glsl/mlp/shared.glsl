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

// What the invocation loads of four.
uint own_of(uvec4 four) {
    return four[gl_SubgroupInvocationID & 3u];
}
