// Prefix sums over a workgroup of at most 256 invocations in full subgroups of any size. Each
// subgroup computes its own prefix sums. Every invocation then adds the sums of the preceding
// subgroups.
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_arithmetic : require

shared uint subgroup_sums[256];

// The invocation's index in the order of `exclusive_sum`.
uint sum_index() {
    return gl_SubgroupID * gl_SubgroupSize + gl_SubgroupInvocationID;
}

// The sum of `value` over the preceding invocations. `total` receives the sum over all. Every
// invocation of the workgroup must call this function. No barrier is needed between two calls.
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
