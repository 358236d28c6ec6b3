#version 460
// Converts an image to 16-bit floats, rounded to nearest, ties to even. packHalf2x16 does not
// guarantee this rounding.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer Rgba { vec4 rgba[]; };
// Red and green, blue and alpha; the first of each pair in the lower half.
layout(std430, binding = 1) writeonly buffer Texels { uvec2 texels[]; };

layout(push_constant) uniform Params {
    uint pixels;
    float red;
    float green;
    float blue;
    float alpha;
};

#include "common/grid.glsl"
#include "common/texel.glsl"

// The bits of the nearest 16-bit float. Values out of range become the largest finite one.
uint half_bits(float value) {
    uint bits = floatBitsToUint(clamp(value, -65504.0, 65504.0));
    uint sign = bits >> 16 & 0x8000u;
    uint magnitude = bits & 0x7fffffffu;
    uint exponent = magnitude >> 23;
    if (exponent >= 113u) {
        uint rebiased = magnitude - (112u << 23);
        return sign | (rebiased + 0xfffu + (rebiased >> 13 & 1u)) >> 13;
    }
    // Below 2^-14 the results are multiples of 2^-24. Values below half of such a step become 0.
    if (exponent < 102u) {
        return sign;
    }
    uint shift = 126u - exponent;
    uint mantissa = magnitude & 0x7fffffu | 0x800000u;
    uint steps = mantissa >> shift;
    uint rest = mantissa & (1u << shift) - 1u;
    uint middle = 1u << shift - 1u;
    bool up = rest > middle || rest == middle && (steps & 1u) == 1u;
    return sign | steps + uint(up);
}

void main() {
    uint p = group_index() * 64u + gl_LocalInvocationIndex;
    if (p >= pixels) {
        return;
    }
    vec4 pixel = over(rgba[p], vec4(red, green, blue, alpha));
    texels[p] = uvec2(
        half_bits(pixel.r) | half_bits(pixel.g) << 16,
        half_bits(pixel.b) | half_bits(pixel.a) << 16);
}
