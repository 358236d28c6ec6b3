#version 460
// Sums a visible splat's slots in order and converts the moments to gradients.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer VisibleCount { uint visible_count[]; };
layout(std430, binding = 1) readonly buffer SplatFromRank { uint splat_from_rank[]; };
layout(std430, binding = 2) readonly buffer Counts { uint counts[]; };
layout(std430, binding = 3) readonly buffer EmittedFromRank { uint emitted_from_rank[]; };
layout(std430, binding = 4) readonly buffer SlotsA { vec4 slots_a[]; };
layout(std430, binding = 5) readonly buffer SlotsB { vec4 slots_b[]; };
layout(std430, binding = 6) readonly buffer SlotsC { vec2 slots_c[]; };
layout(std430, binding = 7) readonly buffer Means { vec4 means[]; };
layout(std430, binding = 8) readonly buffer Conics { vec4 conics[]; };
// Gradients with respect to mean x, mean y (pixels), depth, opacity.
layout(std430, binding = 9) writeonly buffer MeanGradients { vec4 mean_gradients[]; };
// Gradients with respect to the whitened covariance: xx, xy, yy.
layout(std430, binding = 10) writeonly buffer CovarianceGradients { vec4 covariance_gradients[]; };
layout(std430, binding = 11) writeonly buffer ColourGradients { vec4 colour_gradients[]; };

layout(push_constant) uniform Params {
    uint count;
    uint capacity;
};

layout(constant_id = 0) const bool SPREAD = false;

#include "common/grid.glsl"
#include "common/spread.glsl"

void main() {
    uint rank = spread_group_index() * 64u + gl_LocalInvocationIndex;
    if (rank >= min(count, visible_count[0])) {
        return;
    }
    uint splat = splat_from_rank[rank];
    uint first = min(emitted_from_rank[rank], capacity);
    uint last = min(first + counts[rank], capacity);
    vec4 a = vec4(0.0), b = vec4(0.0);
    vec2 c = vec2(0.0);
    for (uint slot = first; slot < last; slot++) {
        a += slots_a[slot];
        b += slots_b[slot];
        c += slots_c[slot];
    }
    vec4 conic = conics[splat];
    float opacity = means[splat].w;
    vec2 mean = 2.0 * vec2(conic.x * a.y, conic.y * a.y + conic.z * a.z);
    mean_gradients[splat] = vec4(mean, c.y, a.x / opacity);
    covariance_gradients[splat] = vec4(a.w, b.x, b.y, 0.0);
    colour_gradients[splat] = vec4(b.z, b.w, c.x, 0.0);
}
