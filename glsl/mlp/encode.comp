#version 460
// Computes the positional encodings of every (control point, time): the network's input, one plane
// per feature.
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_scalar_block_layout : require

layout(local_size_x = 64) in;

layout(scalar, binding = 0) readonly buffer Nodes { vec3 nodes[]; };
layout(std430, binding = 1) readonly buffer Times { float times[]; };
layout(std430, binding = 2) writeonly buffer Activations { vec4 activations[]; };

layout(push_constant) uniform Params {
    uint node_count;
    uint rows;
    uint stride;
    uint position_frequencies;
    uint time_frequencies;
    float position_lowest;
};

#include "common/grid.glsl"
#include "common/sine.glsl"

void put(uint plane, uint row, float value) {
    activations[(plane * stride + row) / 4u][row % 4u] = value;
}

void main() {
    // One item for the unencoded values, and one for each octave.
    uint items = 1u + max(position_frequencies, time_frequencies);
    uint i = group_index() * 64u + gl_LocalInvocationIndex;
    if (i >= stride * items) {
        return;
    }
    uint row = i % stride;
    uint item = i / stride;
    bool real = row < rows;
    uint node = real ? row % node_count : 0u;
    vec3 p = real ? nodes[node] : vec3(0.0);
    float t = real ? times[row / node_count] : 0.0;
    uint time_plane = 3u + 6u * position_frequencies;
    if (item == 0u) {
        for (uint c = 0u; c < 3u; c++) {
            put(c, row, p[c]);
        }
        put(time_plane, row, t);
        return;
    }
    uint octave = item - 1u;
    float frequency = exp2(float(octave));
    if (octave < position_frequencies) {
        for (uint c = 0u; c < 3u; c++) {
            float s, k;
            sine_cosine(p[c] * (position_lowest * frequency), s, k);
            uint plane = 3u + 6u * octave + c;
            put(plane, row, s);
            put(plane + 3u, row, k);
        }
    }
    if (octave < time_frequencies) {
        float s, k;
        sine_cosine(t * frequency, s, k);
        uint plane = time_plane + 1u + 2u * octave;
        put(plane, row, s);
        put(plane + 1u, row, k);
    }
}
