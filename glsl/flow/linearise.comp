#version 460
// Sets up the equations of each pixel, linearised about the flow: [a, b; b, c] (u, v) = (r, s) from
// brightness and gradient constancy, and the weight of the pixel's smoothness term.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 16, local_size_y = 4) in;

layout(std430, binding = 0) readonly buffer LumaA { float luma_a[]; };
layout(std430, binding = 1) readonly buffer LumaB { float luma_b[]; };
layout(std430, binding = 2) readonly buffer DerivativesA { float derivatives_a[]; };
layout(std430, binding = 3) readonly buffer DerivativesB { float derivatives_b[]; };
layout(std430, binding = 4) readonly buffer Flow { vec2 flow[]; };
layout(std430, binding = 5) readonly buffer Trust { float trust[]; };
// du/dx, du/dy, dv/dx, dv/dy.
layout(std430, binding = 6) readonly buffer Slopes { vec4 slopes[]; };
// a, b, c, smoothness.
layout(std430, binding = 7) writeonly buffer Matrices { vec4 matrices[]; };
layout(std430, binding = 8) writeonly buffer Sides { vec2 sides[]; };

layout(push_constant) uniform Params {
    int width;
    int height;
    float brightness;
    float gradient;
    float smoothness;
    float edge;
    float noise;
    float kink;
};

#include "flow/sample.glsl"

float robust(float squared) {
    return inversesqrt(squared + kink * kink);
}

vec2 flow_at(ivec2 p) {
    p = clamp(p, ivec2(0), ivec2(width, height) - 1);
    return flow[p.y * width + p.x];
}

vec3 matrix = vec3(0.0);
vec2 side = vec2(0.0);

// Adds the term weight · (f · (du, dv) + change)² to the normal equations.
void add(vec2 f, float change, float weight) {
    matrix += weight * vec3(f.x * f.x, f.x * f.y, f.y * f.y);
    side -= weight * change * f;
}

// The inverse of the squared gradient plus squared noise. It converts a squared residual to a
// squared distance in pixels.
float per_pixel(vec2 f) {
    return 1.0 / (dot(f, f) + noise * noise);
}

void main() {
    ivec2 p = ivec2(gl_GlobalInvocationID.xy);
    if (p.x >= width || p.y >= height) {
        return;
    }
    int at = p.y * width + p.x;
    vec2 f = flow[at];
    vec2 there = vec2(p) + f;
    vec2 g = vec2(derivatives_a[5 * at], derivatives_a[5 * at + 1]);
    if (all(greaterThanEqual(there, vec2(0.0)))
        && all(lessThanEqual(there, vec2(width - 1, height - 1)))) {
        Taps t = taps(there, ivec2(width, height));
        vec4 v = vec4(luma_b[t.at.x], luma_b[t.at.y], luma_b[t.at.z], luma_b[t.at.w]);
        float change = blend(v, t.part) - luma_a[at];
        // Means of the derivatives over both images, and for the first two also their differences.
        float mean[5], change_x = 0.0, change_y = 0.0;
        ivec4 from = 5 * t.at;
        for (int k = 0; k < 5; k++) {
            vec4 d = vec4(derivatives_b[from.x + k], derivatives_b[from.y + k],
                          derivatives_b[from.z + k], derivatives_b[from.w + k]);
            float other = blend(d, t.part), own = derivatives_a[5 * at + k];
            mean[k] = 0.5 * (own + other);
            if (k == 0) {
                change_x = other - own;
            }
            if (k == 1) {
                change_y = other - own;
            }
        }
        vec2 luma_f = vec2(mean[0], mean[1]);
        vec2 x_f = vec2(mean[2], mean[3]), y_f = vec2(mean[3], mean[4]);
        float luma_n = per_pixel(luma_f), x_n = per_pixel(x_f), y_n = per_pixel(y_f);
        add(luma_f, change,
            trust[at] * brightness * robust(luma_n * change * change) * luma_n);
        float both = trust[at] * gradient
                     * robust(x_n * change_x * change_x + y_n * change_y * change_y);
        add(x_f, change_x, both * x_n);
        add(y_f, change_y, both * y_n);
        side += vec2(dot(matrix.xy, f), dot(matrix.yz, f));
    }
    vec2 by_x = 0.5 * (flow_at(p + ivec2(1, 0)) - flow_at(p - ivec2(1, 0)));
    vec2 by_y = 0.5 * (flow_at(p + ivec2(0, 1)) - flow_at(p - ivec2(0, 1)));
    // The differences span one pixel less at the image's edges.
    ivec2 size = ivec2(width, height) - 1;
    vec2 span = 0.5 * vec2(min(p + 1, size) - max(p - 1, ivec2(0)));
    by_x -= span.x * slopes[at].xz;
    by_y -= span.y * slopes[at].yw;
    float variation = dot(by_x, by_x) + dot(by_y, by_y);
    float across = exp(-length(g) / edge) + 0.02;
    matrices[at] = vec4(matrix, smoothness * across * robust(variation));
    sides[at] = side;
}
