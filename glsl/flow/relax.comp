#version 460
// Half a sweep of red–black successive over-relaxation: solves the pixels with (x + y) mod 2 =
// colour for their own flow, with the flow of their neighbours held constant.

layout(local_size_x = 16, local_size_y = 4) in;

layout(std430, binding = 0) readonly buffer Matrices { vec4 matrices[]; };
layout(std430, binding = 1) readonly buffer Sides { vec2 sides[]; };
layout(std430, binding = 2) buffer Flow { vec2 flow[]; };

layout(push_constant) uniform Params {
    int width;
    int height;
    uint colour;
    float relaxation;
};

// Weight of the current flow. It keeps the flow of a pixel without texture and without neighbours
// unchanged.
const float HOLD = 1e-9;

void main() {
    ivec2 p = ivec2(gl_GlobalInvocationID.xy);
    p.x = 2 * p.x + int((uint(p.y) + colour) & 1u);
    if (p.x >= width || p.y >= height) {
        return;
    }
    int at = p.y * width + p.x;
    vec4 m = matrices[at];
    vec2 own = flow[at];
    float weight = HOLD;
    vec2 side = sides[at] + HOLD * own;
    // For a missing neighbour the index is that of the pixel itself, and the weight is 0.
    ivec4 other = at + ivec4(p.x > 0 ? -1 : 0, p.x + 1 < width ? 1 : 0,
                             p.y > 0 ? -width : 0, p.y + 1 < height ? width : 0);
    for (int k = 0; k < 4; k++) {
        float pull = other[k] == at ? 0.0 : 0.5 * (m.w + matrices[other[k]].w);
        weight += pull;
        side += pull * flow[other[k]];
    }
    float a = m.x + weight, c = m.z + weight;
    vec2 solved = vec2(c * side.x - m.y * side.y, a * side.y - m.y * side.x) / (a * c - m.y * m.y);
    flow[at] = own + relaxation * (solved - own);
}
