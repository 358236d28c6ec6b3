#version 460
// Each patch selects the best of its candidates (the start flow with its slope, the start flow
// without it, zero motion, the guess) and refines it.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 8, local_size_y = 4) in;

layout(std430, binding = 0) readonly buffer LumaA { float luma_a[]; };
layout(std430, binding = 1) readonly buffer LumaB { float luma_b[]; };
layout(std430, binding = 2) readonly buffer DerivativesA { float derivatives_a[]; };
layout(std430, binding = 3) readonly buffer Start { vec2 start[]; };
layout(std430, binding = 4) readonly buffer Guess { vec2 guess[]; };
// Two vectors per patch: flow, shift, cost; slope.
layout(std430, binding = 5) writeonly buffer Patches { vec4 patches[]; };

layout(push_constant) uniform Params {
    int width;
    int height;
    uint search_steps;
    float noise;
    int guess_width;    // 0 without a guess
    int guess_height;
    float guess_scale;  // pixels of the guess per pixel of this level
};

#include "flow/sample.glsl"
#include "flow/patch.glsl"
#include "flow/descend.glsl"

// Slopes are clamped to this. Where the start flow is steeper, it has an edge instead of a slope.
const float STEEPEST = 0.5;
// Largest displacement of a valid guess, in pixels of the full image. A larger guess is ignored.
const float FARTHEST = 16384.0;

vec2 start_at(vec2 point) {
    Taps t = taps(point, ivec2(width, height));
    return blend(start[t.at.x], start[t.at.y], start[t.at.z], start[t.at.w], t.part);
}

void main() {
    ivec2 id = ivec2(gl_GlobalInvocationID.xy);
    ivec2 grid = patch_grid();
    if (any(greaterThanEqual(id, grid))) {
        return;
    }
    vec2 centre = patch_centre(id);
    float r = float(PATCH / 2);
    vec2 by_x = (start_at(centre + vec2(r, 0.0)) - start_at(centre - vec2(r, 0.0))) / float(PATCH);
    vec2 by_y = (start_at(centre + vec2(0.0, r)) - start_at(centre - vec2(0.0, r))) / float(PATCH);
    vec4 slope = clamp(vec4(by_x.x, by_y.x, by_x.y, by_y.y), -STEEPEST, STEEPEST);
    Patch candidates[4];
    candidates[0] = Patch(start_at(centre), slope, 0.0, 0.0);
    candidates[1] = Patch(candidates[0].flow, vec4(0.0), 0.0, 0.0);
    candidates[2] = Patch(vec2(0.0), vec4(0.0), 0.0, 0.0);
    int count = 3;
    if (guess_width > 0) {
        Taps t = taps((centre + 0.5) * guess_scale - 0.5, ivec2(guess_width, guess_height));
        vec2 f = blend(guess[t.at.x], guess[t.at.y], guess[t.at.z], guess[t.at.w], t.part);
        // The test is also false for NaN.
        if (all(lessThanEqual(abs(f), vec2(FARTHEST)))) {
            candidates[3] = Patch(f / guess_scale, vec4(0.0), 0.0, 0.0);
            count = 4;
        }
    }
    Patch best = candidates[0];
    best.cost = patch_cost(id, best);
    for (int k = 1; k < count; k++) {
        float cost = patch_cost(id, candidates[k]);
        if (cost < best.cost * HYSTERESIS) {
            best = candidates[k];
            best.cost = cost;
        }
    }
    best = descend(id, best);
    int to = 2 * (id.y * grid.x + id.x);
    patches[to] = vec4(best.flow, best.shift, best.cost);
    patches[to + 1] = best.slope;
}
