#version 460
// Second pass of SSIM, for one channel. Applies the window along rows, computes the SSIM map and
// its derivatives with respect to the windowed x, x² (equal to that with respect to y²) and x·y,
// and applies the window along rows to these derivatives, since the blur is its own adjoint. Each
// workgroup writes its sum of the weighted map.
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_EXT_scalar_block_layout : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer Windowed { vec4 windowed[]; };
layout(std430, binding = 1) readonly buffer Reference { uint reference[]; };
layout(scalar, binding = 2) writeonly buffer Derivatives { vec3 derivatives[]; };
layout(std430, binding = 3) writeonly buffer Partials { float partials[]; };

layout(push_constant) uniform Params {
    int width;
    int height;
    // Number of pixels in an invocation's run.
    int run;
    // Index in `partials` of the first workgroup's sum.
    int partials_at;
};

#include "common/grid.glsl"
#include "common/ssim.glsl"
#include "common/workgroup_total.glsl"

// The SSIM of one pixel, from the windowed x, y, x² + y² and x·y. `by` receives its derivatives
// with respect to the windowed x, x² and x·y.
float map_of(vec4 means, out vec3 by) {
    float mx = means.x, my = means.y;
    float squares = mx * mx + my * my;
    float a1 = 2.0 * mx * my + C1, a2 = 2.0 * (means.w - mx * my) + C2;
    float b1 = squares + C1, b2 = means.z - squares + C2;
    float map = a1 * a2 / (b1 * b2);
    float by_square = -map / b2;
    float by_product = 2.0 * a1 / (b1 * b2);
    float by_mean = 2.0 * my * a2 / (b1 * b2) - 2.0 * mx * map / b1 - 2.0 * mx * by_square
                    - my * by_product;
    by = vec3(by_mean, by_square, by_product);
    return map;
}

// Processes one run along the row that begins at pixel `row`, and returns its sum of the weighted
// map.
float walk(int row, int first) {
    vec4 means[WINDOW];
    vec3 blurred[WINDOW];
    [[unroll]] for (int k = 0; k < WINDOW; k++) {
        means[k] = vec4(0.0);
        blurred[k] = vec3(0.0);
    }
    float total = 0.0;
    int end = min(first + run, width);
    for (int x = first - 2 * HALF; x < end + 2 * HALF; x++) {
        vec4 value = vec4(0.0);
        if (x >= 0 && x < width) {
            value = windowed[row + x];
        }
        SLIDE(means, value);
        int centre = x - HALF;
        vec3 by = vec3(0.0);
        if (centre >= 0 && centre < width) {
            float weight = unpack(reference[row + centre], 3u);
            float map = map_of(means[0], by);
            by *= weight;
            total += centre >= first && centre < end ? weight * map : 0.0;
        }
        SLIDE(blurred, by);
        int done = centre - HALF;
        if (done >= first) {
            derivatives[row + done] = blurred[0];
        }
    }
    return total;
}

void main() {
    uint group = group_index();
    uint id = gl_LocalInvocationIndex;
    int item = int(group * 64u + id);
    int runs = (width + run - 1) / run;
    int y = item / runs, first = item % runs * run;
    float total = workgroup_total(y < height ? walk(y * width, first) : 0.0);
    if (id == 0u && y < height) {
        partials[partials_at + int(group)] = total;
    }
}
