#version 460
// Confidence of each pixel's flow, in [0, 1]: the product of the agreement of the two directions
// and the agreement of the two images over a 5×5 window. The mean difference of the images in the
// window is subtracted.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 16, local_size_y = 4) in;

layout(std430, binding = 0) readonly buffer LumaA { float luma_a[]; };
layout(std430, binding = 1) readonly buffer LumaB { float luma_b[]; };
layout(std430, binding = 2) readonly buffer Forward { vec2 forward[]; };
layout(std430, binding = 3) readonly buffer Backward { vec2 backward[]; };
layout(std430, binding = 4) writeonly buffer Confidence { float confidence[]; };

layout(push_constant) uniform Params {
    int width;
    int height;
};

#include "flow/sample.glsl"
#include "flow/miss.glsl"

void main() {
    ivec2 p = ivec2(gl_GlobalInvocationID.xy);
    if (p.x >= width || p.y >= height) {
        return;
    }
    int at = p.y * width + p.x;
    float m = miss(vec2(p), forward[at]);
    if (m < 0.0) {
        confidence[at] = 0.0;
        return;
    }
    ivec2 low = max(p - 2, ivec2(0)), high = min(p + 3, ivec2(width, height));
    float sum = 0.0, square = 0.0, mean = 0.0, power = 0.0;
    // The centre's value is subtracted to keep the squares small.
    float centre = luma_a[at];
    for (int y = low.y; y < high.y; y++) {
        for (int x = low.x; x < high.x; x++) {
            int q = y * width + x;
            Taps t = taps(vec2(x, y) + forward[q], ivec2(width, height));
            vec4 v = vec4(luma_b[t.at.x], luma_b[t.at.y], luma_b[t.at.z], luma_b[t.at.w]);
            float own = luma_a[q];
            float d = blend(v, t.part) - own;
            sum += d;
            square += d * d;
            mean += own - centre;
            power += (own - centre) * (own - centre);
        }
    }
    vec2 size = vec2(high - low);
    float n = size.x * size.y;
    float residual = max((square - sum * sum / n) / n, 0.0);
    float contrast = max((power - mean * mean / n) / n, 0.0);
    // The residual is divided by the window's own contrast plus a noise floor.
    confidence[at] = exp(-m - residual / (0.5 * contrast + 4e-4));
}
