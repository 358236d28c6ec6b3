#version 460
// Blends the splats of a tile front to back.
//
// A subgroup works on its own block of the tile: every lane loads one splat of the next batch and
// tests it against the block, and the splats that reach it are broadcast lane by lane. Nothing is
// shared between subgroups, so there is no barrier, and each subgroup leaves when its pixels are
// opaque.
#extension GL_GOOGLE_include_directive : require
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_ballot : require
#extension GL_KHR_shader_subgroup_arithmetic : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer Ranges { uvec2 ranges[]; };
layout(std430, binding = 1) readonly buffer Intersections { uint intersections[]; };
layout(std430, binding = 2) readonly buffer Splats { uint splats[]; };
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

#include "common/grid.glsl"
#include "common/tile.glsl"
#include "common/quads.glsl"

void main() {
    uvec2 size = uvec2(width, height);
    uvec2 grid = tile_grid(size);
    uint tile = group_index();
    if (tile >= grid.x * grid.y) {
        return;
    }
    uvec2 origin = tile_origin(tile, grid) + quad_origin(lane_index());
    vec2 corner = vec2(origin) + 0.5;
    bvec4 inside = quad_inside(origin, size);
    vec2 lowest, highest;
    subgroup_block(origin, lowest, highest);

    vec4 transmittance = vec4(1.0);
    bvec4 open = inside;
    vec4 red = vec4(0.0), green = vec4(0.0), blue = vec4(0.0), z = vec4(0.0);
    uvec4 end = uvec4(0u);

    uvec2 range = ranges[tile];
    uint words = (gl_SubgroupSize + 31u) / 32u;
    for (uint base = range.x; base < range.y; base += gl_SubgroupSize) {
        if (subgroupBallot(any(open)) == uvec4(0u)) {
            break;
        }
        uint at = base + gl_SubgroupInvocationID;
        vec4 mean = vec4(0.0), conic = vec4(0.0), colour = vec4(0.0);
        bool reaches = false;
        if (at < range.y) {
            uint splat = splats[intersections[at]];
            mean = means[splat];
            conic = conics[splat];
            reaches = least_power(mean.xy, conic.xyz, lowest, highest) <= conic.w;
            if (reaches) {
                colour = colours[splat];
            }
        }
        uvec4 ballot = subgroupBallot(reaches);
        for (uint word = 0u; word < words; word++) {
            uint bits = ballot[word];
            while (bits != 0u) {
                uint lane = uint(findLSB(bits));
                bits &= bits - 1u;
                lane += 32u * word;
                vec4 m = subgroupBroadcast(mean, lane);
                vec3 c = subgroupBroadcast(conic.xyz, lane);
                vec3 rgb = subgroupBroadcast(colour.xyz, lane);
                vec4 dx, dy;
                vec4 power = quad_power(m.xy, c, corner, dx, dy);
                vec4 alpha = min(m.w * exp(-power), vec4(alpha_cap));
                vec4 behind = transmittance * (1.0 - alpha);
                bvec4 counts;
                for (int k = 0; k < 4; k++) {
                    counts[k] = open[k] && power[k] >= 0.0 && alpha[k] >= alpha_cut;
                    open[k] = open[k] && !(counts[k] && behind[k] <= transmittance_stop);
                    counts[k] = counts[k] && open[k];
                }
                vec4 weight = mix(vec4(0.0), alpha * transmittance, counts);
                transmittance = mix(transmittance, behind, counts);
                end = mix(end, uvec4(base - range.x + lane + 1u), counts);
                red += weight * rgb.r;
                green += weight * rgb.g;
                blue += weight * rgb.b;
                z += weight * m.z;
            }
        }
    }
    for (uint k = 0u; k < 4u; k++) {
        if (inside[k]) {
            uint pixel = quad_pixel(origin, k, width);
            rgba[pixel] = vec4(red[k], green[k], blue[k], 1.0 - transmittance[k]);
            depth[pixel] = z[k];
            last[pixel] = end[k];
        }
    }
}
