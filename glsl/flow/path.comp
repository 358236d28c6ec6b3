#version 460
// Semi-global matching along one of four directions. A workgroup processes one row or column, and
// its invocations share the displacements among them. The costs of the paths are summed in
// `volume`.
#extension GL_GOOGLE_include_directive : require

const uint LANES = 32u;
layout(local_size_x = 32) in;

layout(std430, binding = 0) readonly buffer CensusA { uint census_a[]; };
layout(std430, binding = 1) readonly buffer CensusB { uint census_b[]; };
layout(std430, binding = 2) buffer Volume { uint volume[]; };

layout(push_constant) uniform Params {
    int width;
    int height;
    int radius;
    uint path;          // 0 to 3: from the left, from the right, from above, from below
    uint small_step;
    uint large_step;
};

#include "common/grid.glsl"

const uint MAX_LABELS = 33u * 33u;
const uint OUTSIDE = 8u;

// Double buffers: a step writes one half, while the other half holds the previous step.
shared uint costs[2u * MAX_LABELS];
shared uint least_of[2u * LANES];

void main() {
    bool along_row = path < 2u;
    int line = int(group_index());
    int lines = along_row ? height : width;
    // The condition is the same for the whole workgroup, so that no invocation misses a barrier.
    if (line >= lines) {
        return;
    }
    uint lane = gl_LocalInvocationIndex;
    int side = 2 * radius + 1;
    int labels = side * side;
    int steps = along_row ? width : height;
    for (int step = 0; step < steps; step++) {
        int along = (path & 1u) == 0u ? step : steps - 1 - step;
        ivec2 p = along_row ? ivec2(along, line) : ivec2(line, along);
        int pixel = p.y * width + p.x;
        uint signs = census_a[pixel];
        uint now = uint(step & 1);
        uint base = now * MAX_LABELS, before = MAX_LABELS - base;
        uint least = 0u;
        if (step > 0) {
            least = 0xffffffffu;
            for (uint k = 0u; k < LANES; k++) {
                least = min(least, least_of[(1u - now) * LANES + k]);
            }
        }
        uint own_least = 0xffffffffu;
        for (int l = int(lane); l < labels; l += int(LANES)) {
            ivec2 offset = ivec2(l % side, l / side);
            ivec2 there = p + offset - radius;
            bool inside = all(greaterThanEqual(there, ivec2(0))) && there.x < width && there.y < height;
            uint cost = inside ? uint(bitCount(signs ^ census_b[there.y * width + there.x])) : OUTSIDE;
            if (step > 0) {
                uint at = before + uint(l);
                uint best = min(costs[at], least + large_step);
                if (offset.x > 0) {
                    best = min(best, costs[at - 1u] + small_step);
                }
                if (offset.x + 1 < side) {
                    best = min(best, costs[at + 1u] + small_step);
                }
                if (offset.y > 0) {
                    best = min(best, costs[at - uint(side)] + small_step);
                }
                if (offset.y + 1 < side) {
                    best = min(best, costs[at + uint(side)] + small_step);
                }
                cost += best - least;
            }
            costs[base + uint(l)] = cost;
            own_least = min(own_least, cost);
            int to = pixel * labels + l;
            volume[to] = (path == 0u ? 0u : volume[to]) + cost;
        }
        least_of[now * LANES + lane] = own_least;
        barrier();
    }
}
