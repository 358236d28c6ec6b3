// One counter per digit value for each invocation of a workgroup.

const uint RUNS_PER_GROUP = 32u;
// Largest widths of a digit, in bits.
const uint OWN_DIGIT_BITS = 9u;
const uint SHARED_DIGIT_BITS = 8u;

// Whether the counters are in a private array of the invocation instead of shared memory. On
// software devices a private array costs a fraction of shared memory, because their compiler
// unrolls the lanes for the former and loops over them for the latter. On a GPU a private array of
// this size is spilled.
layout(constant_id = 0) const bool OWN_COUNTERS = false;

uint own_counters[1u << OWN_DIGIT_BITS];
// Indexed [digit][invocation], so that adjacent invocations use different banks.
shared uint shared_counters[(1u << SHARED_DIGIT_BITS) * RUNS_PER_GROUP];

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
