#version 460
// Projects every Gaussian. Writes mean, depth, opacity, conic, colour and tile rectangle of each
// splat, and the number of tiles that it overlaps, which is 0 for a culled Gaussian.
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_scalar_block_layout : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer CameraBuffer { float camera[]; };
layout(scalar, binding = 1) readonly buffer Positions { vec3 positions[]; };
layout(scalar, binding = 2) readonly buffer LogScales { uvec3 log_scales[]; };
layout(std430, binding = 3) readonly buffer Rotations { uvec4 rotations[]; };
layout(std430, binding = 4) readonly buffer OpacityLogits { uint opacity_logits[]; };
layout(scalar, binding = 5) readonly buffer Sh0Buffer { uvec3 sh0[]; };
layout(scalar, binding = 6) readonly buffer Sh1Buffer { uvec3 sh1[]; };
layout(scalar, binding = 7) readonly buffer Sh2Buffer { uvec3 sh2[]; };
layout(scalar, binding = 8) readonly buffer Sh3Buffer { uvec3 sh3[]; };
// Mean x, mean y, depth, opacity.
layout(std430, binding = 9) writeonly buffer Means { vec4 means[]; };
// Factored conic, and the power at which alpha falls to alpha_cut.
layout(std430, binding = 10) writeonly buffer Conics { vec4 conics[]; };
layout(std430, binding = 11) writeonly buffer Colours { vec4 colours[]; };
// First and one past the last tile, x in the low half of a word and y in the high half.
layout(std430, binding = 12) writeonly buffer Rectangles { uvec2 rectangles[]; };
layout(std430, binding = 13) writeonly buffer TileCounts { uint tile_counts[]; };
layout(std430, binding = 14) writeonly buffer Visible { uint visible[]; };

// Which inputs are stored as 16-bit floats, two to a word, the first in the low half.
layout(constant_id = 0) const bool HALF_SH = false;
layout(constant_id = 1) const bool HALF_SCALES = false;
layout(constant_id = 2) const bool HALF_ROTATIONS = false;
layout(constant_id = 3) const bool HALF_OPACITIES = false;
// Whether bands 1, 2, 3 of the spherical harmonics are evaluated. These are specialisation
// constants because software devices also execute branches that are not taken.
layout(constant_id = 4) const bool BAND1 = true;
layout(constant_id = 5) const bool BAND2 = true;
layout(constant_id = 6) const bool BAND3 = true;

layout(push_constant) uniform Params {
    uint count;
    uint width;
    uint height;
    float near;
    float dilation;
    float alpha_cut;
    float tangent_clamp;
};

#include "common/grid.glsl"
#include "common/camera.glsl"
#include "common/sigmoid.glsl"
#include "common/splat.glsl"
#include "common/tile.glsl"
#include "common/sh.glsl"

// Triple `i` of a buffer of floats or of packed halves. These are macros because GLSL functions
// take no buffers as arguments.
#define HALF_OF(word, at) unpackHalf2x16(word)[(at) & 1u]
#define HALF_AT(words, at) HALF_OF(words[((at) >> 1) / 3u][((at) >> 1) % 3u], at)
#define TRIPLE(half_kept, words, i)                                                       \
    (half_kept ? vec3(HALF_AT(words, 3u * (i)), HALF_AT(words, 3u * (i) + 1u),            \
                      HALF_AT(words, 3u * (i) + 2u))                                      \
               : uintBitsToFloat(words[i]))
#define SH_RGB(band, i) TRIPLE(HALF_SH, band, i)

float opacity_logit_of(uint i) {
    return HALF_OPACITIES ? HALF_OF(opacity_logits[i >> 1], i) : uintBitsToFloat(opacity_logits[i]);
}

// Two quaternions of halves occupy one element of the buffer.
vec4 rotation_of(uint i) {
    if (HALF_ROTATIONS) {
        uvec4 both = rotations[i >> 1];
        uvec2 own = (i & 1u) == 0u ? both.xy : both.zw;
        return vec4(unpackHalf2x16(own.x), unpackHalf2x16(own.y));
    }
    return uintBitsToFloat(rotations[i]);
}

// The colour of Gaussian i in direction d, before clamping, since max() may hide a NaN. `largest`
// receives the largest absolute value of a coefficient.
vec3 colour_of(uint i, vec3 d, out float largest) {
    vec3 sizes = vec3(0.0);
    vec3 coefficient = SH_RGB(sh0, i);
    vec3 colour = vec3(0.5) + SH0 * coefficient;
    sizes = max(sizes, abs(coefficient));
    if (BAND1) {
        float b[3];
        sh_band1(d, b);
        for (uint k = 0u; k < 3u; k++) {
            coefficient = SH_RGB(sh1, 3u * i + k);
            colour += b[k] * coefficient;
            sizes = max(sizes, abs(coefficient));
        }
    }
    if (BAND2) {
        float b[5];
        sh_band2(d, b);
        for (uint k = 0u; k < 5u; k++) {
            coefficient = SH_RGB(sh2, 5u * i + k);
            colour += b[k] * coefficient;
            sizes = max(sizes, abs(coefficient));
        }
    }
    if (BAND3) {
        float b[7];
        sh_band3(d, b);
        for (uint k = 0u; k < 7u; k++) {
            coefficient = SH_RGB(sh3, 7u * i + k);
            colour += b[k] * coefficient;
            sizes = max(sizes, abs(coefficient));
        }
    }
    largest = max(max(sizes.x, sizes.y), sizes.z);
    return colour;
}

// Projects Gaussian i. Returns the number of tiles that the splat overlaps; 0 if it is culled.
uint project(Camera c, uint i) {
    vec2 size = vec2(width, height);
    vec3 position = positions[i];
    vec3 log_scale = TRIPLE(HALF_SCALES, log_scales, i);
    float logit = opacity_logit_of(i);
    vec4 unit;
    float ignored;
    if (!finite(position) || !finite(log_scale) || !finite(logit)
        || !normalised(rotation_of(i), unit, ignored)) {
        return 0u;
    }
    float opacity = sigmoid(logit);
    if (opacity < alpha_cut) {
        return 0u;
    }
    Shape s;
    if (!shape_of(c, size, near, tangent_clamp, dilation, position, log_scale, unit, s)) {
        return 0u;
    }
    vec2 mean = c.focal * s.view.xy / s.view.z + c.principal;
    if (!finite(mean.x) || !finite(mean.y)) {
        return 0u;
    }
    float limit = power_limit(opacity, alpha_cut);
    vec2 extent = s.unit * sqrt(2.0 * limit * s.covariance.xz);
    uvec2 image = uvec2(width, height);
    uvec2 first, last;
    tile_rectangle(mean, extent, image, first, last);
    uint reached = 0u;
    for (uint y = first.y; y < last.y; y++) {
        for (uint x = first.x; x < last.x; x++) {
            reached += reaches_tile(mean, s.conic, limit, uvec2(x, y), image) ? 1u : 0u;
        }
    }
    if (reached == 0u) {
        return 0u;
    }
    vec3 offset = sight(c, position);
    float range = length(offset);
    float largest;
    vec3 colour = colour_of(i, range > 0.0 ? offset / range : vec3(0.0, 0.0, 1.0), largest);
    if (!finite(colour) || largest > LARGEST) {
        return 0u;
    }
    means[i] = vec4(mean, s.view.z, opacity);
    conics[i] = vec4(s.conic, limit);
    colours[i] = vec4(max(colour, vec3(0.0)), 0.0);
    rectangles[i] = uvec2(first.x | (first.y << 16), last.x | (last.y << 16));
    return reached;
}

void main() {
    // Loaded before any branch, where software devices detect that every invocation reads the same
    // values.
    Camera c = load_camera();
    uint i = group_index() * 64u + gl_LocalInvocationIndex;
    if (i >= count) {
        return;
    }
    uint reached = project(c, i);
    tile_counts[i] = reached;
    visible[i] = min(reached, 1u);
}
