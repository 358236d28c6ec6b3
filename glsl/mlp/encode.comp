#version 460
// Positional encodings of every (control point, time): the network's input, one plane per feature.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer Nodes { float nodes[]; };
layout(std430, binding = 1) readonly buffer Times { float times[]; };
layout(std430, binding = 2) writeonly buffer Activations { vec4 activations[]; };

layout(push_constant) uniform Params {
    uint node_count;
    uint rows;
    uint stride;
    uint position_frequencies;
    uint time_frequencies;
};

#include "common/grid.glsl"

// Sine and cosine to f32's rounding. Vulkan promises sin() only an absolute 2^-11 within [-pi, pi],
// and the encodings reach far beyond. The quadrant's multiple of pi/2 is subtracted in three parts
// (Cody and Waite), good for |x| up to some ten thousand; then Taylor's polynomials.
void sine_cosine(float x, out float s, out float c) {
    float n = round(x * 0.6366197723675814);
    precise float r = x - n * 1.5703125;
    r = r - n * 4.837512969970703e-4;
    r = r - n * 7.549789948768648e-8;
    float z = r * r;
    float sine = r + r * z * (-1.6666666666e-1 + z * (8.3333331e-3 + z * (-1.98412698e-4 + z * 2.75573e-6)));
    float cosine = 1.0 - 0.5 * z
        + z * z * (4.1666668e-2 + z * (-1.38888889e-3 + z * (2.4801587e-5 - z * 2.755732e-7)));
    uint quadrant = uint(int(n)) & 3u;
    bool swapped = (quadrant & 1u) != 0u;
    float a = swapped ? cosine : sine;
    float b = swapped ? sine : cosine;
    s = quadrant >= 2u ? -a : a;
    c = (quadrant == 1u || quadrant == 2u) ? -b : b;
}

void put(uint plane, uint row, float value) {
    activations[(plane * stride + row) / 4u][row % 4u] = value;
}

void main() {
    // One item for the plain values, one for each octave.
    uint items = 1u + max(position_frequencies, time_frequencies);
    uint i = group_index() * 64u + gl_LocalInvocationIndex;
    if (i >= stride * items) {
        return;
    }
    uint row = i % stride;
    uint item = i / stride;
    bool real = row < rows;
    uint node = real ? row % node_count : 0u;
    vec3 p = real ? vec3(nodes[3u * node], nodes[3u * node + 1u], nodes[3u * node + 2u]) : vec3(0.0);
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
            sine_cosine(p[c] * frequency, s, k);
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
