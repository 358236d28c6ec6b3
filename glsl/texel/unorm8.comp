#version 460
// Converts an image to eight bits per channel: the nearest of 255 equal steps.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer Rgba { vec4 rgba[]; };
// From the lowest byte up: red or blue, green, blue or red, alpha.
layout(std430, binding = 1) writeonly buffer Texels { uint texels[]; };

layout(push_constant) uniform Params {
    uint pixels;
    uint blue_first;
    float red;
    float green;
    float blue;
    float alpha;
};

#include "common/grid.glsl"
#include "common/texel.glsl"

void main() {
    uint p = group_index() * 64u + gl_LocalInvocationIndex;
    if (p >= pixels) {
        return;
    }
    vec4 pixel = over(rgba[p], vec4(red, green, blue, alpha));
    uvec4 level = uvec4(clamp(pixel, 0.0, 1.0) * 255.0 + 0.5);
    if (blue_first != 0u) {
        level = level.bgra;
    }
    texels[p] = level.r | level.g << 8 | level.b << 16 | level.a << 24;
}
