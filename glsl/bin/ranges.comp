#version 460
// Finds where each tile's intersections begin and end in the list sorted by tile.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer Total { uint total[]; };
layout(std430, binding = 1) readonly buffer Tiles { uint tiles[]; };
layout(std430, binding = 2) buffer Ranges { uvec2 ranges[]; };

layout(push_constant) uniform Params {
    uint capacity;
    uint tile_count;
};

#include "common/grid.glsl"

void main() {
    uint i = group_index() * 64u + gl_LocalInvocationIndex;
    uint count = min(total[0], capacity);
    if (i >= count || tiles[i] >= tile_count) {
        return;
    }
    if (i == 0u || tiles[i - 1u] != tiles[i]) {
        ranges[tiles[i]].x = i;
    }
    if (i + 1u == count || tiles[i + 1u] != tiles[i]) {
        ranges[tiles[i]].y = i + 1u;
    }
}
