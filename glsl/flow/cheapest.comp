#version 460
// Selects the displacement of lowest cost for each pixel. Among equal costs the shortest
// displacement is selected, and among equally short ones the first.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer Volume { uint volume[]; };
layout(std430, binding = 1) writeonly buffer Flow { vec2 flow[]; };

layout(push_constant) uniform Params {
    uint count;
    int radius;
};

#include "common/grid.glsl"

void main() {
    uint pixel = group_index() * 64u + gl_LocalInvocationIndex;
    if (pixel >= count) {
        return;
    }
    int side = 2 * radius + 1;
    uint at = pixel * uint(side * side);
    uint least = 0xffffffffu;
    int shortest = 0;
    ivec2 best = ivec2(0);
    for (int v = -radius; v <= radius; v++) {
        for (int u = -radius; u <= radius; u++) {
            uint cost = volume[at];
            int length_squared = u * u + v * v;
            if (cost < least || (cost == least && length_squared < shortest)) {
                least = cost;
                shortest = length_squared;
                best = ivec2(u, v);
            }
            at++;
        }
    }
    flow[pixel] = vec2(best);
}
