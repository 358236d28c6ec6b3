#version 460
// Gradients of the blended image to every splat, one slot of partial sums per (splat, tile).
//
// The pixels replay their splats front to back from full transmittance; what still lies behind is
// the known total less what went before, so the transmittance is never divided out. With
// v = alpha · dL/dalpha, a slot holds the moments of v over the tile in whitened offsets (v, v·h, v·k,
// v·h², v·h·k, v·k²), from which raster/gather makes the gradients of opacity, mean and covariance,
// then the gradients of colour and depth.
//
// Subgroups share the splats of a batch: each sums over its own block, and the sums meet in shared
// memory in a fixed order. There are no atomics on floats, so reruns give the same bits.
#extension GL_GOOGLE_include_directive : require
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_ballot : require
#extension GL_KHR_shader_subgroup_arithmetic : require
#extension GL_KHR_shader_subgroup_shuffle : require

layout(local_size_x = 32) in;

layout(std430, binding = 0) readonly buffer Ranges { uvec2 ranges[]; };
layout(std430, binding = 1) readonly buffer Intersections { uint intersections[]; };
layout(std430, binding = 2) readonly buffer Splats { uint splats[]; };
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
#include "common/tile.glsl"
#include "common/quads.glsl"

const uint BATCH = 32u;
// Sums of one batch, as in the slots: [subgroup][splat], for subgroups of 4 or more.
shared vec4 partial_a[8u * BATCH];
shared vec4 partial_b[8u * BATCH];
shared vec2 partial_c[8u * BATCH];
shared uint furthest;

// The sum over the subgroup, on every lane: pairs, pairs of pairs, and so on. Software devices
// shuffle all lanes at once, but go through them one by one for subgroupAdd.
#define SUBGROUP_SUM(x)                                                                            \
    for (uint mask = 1u; mask < chunk; mask *= 2u) {                                               \
        x += subgroupShuffleXor(x, mask);                                                          \
    }

void main() {
    uvec2 size = uvec2(width, height);
    uvec2 grid = tile_grid(size);
    uint tile = group_index();
    if (tile >= grid.x * grid.y) {
        return;
    }
    uint id = lane_index();
    uvec2 origin = tile_origin(tile, grid) + quads_origin(id);
    vec2 corner = vec2(origin) + 0.5;
    vec2 lowest, highest;
    subgroup_block(corner, lowest, highest);

    vec4 transmittance[QUADS];
    // Of the loss: by colour, by alpha and by depth at the quad's pixels.
    vec4 red[QUADS], green[QUADS], blue[QUADS], opaque[QUADS], z[QUADS];
    // What lies behind the splats replayed so far, weighted with those gradients.
    vec4 behind[QUADS];
    uvec4 end[QUADS];
    uint own_last = 0u;
    for (uint q = 0u; q < QUADS; q++) {
        uvec2 quad = origin + uvec2(2u * q, 0u);
        bvec4 inside = quad_inside(quad, size);
        transmittance[q] = vec4(1.0);
        red[q] = vec4(0.0);
        green[q] = vec4(0.0);
        blue[q] = vec4(0.0);
        opaque[q] = vec4(0.0);
        z[q] = vec4(0.0);
        behind[q] = vec4(0.0);
        end[q] = uvec4(0u);
        for (uint k = 0u; k < 4u; k++) {
            if (inside[k]) {
                uint pixel = quad_pixel(quad, k, width);
                vec4 gradient = rgba_gradient[pixel];
                red[q][k] = gradient.r;
                green[q][k] = gradient.g;
                blue[q][k] = gradient.b;
                opaque[q][k] = gradient.a;
                z[q][k] = depth_gradient[pixel];
                behind[q][k] = dot(gradient, rgba[pixel]) + z[q][k] * depth[pixel];
                end[q][k] = last[pixel];
                own_last = max(own_last, end[q][k]);
            }
        }
    }
    uvec2 range = ranges[tile];
    uint own_end = subgroupMax(own_last);
    if (id == 0u) {
        furthest = 0u;
    }
    barrier();
    if (gl_SubgroupInvocationID == 0u) {
        atomicMax(furthest, own_end);
    }
    barrier();
    uint stop = range.x + furthest;
    uint words = (gl_SubgroupSize + 31u) / 32u;
    uint chunk = min(gl_SubgroupSize, BATCH);

    for (uint batch = range.x; batch < stop; batch += BATCH) {
        for (uint base = 0u; base < BATCH; base += chunk) {
            uint offset = base + gl_SubgroupInvocationID;
            uint at = batch + offset;
            vec4 mean = vec4(0.0), conic = vec4(0.0), colour = vec4(0.0);
            bool reaches = false;
            if (gl_SubgroupInvocationID < chunk && at < range.x + own_end) {
                uint splat = splats[intersections[at]];
                mean = means[splat];
                conic = conics[splat];
                reaches = least_power(mean.xy, conic.xyz, lowest, highest) <= conic.w;
                if (reaches) {
                    colour = colours[splat];
                }
            }
            vec4 sums_a = vec4(0.0), sums_b = vec4(0.0);
            vec2 sums_c = vec2(0.0);
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
                    uvec4 index = uvec4(batch - range.x + base + lane);
                    vec4 raw[QUADS], h[QUADS], k[QUADS];
                    bvec4 counts[QUADS];
                    bool any_counts = false;
                    for (uint q = 0u; q < QUADS; q++) {
                        vec2 first = corner + vec2(2.0 * float(q), 0.0);
                        vec4 power = quad_power(m.xy, c, first, h[q], k[q]);
                        raw[q] = m.w * exp(-power);
                        for (int i = 0; i < 4; i++) {
                            counts[q][i] = index[i] < end[q][i] && power[i] >= 0.0
                                           && min(raw[q][i], alpha_cap) >= alpha_cut;
                        }
                        any_counts = any_counts || any(counts[q]);
                    }
                    if (!subgroup_any(any_counts)) {
                        continue;
                    }
                    vec4 a = vec4(0.0), b = vec4(0.0);
                    vec2 d = vec2(0.0);
                    for (uint q = 0u; q < QUADS; q++) {
                        vec4 alpha = min(raw[q], vec4(alpha_cap));
                        bvec4 below_cap;
                        for (int i = 0; i < 4; i++) {
                            below_cap[i] = counts[q][i] && raw[q][i] <= alpha_cap;
                        }
                        vec4 weight = mix(vec4(0.0), alpha * transmittance[q], counts[q]);
                        vec4 value = red[q] * rgb.r + green[q] * rgb.g + blue[q] * rgb.b + opaque[q]
                                     + z[q] * m.z;
                        behind[q] -= weight * value;
                        vec4 through = 1.0 - alpha;
                        vec4 v = alpha * (transmittance[q] * value - behind[q] / through);
                        v = mix(vec4(0.0), v, below_cap);
                        transmittance[q] = mix(transmittance[q], transmittance[q] * through,
                                               counts[q]);
                        vec4 vh = v * h[q], vk = v * k[q];
                        const vec4 one = vec4(1.0);
                        a += vec4(dot(v, one), dot(vh, one), dot(vk, one), dot(vh, h[q]));
                        b += vec4(dot(vh, k[q]), dot(vk, k[q]), dot(weight, red[q]),
                                  dot(weight, green[q]));
                        d += vec2(dot(weight, blue[q]), dot(weight, z[q]));
                    }
                    SUBGROUP_SUM(a)
                    SUBGROUP_SUM(b)
                    SUBGROUP_SUM(d)
                    if (gl_SubgroupInvocationID == lane) {
                        sums_a = a;
                        sums_b = b;
                        sums_c = d;
                    }
                }
            }
            if (gl_SubgroupInvocationID < chunk) {
                uint to = gl_SubgroupID * BATCH + offset;
                partial_a[to] = sums_a;
                partial_b[to] = sums_b;
                partial_c[to] = sums_c;
            }
        }
        barrier();
        if (id < BATCH && batch + id < range.y) {
            vec4 a = vec4(0.0), b = vec4(0.0);
            vec2 c = vec2(0.0);
            for (uint group = 0u; group < gl_NumSubgroups; group++) {
                uint from = group * BATCH + id;
                a += partial_a[from];
                b += partial_b[from];
                c += partial_c[from];
            }
            uint slot = intersections[batch + id];
            slots_a[slot] = a;
            slots_b[slot] = b;
            slots_c[slot] = c;
        }
        barrier();
    }
    // Splats behind the last one blended get nothing, but their slots are read.
    uint done = range.x + (stop - range.x + BATCH - 1u) / BATCH * BATCH;
    for (uint at = done + id; at < range.y; at += 32u) {
        uint slot = intersections[at];
        slots_a[slot] = vec4(0.0);
        slots_b[slot] = vec4(0.0);
        slots_c[slot] = vec2(0.0);
    }
}
