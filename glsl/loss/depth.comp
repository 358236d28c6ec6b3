#version 460
// The depth term: L1 between the rendered mean disparity, alpha / depth, and a known disparity.
// Adds to the gradient with respect to alpha, and writes the gradient with respect to depth and
// each workgroup's weighted sum.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer Rgba { vec4 rgba[]; };
layout(std430, binding = 1) readonly buffer Depth { float depth[]; };
// Disparity and weight per pixel. The weight is 0 where the disparity is unknown.
layout(std430, binding = 2) readonly buffer Target { vec2 known[]; };
layout(std430, binding = 3) buffer RgbaGradient { vec4 rgba_gradient[]; };
layout(std430, binding = 4) writeonly buffer DepthGradient { float depth_gradient[]; };
layout(std430, binding = 5) writeonly buffer Partials { float partials[]; };

layout(push_constant) uniform Params {
    uint pixels;
    // The term's factor, divided by the sum of weights.
    float factor;
    float least_alpha;
};

#include "common/grid.glsl"
#include "common/workgroup_total.glsl"

void main() {
    uint group = group_index();
    uint id = gl_LocalInvocationIndex;
    uint i = group * 64u + id;
    float own = 0.0;
    if (i < pixels) {
        float alpha = rgba[i].a, z = depth[i], by_depth = 0.0;
        float weight = known[i].y;
        if (weight > 0.0 && alpha >= least_alpha && z > 0.0) {
            float disparity = alpha / z;
            float difference = disparity - known[i].x;
            own = weight * abs(difference);
            float g = factor * weight * sign(difference);
            by_depth = -g * disparity / z;
            rgba_gradient[i].a += g / z;
        }
        depth_gradient[i] = by_depth;
    }
    float total = workgroup_total(own);
    if (id == 0u && group * 64u < pixels) {
        partials[group] = total;
    }
}
