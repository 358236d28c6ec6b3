#version 460
// Draws a target for every slot, with probabilities in proportion to the weights: a random number
// below the weights' sum is looked up in their prefix sums. Draws are counted with integer atomics,
// so the counts do not depend on the order of the additions.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer WeightPrefix { uint weight_prefix[]; };
// The sum of the weights; the number of slots.
layout(std430, binding = 1) readonly buffer Totals { uint totals[]; };
layout(std430, binding = 2) readonly buffer RowFromSlot { uint row_from_slot[]; };
layout(std430, binding = 3) writeonly buffer TargetFromSlot { uint target_from_slot[]; };
layout(std430, binding = 4) buffer Drawn { uint drawn[]; };
layout(std430, binding = 5) writeonly buffer Touched { uint touched[]; };

layout(push_constant) uniform Params {
    uint count;
    uint grown;
    uint seed;
    uint step_number;
};

#include "common/grid.glsl"
#include "common/sine.glsl"
#include "common/random.glsl"

void main() {
    uint i = group_index() * 64u + gl_LocalInvocationIndex;
    if (i >= totals[1]) {
        return;
    }
    uint total = totals[0];
    if (total == 0u) {
        // No Gaussian can be drawn. A new row must hold valid values and copies row 0; a dead
        // Gaussian stays.
        target_from_slot[i] = grown != 0u ? 0u : 0xffffffffu;
        touched[row_from_slot[i]] = grown;
        return;
    }
    uint rest = multiply_high(random_words(uvec4(i, step_number, seed, 0u)).x, total);
    // Finds the last Gaussian whose prefix sum does not exceed the number. A Gaussian of weight 0
    // has the same prefix sum as its successor, so it is never drawn.
    uint low = 0u;
    uint high = count;
    while (high - low > 1u) {
        uint middle = (low + high) / 2u;
        bool within = weight_prefix[middle] <= rest;
        low = within ? middle : low;
        high = within ? high : middle;
    }
    target_from_slot[i] = low;
    atomicAdd(drawn[low], 1u);
    touched[low] = 1u;
    touched[row_from_slot[i]] = 1u;
}
