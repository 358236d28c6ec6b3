#version 460
// Emits a (tile, intersection) pair for every tile that a splat overlaps, nearest splat first.
// Intersections are numbered in this order, so those of one splat are consecutive. The backward
// pass writes its partial sums to slots with these numbers.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer VisibleCount { uint visible_count[]; };
layout(std430, binding = 1) readonly buffer SplatFromRank { uint splat_from_rank[]; };
layout(std430, binding = 2) readonly buffer Counts { uint counts[]; };
layout(std430, binding = 3) readonly buffer EmittedFromRank { uint emitted_from_rank[]; };
layout(std430, binding = 4) readonly buffer Rectangles { uvec2 rectangles[]; };
layout(std430, binding = 5) readonly buffer Means { vec4 means[]; };
layout(std430, binding = 6) readonly buffer Conics { vec4 conics[]; };
layout(std430, binding = 7) writeonly buffer Tiles { uint tiles[]; };
layout(std430, binding = 8) writeonly buffer Emitted { uint emitted[]; };
layout(std430, binding = 9) writeonly buffer SplatFromEmitted { uint splat_from_emitted[]; };
layout(std430, binding = 10) buffer Total { uint total[]; };

layout(push_constant) uniform Params {
    uint count;
    uint capacity;
    uint width;
    uint height;
};

layout(constant_id = 0) const bool SPREAD = false;

#include "common/grid.glsl"
#include "common/spread.glsl"
#include "common/tile.glsl"

void main() {
    uint rank = spread_group_index() * 64u + gl_LocalInvocationIndex;
    if (rank >= min(count, visible_count[0])) {
        return;
    }
    uvec2 image = uvec2(width, height);
    uvec2 grid = tile_grid(image);
    uint splat = splat_from_rank[rank];
    uint offset = emitted_from_rank[rank], reached = counts[rank];
    // A sum that overflowed must not be taken for one that fits. No splat overlaps 2^32 tiles, so
    // an overflow appears at some rank as a sum smaller than its offset.
    if (offset + reached < offset) {
        atomicMax(total[0], 0xffffffffu);
    }
    uint at = min(offset, capacity);
    // Emission never exceeds the counted number, even if rounding changes the result of a test.
    uint end = at + min(reached, capacity - at);
    vec2 mean = means[splat].xy;
    vec4 conic = conics[splat];
    uvec2 packed_first = uvec2(rectangles[splat].x & 0xffffu, rectangles[splat].x >> 16);
    uvec2 packed_last = uvec2(rectangles[splat].y & 0xffffu, rectangles[splat].y >> 16);
    for (uint y = packed_first.y; y < packed_last.y; y++) {
        for (uint x = packed_first.x; x < packed_last.x && at < end; x++) {
            if (reaches_tile(mean, conic.xyz, conic.w, uvec2(x, y), image)) {
                tiles[at] = y * grid.x + x;
                emitted[at] = at;
                splat_from_emitted[at] = splat;
                at++;
            }
        }
    }
    // Intersections that were counted but not emitted go to a tile that does not exist.
    for (; at < end; at++) {
        tiles[at] = grid.x * grid.y;
        emitted[at] = at;
        splat_from_emitted[at] = splat;
    }
}
