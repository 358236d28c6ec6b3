#version 460
// Lays out the rows of the new arrays: the survivors in order, then the added rows as far as the
// capacity allows. A row stores its source and, in the two upper bits, its origin: 0 kept, 1
// copied, 2 drawn as a part of a split Gaussian.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer Actions { uint actions[]; };
layout(std430, binding = 1) readonly buffer KeptPrefix { uint kept_prefix[]; };
layout(std430, binding = 2) readonly buffer AddedPrefix { uint added_prefix[]; };
// Number of survivors; number of candidates to add; receives the final number of rows.
layout(std430, binding = 3) buffer Totals { uint totals[]; };
layout(std430, binding = 4) writeonly buffer SourceFromRow { uint source_from_row[]; };

layout(push_constant) uniform Params {
    uint count;
    uint capacity;
};

#include "common/grid.glsl"

void main() {
    uint j = group_index() * 64u + gl_LocalInvocationIndex;
    uint survivors = totals[0];
    uint free = capacity - min(capacity, survivors);
    if (j == 0u) {
        totals[2] = survivors + min(free, totals[1]);
    }
    if (j >= count || actions[j] == 0u) {
        return;
    }
    bool grows = actions[j] >= 2u && added_prefix[j] < free;
    uint origin = actions[j] == 3u ? 2u : 1u;
    if (grows) {
        source_from_row[survivors + added_prefix[j]] = j | origin << 30u;
    }
    source_from_row[kept_prefix[j]] = j | (grows && origin == 2u ? 2u << 30u : 0u);
}
