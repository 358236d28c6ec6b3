// Sums over a workgroup of 64 invocations: a subgroup sums its own, then the subgroups' sums are added
// in their order.
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_arithmetic : require

shared float subgroup_totals[64];

// Sum of `value` over all. Every invocation of the workgroup must call it, once.
float workgroup_total(float value) {
    float own = subgroupAdd(value);
    if (gl_SubgroupInvocationID == 0u) {
        subgroup_totals[gl_SubgroupID] = own;
    }
    barrier();
    float total = 0.0;
    for (uint k = 0u; k < gl_NumSubgroups; k++) {
        total += subgroup_totals[k];
    }
    return total;
}
