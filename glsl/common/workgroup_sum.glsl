// Prefix sums over a workgroup of 256 invocations, by shared memory alone: right for every subgroup
// size. Two barriers: 16 invocations each scan 16 values, then everyone adds up the partial sums
// before its own.
shared uint workgroup_values[256];
shared uint workgroup_partials[16];

// Sum of `value` over the invocations before this one; `total` over all. Every invocation of the
// workgroup must call it. A second call needs no barrier in between.
uint exclusive_sum(uint value, out uint total) {
    uint lane = gl_LocalInvocationIndex;
    barrier();
    workgroup_values[lane] = value;
    barrier();
    if (lane < 16u) {
        uint sum = 0u;
        for (uint k = 0u; k < 16u; k++) {
            uint v = workgroup_values[16u * lane + k];
            workgroup_values[16u * lane + k] = sum;
            sum += v;
        }
        workgroup_partials[lane] = sum;
    }
    barrier();
    uint before = 0u;
    total = 0u;
    for (uint k = 0u; k < 16u; k++) {
        uint v = workgroup_partials[k];
        before += k < lane / 16u ? v : 0u;
        total += v;
    }
    return before + workgroup_values[lane];
}
