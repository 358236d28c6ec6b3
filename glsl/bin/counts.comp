#version 460
// Number of tiles of each visible splat, in order of depth; zero past the last.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer VisibleCount { uint visible_count[]; };
layout(std430, binding = 1) readonly buffer SplatFromRank { uint splat_from_rank[]; };
layout(std430, binding = 2) readonly buffer TileCounts { uint tile_counts[]; };
layout(std430, binding = 3) writeonly buffer Counts { uint counts[]; };

layout(push_constant) uniform Params { uint count; };

#include "common/grid.glsl"

void main() {
    uint rank = group_index() * 64u + gl_LocalInvocationIndex;
    if (rank < count) {
        counts[rank] = rank < visible_count[0] ? tile_counts[splat_from_rank[rank]] : 0u;
    }
}
