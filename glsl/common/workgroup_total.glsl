// Sums over a workgroup of 64 invocations. Each subgroup sums its values, and every invocation then
// adds the subgroups' sums in order.
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_arithmetic : require

shared float subgroup_totals[64];

// The sum of `value` over the workgroup. Every invocation must call this function, and only once,
// because no barrier protects the shared array from a second call.
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
