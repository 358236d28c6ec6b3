#version 460
// Rec. 709 luma of encoded colours; every channel is clamped to [0, 1], and NaN becomes 0. With
// fewer than three channels, the luma is the first channel.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer Pixels { float pixels[]; };
layout(std430, binding = 1) writeonly buffer Luma { float luma[]; };

layout(push_constant) uniform Params {
    uint count;
    uint channels;
};

#include "common/grid.glsl"

float unit(float v) {
    return v > 0.0 ? min(v, 1.0) : 0.0;
}

void main() {
    uint p = group_index() * 64u + gl_LocalInvocationIndex;
    if (p >= count) {
        return;
    }
    uint at = p * channels;
    float y = unit(pixels[at]);
    if (channels >= 3u) {
        y = 0.2126 * y + 0.7152 * unit(pixels[at + 1u]) + 0.0722 * unit(pixels[at + 2u]);
    }
    luma[p] = y;
}
