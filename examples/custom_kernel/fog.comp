#version 460
// Exponential fog over a rendered image: premultiplied colour is blended towards the fog's colour with the
// expected depth of the pixel, and the uncovered rest of the pixel is fog.

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer Rgba { vec4 rgba[]; };
layout(std430, binding = 1) readonly buffer Depth { float depth[]; };
layout(std430, binding = 2) writeonly buffer Fogged { vec4 fogged[]; };

layout(push_constant) uniform Params {
    uint count;
    float density;
    float red;
    float green;
    float blue;
};

void main() {
    uint i = (gl_WorkGroupID.y * gl_NumWorkGroups.x + gl_WorkGroupID.x) * 64u
        + gl_LocalInvocationIndex;
    if (i >= count) {
        return;
    }
    vec4 c = rgba[i];
    // `depth` is the sum of alpha * T * z: divided by alpha it is the expected depth.
    float z = c.a > 0.0 ? depth[i] / c.a : 0.0;
    float clear = exp(-density * z);
    fogged[i] = vec4(c.rgb * clear + vec3(red, green, blue) * (1.0 - c.a * clear), 1.0);
}
