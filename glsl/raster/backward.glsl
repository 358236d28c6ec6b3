// Gradients of the blended image with respect to every splat, as one slot of partial sums per
// (splat, tile). A module that includes this file defines LANES, the number of invocations in a
// workgroup.
//
// Each pixel replays its splats front to back, starting with full transmittance. The contribution
// from behind a splat is the pixel's known total minus the contributions up to the splat, so no
// division recovers the transmittance. With v = alpha · dL/dalpha, a slot holds the moments of v
// over the tile in whitened offsets (h, k): v, v·h, v·k, v·h², v·h·k, v·k². raster/gather computes
// the gradients with respect to opacity, mean and covariance from them. The slot's other values are
// the gradients with respect to colour and depth.
//
// Each lane loads one splat of the batch and keeps its sums. The subgroup replays the splats that
// overlap a block, one at a time. If a tile has several subgroups, each sums over its own blocks,
// and the sums are combined in shared memory in a fixed order. The kernel uses no float atomics, so
// repeated runs give the same bits.
#extension GL_EXT_control_flow_attributes : require
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_ballot : require
#extension GL_KHR_shader_subgroup_shuffle : require

layout(local_size_x = LANES) in;

// Whether a workgroup may have several subgroups, whose sums are combined in shared memory.
layout(constant_id = 1) const bool SEVERAL = true;
layout(constant_id = 2) const bool SPREAD = false;

layout(std430, binding = 0) readonly buffer Ranges { uvec2 ranges[]; };
layout(std430, binding = 1) readonly buffer EmittedFromSorted { uint emitted_from_sorted[]; };
layout(std430, binding = 2) readonly buffer SplatFromEmitted { uint splat_from_emitted[]; };
layout(std430, binding = 3) readonly buffer Means { vec4 means[]; };
layout(std430, binding = 4) readonly buffer Conics { vec4 conics[]; };
layout(std430, binding = 5) readonly buffer Colours { vec4 colours[]; };
layout(std430, binding = 6) readonly buffer Rgba { vec4 rgba[]; };
layout(std430, binding = 7) readonly buffer Depth { float depth[]; };
layout(std430, binding = 8) readonly buffer Last { uint last[]; };
layout(std430, binding = 9) readonly buffer RgbaGradient { vec4 rgba_gradient[]; };
layout(std430, binding = 10) readonly buffer DepthGradient { float depth_gradient[]; };
// v, v·h, v·k, v·h²
layout(std430, binding = 11) writeonly buffer SlotsA { vec4 slots_a[]; };
// v·h·k, v·k², red, green
layout(std430, binding = 12) writeonly buffer SlotsB { vec4 slots_b[]; };
// blue, depth
layout(std430, binding = 13) writeonly buffer SlotsC { vec2 slots_c[]; };

layout(push_constant) uniform Params {
    uint width;
    uint height;
    float alpha_cut;
    float alpha_cap;
};

#include "common/grid.glsl"
#include "common/spread.glsl"
#include "common/tile.glsl"
#include "common/quads.glsl"

// Sums of one batch, laid out as the slots: [subgroup][splat]. The size suffices for subgroups of 4
// or more invocations.
shared vec4 partial_a[LANES / 4 * LANES];
shared vec4 partial_b[LANES / 4 * LANES];
shared vec2 partial_c[LANES / 4 * LANES];
shared uint furthest;

vec2 corner[BLOCKS], lowest[BLOCKS], highest[BLOCKS];
vec4 transmittance[BLOCKS * QUADS];
// Gradients of the loss with respect to colour, alpha (`opaque`) and depth (`z`) at the quads'
// pixels.
vec4 red[BLOCKS * QUADS], green[BLOCKS * QUADS], blue[BLOCKS * QUADS], opaque[BLOCKS * QUADS];
vec4 z[BLOCKS * QUADS];
// Contribution of the splats that are not replayed yet, weighted with those gradients.
vec4 behind[BLOCKS * QUADS];
uvec4 end[BLOCKS * QUADS];
// One past the last splat that a pixel of the block blended, counted from the tile's first.
uint block_end[BLOCKS];
uvec2 size, tile_first;
// The lane's own splat, its index in the tile's list, and its sums so far.
vec4 mean, conic, colour;
uint place;
vec4 sums_a, sums_b;
vec2 sums_c;

void start(uint b) {
    uvec2 origin = tile_first + quads_origin(b);
    corner[b] = vec2(origin) + 0.5;
    subgroup_block(corner[b], lowest[b], highest[b]);
    uint furthest_here = 0u;
    [[unroll]] for (uint q = 0u; q < QUADS; q++) {
        uint i = b * QUADS + q;
        uvec2 quad = origin + uvec2(2u * q, 0u);
        bvec4 inside = quad_inside(quad, size);
        transmittance[i] = vec4(1.0);
        red[i] = vec4(0.0);
        green[i] = vec4(0.0);
        blue[i] = vec4(0.0);
        opaque[i] = vec4(0.0);
        z[i] = vec4(0.0);
        behind[i] = vec4(0.0);
        end[i] = uvec4(0u);
        [[unroll]] for (uint k = 0u; k < 4u; k++) {
            if (inside[k]) {
                uint pixel = quad_pixel(quad, k, width);
                vec4 gradient = rgba_gradient[pixel];
                red[i][k] = gradient.r;
                green[i][k] = gradient.g;
                blue[i][k] = gradient.b;
                opaque[i][k] = gradient.a;
                z[i][k] = depth_gradient[pixel];
                behind[i][k] = dot(gradient, rgba[pixel]) + z[i][k] * depth[pixel];
                end[i][k] = last[pixel];
                furthest_here = max(furthest_here, end[i][k]);
            }
        }
    }
    SUBGROUP_FOLD(furthest_here, max)
    block_end[b] = furthest_here;
}

void replay(uint block) {
    bool reaches = place < block_end[block]
                   && least_power(mean.xy, conic.xyz, lowest[block], highest[block]) <= conic.w;
    uint rest = subgroup_ballot(reaches);
    if (rest == 0u) {
        return;
    }
    do {
        uint lane = uint(findLSB(rest));
        rest &= rest - 1u;
        vec4 m = FROM_LANE(mean, lane);
        vec3 c = FROM_LANE(conic.xyz, lane);
        vec3 rgb = FROM_LANE(colour.xyz, lane);
        uint index = FROM_LANE(place, lane);
        vec4 a = vec4(0.0), b = vec4(0.0);
        vec2 d = vec2(0.0);
        [[unroll]] for (uint q = 0u; q < QUADS; q++) {
            uint i = block * QUADS + q;
            vec4 h, k;
            vec2 first = corner[block] + vec2(2.0 * float(q), 0.0);
            vec4 power = quad_power(m.xy, c, first, h, k);
            vec4 raw = m.w * exp(-power);
            vec4 alpha = min(raw, vec4(alpha_cap));
            bvec4 counts, below_cap;
            [[unroll]] for (int n = 0; n < 4; n++) {
                counts[n] = index < end[i][n] && power[n] >= 0.0
                        && alpha[n] >= alpha_cut;
                below_cap[n] = counts[n] && raw[n] <= alpha_cap;
            }
            vec4 weight = mix(vec4(0.0), alpha * transmittance[i], counts);
            vec4 value = red[i] * rgb.r + green[i] * rgb.g + blue[i] * rgb.b + opaque[i]
                         + z[i] * m.z;
            behind[i] -= weight * value;
            vec4 through = 1.0 - alpha;
            vec4 v = alpha * (transmittance[i] * value - behind[i] / through);
            v = mix(vec4(0.0), v, below_cap);
            transmittance[i] = mix(transmittance[i], transmittance[i] * through, counts);
            vec4 vh = v * h, vk = v * k;
            const vec4 one = vec4(1.0);
            a += vec4(dot(v, one), dot(vh, one), dot(vk, one), dot(vh, h));
            b += vec4(dot(vh, k), dot(vk, k), dot(weight, red[i]), dot(weight, green[i]));
            d += vec2(dot(weight, blue[i]), dot(weight, z[i]));
        }
        SUBGROUP_FOLD(a, added)
        SUBGROUP_FOLD(b, added)
        SUBGROUP_FOLD(d, added)
        if (gl_SubgroupInvocationID == lane) {
            sums_a += a;
            sums_b += b;
            sums_c += d;
        }
    } while (rest != 0u);
}

void main() {
    size = uvec2(width, height);
    uvec2 grid = tile_grid(size);
    uint tile = spread_group_index();
    if (tile >= grid.x * grid.y) {
        return;
    }
    uint id = lane_index();
    tile_first = tile_origin(tile, grid);
    EACH_BLOCK(start)
    uint tile_end = 0u;
    [[unroll]] for (uint b = 0u; b < BLOCKS; b++) {
        tile_end = max(tile_end, block_end[b]);
    }
    uvec2 range = ranges[tile];
    if (SEVERAL) {
        if (id == 0u) {
            furthest = 0u;
        }
        barrier();
        if (gl_SubgroupInvocationID == 0u) {
            atomicMax(furthest, tile_end);
        }
        barrier();
        tile_end = furthest;
    }
    uint stop = range.x + tile_end;
    uint chunk = SEVERAL ? min(gl_SubgroupSize, LANES) : LANES;

    uint batch = range.x;
    do {
        for (uint base = 0u; base < LANES; base += chunk) {
            uint at = batch + base + gl_SubgroupInvocationID;
            bool mine = gl_SubgroupInvocationID < chunk && at < stop;
            place = mine ? at - range.x : 0xffffffffu;
            mean = vec4(0.0);
            conic = vec4(0.0);
            colour = vec4(0.0);
            uint slot = 0u;
            if (mine) {
                slot = emitted_from_sorted[at];
                uint splat = splat_from_emitted[slot];
                mean = means[splat];
                conic = conics[splat];
                colour = colours[splat];
            }
            sums_a = vec4(0.0);
            sums_b = vec4(0.0);
            sums_c = vec2(0.0);
            EACH_BLOCK(replay)
            if (SEVERAL) {
                if (gl_SubgroupInvocationID < chunk) {
                    uint to = gl_SubgroupID * LANES + base + gl_SubgroupInvocationID;
                    partial_a[to] = sums_a;
                    partial_b[to] = sums_b;
                    partial_c[to] = sums_c;
                }
            } else if (mine) {
                slots_a[slot] = sums_a;
                slots_b[slot] = sums_b;
                slots_c[slot] = sums_c;
            }
        }
        if (SEVERAL) {
            barrier();
            if (batch + id < stop) {
                vec4 a = vec4(0.0), b = vec4(0.0);
                vec2 c = vec2(0.0);
                for (uint group = 0u; group < gl_NumSubgroups; group++) {
                    uint from = group * LANES + id;
                    a += partial_a[from];
                    b += partial_b[from];
                    c += partial_c[from];
                }
                uint slot = emitted_from_sorted[batch + id];
                slots_a[slot] = a;
                slots_b[slot] = b;
                slots_c[slot] = c;
            }
            barrier();
        }
        batch += LANES;
    } while (batch < stop);
    // Splats behind the last blended one have zero gradients. Their slots are written because
    // raster/gather reads them.
    for (uint at = stop + id; at < range.y; at += LANES) {
        uint slot = emitted_from_sorted[at];
        slots_a[slot] = vec4(0.0);
        slots_b[slot] = vec4(0.0);
        slots_c[slot] = vec2(0.0);
    }
}
