#version 460
// Each patch tries the displacements of eight neighbours, extrapolated with their slopes. If the
// best of them costs less than the patch's own displacement, it is refined and replaces it.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 8, local_size_y = 4) in;

layout(std430, binding = 0) readonly buffer LumaA { float luma_a[]; };
layout(std430, binding = 1) readonly buffer LumaB { float luma_b[]; };
layout(std430, binding = 2) readonly buffer DerivativesA { float derivatives_a[]; };
// Two vectors per patch: flow, shift, cost; slope.
layout(std430, binding = 3) readonly buffer Patches { vec4 patches[]; };
layout(std430, binding = 4) writeonly buffer Spread { vec4 spread[]; };

layout(push_constant) uniform Params {
    int width;
    int height;
    uint search_steps;
    float noise;
    int reach;          // distance of the neighbours, in patches
};

#include "flow/sample.glsl"
#include "flow/patch.glsl"
#include "flow/descend.glsl"

// The four nearer neighbours come first, since a later one replaces them only if it costs less.
const ivec2 NEIGHBOURS[8] = ivec2[](ivec2(-1, 0), ivec2(1, 0), ivec2(0, -1), ivec2(0, 1),
                                    ivec2(-1, -1), ivec2(1, -1), ivec2(-1, 1), ivec2(1, 1));

Patch load(ivec2 id, ivec2 grid) {
    int at = 2 * (id.y * grid.x + id.x);
    vec4 head = patches[at];
    return Patch(head.xy, patches[at + 1], head.z, head.w);
}

// Whether two displacements are so close that refinement of either gives the same result.
bool alike(Patch a, Patch b) {
    const float ALIKE = 0.25; // pixels
    return all(lessThan(abs(a.flow - b.flow), vec2(ALIKE)))
           && all(lessThan(abs(a.slope - b.slope), vec4(ALIKE / float(PATCH))));
}

void main() {
    ivec2 id = ivec2(gl_GlobalInvocationID.xy);
    ivec2 grid = patch_grid();
    if (any(greaterThanEqual(id, grid))) {
        return;
    }
    Patch own = load(id, grid);
    Patch best = own;
    float least = own.cost * HYSTERESIS;
    bool better = false;
    for (int k = 0; k < 8; k++) {
        ivec2 other = id + NEIGHBOURS[k] * reach;
        if (any(lessThan(other, ivec2(0))) || any(greaterThanEqual(other, grid))) {
            continue;
        }
        Patch offered = load(other, grid);
        offered.flow = patch_flow(offered, vec2((id - other) * STRIDE));
        if (alike(offered, own)) {
            continue;
        }
        float cost = patch_cost(id, offered);
        if (cost < least) {
            least = cost;
            best = offered;
            better = true;
        }
    }
    if (better) {
        best = descend(id, best);
    }
    int to = 2 * (id.y * grid.x + id.x);
    spread[to] = vec4(best.flow, best.shift, best.cost);
    spread[to + 1] = best.slope;
}
