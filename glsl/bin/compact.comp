#version 460
// Lists the visible splats with their depth as sort key. Positive floats have the same order as
// their bits.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer Visible { uint visible[]; };
layout(std430, binding = 1) readonly buffer VisibleFromSplat { uint visible_from_splat[]; };
layout(std430, binding = 2) readonly buffer Means { vec4 means[]; };
layout(std430, binding = 3) writeonly buffer Keys { uint keys[]; };
layout(std430, binding = 4) writeonly buffer SplatFromVisible { uint splat_from_visible[]; };

layout(push_constant) uniform Params { uint count; };

#include "common/grid.glsl"

void main() {
    uint i = group_index() * 64u + gl_LocalInvocationIndex;
    if (i < count && visible[i] != 0u) {
        keys[visible_from_splat[i]] = floatBitsToUint(means[i].z);
        splat_from_visible[visible_from_splat[i]] = i;
    }
}
