// Prefix sums over a workgroup of at most 256 invocations in full subgroups, of any size: a subgroup
// sums its own, then everyone adds up the sums of the subgroups before its own.
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_arithmetic : require

shared uint subgroup_sums[256];

// The invocation's place in the order of `exclusive_sum`.
uint sum_index() {
    return gl_SubgroupID * gl_SubgroupSize + gl_SubgroupInvocationID;
}

// Sum of `value` over the invocations before this one; `total` over all. Every invocation of the
// workgroup must call it. A second call needs no barrier in between.
uint exclusive_sum(uint value, out uint total) {
    uint before = subgroupExclusiveAdd(value);
    barrier();
    if (gl_SubgroupInvocationID == gl_SubgroupSize - 1u) {
        subgroup_sums[gl_SubgroupID] = before + value;
    }
    barrier();
    uint below = 0u;
    total = 0u;
    for (uint k = gl_SubgroupInvocationID; k < gl_NumSubgroups; k += gl_SubgroupSize) {
        uint sum = subgroup_sums[k];
        below += k < gl_SubgroupID ? sum : 0u;
        total += sum;
    }
    uvec2 sums = subgroupAdd(uvec2(below, total));
    total = sums.y;
    return sums.x + before;
}
