#version 460
// Computes the flow of every pixel: the weighted mean over the patches that cover it. A patch's
// weight falls with its squared residual at this pixel and with its own mean squared residual.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 16, local_size_y = 4) in;

layout(std430, binding = 0) readonly buffer LumaA { float luma_a[]; };
layout(std430, binding = 1) readonly buffer LumaB { float luma_b[]; };
layout(std430, binding = 2) readonly buffer Patches { vec4 patches[]; };
layout(std430, binding = 3) writeonly buffer Flow { vec2 flow[]; };

layout(push_constant) uniform Params {
    int width;
    int height;
};

#include "flow/sample.glsl"
#include "flow/patch.glsl"

// Squared residual of about one grey level. Patches with smaller residuals have similar weights.
const float FLOOR = 2e-5;

void main() {
    ivec2 pixel = ivec2(gl_GlobalInvocationID.xy);
    if (pixel.x >= width || pixel.y >= height) {
        return;
    }
    ivec2 grid = patch_grid();
    ivec2 last = min((pixel + OVERHANG) / STRIDE, grid - 1);
    ivec2 first = (max(pixel + OVERHANG + 1 - PATCH, ivec2(0)) + STRIDE - 1) / STRIDE;
    vec2 sum = vec2(0.0);
    float total = 0.0;
    for (int j = first.y; j <= last.y; j++) {
        for (int i = first.x; i <= last.x; i++) {
            int at = 2 * (j * grid.x + i);
            vec4 head = patches[at];
            Patch p = Patch(head.xy, patches[at + 1], head.z, head.w);
            vec2 f = patch_flow(p, vec2(pixel) - patch_centre(ivec2(i, j)));
            float d = residual(pixel, vec2(pixel) + f) - p.shift;
            float weight = 1.0 / (d * d + p.cost + FLOOR);
            sum += weight * f;
            total += weight;
        }
    }
    flow[pixel.y * width + pixel.x] = sum / total;
}
