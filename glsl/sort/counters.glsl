// One counter per digit for each invocation of a workgroup.

const uint RUNS_PER_GROUP = 32u;

// On a software device an invocation's own array costs a fraction of shared memory: its compiler
// unrolls the lanes of the one and loops over those of the other. On a GPU such an array is spilled.
layout(constant_id = 0) const bool OWN_COUNTERS = false;

uint own_counters[512];
// Invocation by invocation within a digit, so that neighbours use different banks.
shared uint shared_counters[256 * RUNS_PER_GROUP];

uint counter(uint digit) {
    if (OWN_COUNTERS) {
        return own_counters[digit];
    }
    return shared_counters[digit * RUNS_PER_GROUP + gl_LocalInvocationIndex];
}

void set_counter(uint digit, uint value) {
    if (OWN_COUNTERS) {
        own_counters[digit] = value;
    } else {
        shared_counters[digit * RUNS_PER_GROUP + gl_LocalInvocationIndex] = value;
    }
}
