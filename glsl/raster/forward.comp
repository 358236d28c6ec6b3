#version 460
// Blends the splats of a tile front to back.
//
// A subgroup processes its own block of the tile. Each lane loads one splat of the next batch and
// tests it against the block. The splats that overlap the block are broadcast one by one. Subgroups
// share no data, so there is no barrier, and each subgroup stops when its pixels are opaque.
#extension GL_GOOGLE_include_directive : require
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_ballot : require
#extension GL_KHR_shader_subgroup_shuffle : require

#define LANES 32
layout(local_size_x = LANES) in;

layout(std430, binding = 0) readonly buffer Ranges { uvec2 ranges[]; };
layout(std430, binding = 1) readonly buffer EmittedFromSorted { uint emitted_from_sorted[]; };
layout(std430, binding = 2) readonly buffer SplatFromEmitted { uint splat_from_emitted[]; };
layout(std430, binding = 3) readonly buffer Means { vec4 means[]; };
layout(std430, binding = 4) readonly buffer Conics { vec4 conics[]; };
layout(std430, binding = 5) readonly buffer Colours { vec4 colours[]; };
// Premultiplied colour and alpha.
layout(std430, binding = 6) writeonly buffer Rgba { vec4 rgba[]; };
layout(std430, binding = 7) writeonly buffer Depth { float depth[]; };
// One past the last intersection blended, counted from the tile's first.
layout(std430, binding = 8) writeonly buffer Last { uint last[]; };

layout(push_constant) uniform Params {
    uint width;
    uint height;
    float alpha_cut;
    float alpha_cap;
    float transmittance_stop;
};

layout(constant_id = 1) const bool SPREAD = false;

#include "common/grid.glsl"
#include "common/spread.glsl"
#include "common/tile.glsl"
#include "common/quads.glsl"

void main() {
    uvec2 size = uvec2(width, height);
    uvec2 grid = tile_grid(size);
    uint tile = spread_group_index();
    if (tile >= grid.x * grid.y) {
        return;
    }
    uvec2 origin = tile_origin(tile, grid) + quads_origin(0u);
    vec2 corner = vec2(origin) + 0.5;
    vec2 lowest, highest;
    subgroup_block(corner, lowest, highest);

    vec4 transmittance[QUADS], red[QUADS], green[QUADS], blue[QUADS], z[QUADS];
    bvec4 open[QUADS];
    uvec4 end[QUADS];
    bool any_open = false;
    for (uint q = 0u; q < QUADS; q++) {
        transmittance[q] = vec4(1.0);
        red[q] = vec4(0.0);
        green[q] = vec4(0.0);
        blue[q] = vec4(0.0);
        z[q] = vec4(0.0);
        end[q] = uvec4(0u);
        open[q] = quad_inside(origin + uvec2(2u * q, 0u), size);
        any_open = any_open || any(open[q]);
    }

    uvec2 range = ranges[tile];
    // In a subgroup of 64 invocations only half are active.
    uint chunk = min(gl_SubgroupSize, LANES);
    uint base = range.x;
    // The loops test their condition at the end, because software devices would execute a loop that
    // tests it at the start once more than needed.
    do {
        // Advances to the next batch in which a splat overlaps the block.
        vec4 mean, conic, colour;
        uint first, bits;
        do {
            first = base - range.x;
            uint at = base + gl_SubgroupInvocationID;
            mean = vec4(0.0);
            conic = vec4(0.0);
            colour = vec4(0.0);
            bool reaches = false;
            if (at < range.y) {
                uint splat = splat_from_emitted[emitted_from_sorted[at]];
                mean = means[splat];
                conic = conics[splat];
                reaches = least_power(mean.xy, conic.xyz, lowest, highest) <= conic.w;
                if (reaches) {
                    colour = colours[splat];
                }
            }
            bits = subgroup_ballot(reaches);
            base += chunk;
        } while (bits == 0u && base < range.y);
        if (bits != 0u) {
            do {
                uint lane = uint(findLSB(bits));
                bits &= bits - 1u;
                vec4 m = FROM_LANE(mean, lane);
                vec3 c = FROM_LANE(conic.xyz, lane);
                vec3 rgb = FROM_LANE(colour.xyz, lane);
                any_open = false;
                for (uint q = 0u; q < QUADS; q++) {
                    vec4 across, along;
                    vec2 pixel = corner + vec2(2.0 * float(q), 0.0);
                    vec4 power = quad_power(m.xy, c, pixel, across, along);
                    vec4 alpha = min(m.w * exp(-power), vec4(alpha_cap));
                    vec4 behind = transmittance[q] * (1.0 - alpha);
                    bvec4 counts;
                    for (int k = 0; k < 4; k++) {
                        counts[k] = open[q][k] && power[k] >= 0.0 && alpha[k] >= alpha_cut;
                        open[q][k] =
                            open[q][k] && !(counts[k] && behind[k] <= transmittance_stop);
                        counts[k] = counts[k] && open[q][k];
                    }
                    vec4 weight = mix(vec4(0.0), alpha * transmittance[q], counts);
                    transmittance[q] = mix(transmittance[q], behind, counts);
                    end[q] = mix(end[q], uvec4(first + lane + 1u), counts);
                    red[q] += weight * rgb.r;
                    green[q] += weight * rgb.g;
                    blue[q] += weight * rgb.b;
                    z[q] += weight * m.z;
                    any_open = any_open || any(open[q]);
                }
            } while (bits != 0u);
        }
    } while (base < range.y && subgroup_ballot(any_open) != 0u);
    for (uint q = 0u; q < QUADS; q++) {
        uvec2 quad = origin + uvec2(2u * q, 0u);
        bvec4 inside = quad_inside(quad, size);
        for (uint k = 0u; k < 4u; k++) {
            if (inside[k]) {
                uint pixel = quad_pixel(quad, k, width);
                rgba[pixel] =
                    vec4(red[q][k], green[q][k], blue[q][k], 1.0 - transmittance[q][k]);
                depth[pixel] = z[q][k];
                last[pixel] = end[q][k];
            }
        }
    }
}
