#version 460
// Divides `count` keys into runs, one for each invocation of `count.comp` and `scatter.comp`.

layout(local_size_x = 1) in;

layout(std430, binding = 0) readonly buffer Count { uint count[]; };
// Number of keys, keys in a run, runs, entries of the table, and the three words of the grid over
// the runs.
layout(std430, binding = 1) writeonly buffer Plan { uint plan[]; };

layout(push_constant) uniform Params {
    uint count_at;
    uint capacity;
    uint bins;
    uint min_run;
    uint max_runs;
    uint group_limit;
};

const uint RUNS_PER_GROUP = 32u;

uint divided_up(uint a, uint b) {
    return a / b + (a % b == 0u ? 0u : 1u);
}

void main() {
    uint n = min(count[count_at], capacity);
    // A run is a multiple of four keys, since keys are loaded as uvec4.
    uint run = 4u * divided_up(max(divided_up(n, max_runs), min_run), 4u);
    uint runs = divided_up(n, run);
    uint groups = divided_up(runs, RUNS_PER_GROUP);
    uint rows = max(divided_up(groups, group_limit), 1u);
    plan[0] = n;
    plan[1] = run;
    plan[2] = runs;
    plan[3] = bins * runs;
    plan[4] = rows == 1u ? groups : group_limit;
    plan[5] = rows;
    plan[6] = 1u;
}
