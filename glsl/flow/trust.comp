#version 460
// Computes the weight of each pixel's data terms from forward–backward agreement.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 16, local_size_y = 4) in;

layout(std430, binding = 0) readonly buffer Forward { vec2 forward[]; };
layout(std430, binding = 1) readonly buffer Backward { vec2 backward[]; };
layout(std430, binding = 2) writeonly buffer Trust { float trust[]; };

layout(push_constant) uniform Params {
    int width;
    int height;
};

#include "flow/sample.glsl"
#include "flow/miss.glsl"

// Smallest weight, used where the two directions disagree or the flow leaves the image.
const float LEAST_TRUST = 0.001;

void main() {
    ivec2 p = ivec2(gl_GlobalInvocationID.xy);
    if (p.x >= width || p.y >= height) {
        return;
    }
    int at = p.y * width + p.x;
    float m = miss(vec2(p), forward[at]);
    trust[at] = m < 0.0 ? LEAST_TRUST : max(1.0 / (1.0 + m * m), LEAST_TRUST);
}
