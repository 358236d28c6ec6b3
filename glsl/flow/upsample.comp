#version 460
// Upsamples a flow to the next finer level: bilinear interpolation, with the displacements doubled.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 16, local_size_y = 4) in;

layout(std430, binding = 0) readonly buffer Coarse { vec2 coarse[]; };
layout(std430, binding = 1) writeonly buffer Flow { vec2 flow[]; };

layout(push_constant) uniform Params {
    int coarse_width;
    int coarse_height;
    int width;
    int height;
};

#include "flow/sample.glsl"

void main() {
    ivec2 p = ivec2(gl_GlobalInvocationID.xy);
    if (p.x >= width || p.y >= height) {
        return;
    }
    Taps t = taps((vec2(p) + 0.5) * 0.5 - 0.5, ivec2(coarse_width, coarse_height));
    flow[p.y * width + p.x] =
        2.0 * blend(coarse[t.at.x], coarse[t.at.y], coarse[t.at.z], coarse[t.at.w], t.part);
}
