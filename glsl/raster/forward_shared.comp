#version 460
// Blends the splats of a tile front to back, as raster/forward does, with a different distribution
// of the work: one invocation per pixel, and batches of splats in shared memory for the whole tile.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 256) in;

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

#include "common/grid.glsl"
#include "common/tile.glsl"

const uint BATCH = 256u;

shared vec4 batch_means[BATCH];
shared vec4 batch_conics[BATCH];
shared vec4 batch_colours[BATCH];
// Number of pixels that still blend, in two alternating counters: one is read while the other is
// cleared.
shared uint open_pixels[2];

void main() {
    uvec2 size = uvec2(width, height);
    uvec2 grid = tile_grid(size);
    uint tile = group_index();
    // The condition is the same for the whole workgroup, so that no invocation misses a barrier.
    if (tile >= grid.x * grid.y) {
        return;
    }
    uint lane = gl_LocalInvocationIndex;
    uvec2 pixel = uvec2(tile % grid.x, tile / grid.x) * TILE + uvec2(lane % TILE, lane / TILE);
    bool inside = pixel.x < width && pixel.y < height;
    bool open = inside;
    vec2 centre = vec2(pixel) + 0.5;
    float transmittance = 1.0, z = 0.0;
    vec3 colour = vec3(0.0);
    uint end = 0u;
    if (lane < 2u) {
        open_pixels[lane] = 0u;
    }
    uvec2 range = ranges[tile];
    uint turn = 0u;
    for (uint base = range.x; base < range.y; base += BATCH) {
        // After this barrier no invocation reads the previous batch.
        barrier();
        if (open) {
            atomicAdd(open_pixels[turn], 1u);
        }
        uint at = base + lane;
        if (at < range.y) {
            uint splat = splat_from_emitted[emitted_from_sorted[at]];
            batch_means[lane] = means[splat];
            batch_conics[lane] = conics[splat];
            batch_colours[lane] = colours[splat];
        }
        barrier();
        if (open_pixels[turn] == 0u) {
            break;
        }
        turn ^= 1u;
        if (lane == 0u) {
            // This counter is incremented only after the next barrier, and was last read before the
            // one above.
            open_pixels[turn] = 0u;
        }
        uint count = min(BATCH, range.y - base);
        for (uint k = 0u; k < count && open; k++) {
            vec4 mean = batch_means[k];
            vec3 conic = batch_conics[k].xyz;
            vec2 d = centre - mean.xy;
            float power = power_at(conic, d);
            float alpha = min(mean.w * exp(-power), alpha_cap);
            if (!(power >= 0.0) || !(alpha >= alpha_cut)) {
                continue;
            }
            float behind = transmittance * (1.0 - alpha);
            if (behind <= transmittance_stop) {
                open = false;
                break;
            }
            float weight = alpha * transmittance;
            colour += weight * batch_colours[k].rgb;
            z += weight * mean.z;
            transmittance = behind;
            end = base - range.x + k + 1u;
        }
    }
    if (inside) {
        uint i = pixel.y * width + pixel.x;
        rgba[i] = vec4(colour, 1.0 - transmittance);
        depth[i] = z;
        last[i] = end;
    }
}
