#version 460
// Adds to the right-hand sides the differences between neighbouring pixels that the slopes of the flow
// predict, so that smoothness penalises only the rest.

layout(local_size_x = 16, local_size_y = 4) in;

layout(std430, binding = 0) readonly buffer Matrices { vec4 matrices[]; };
layout(std430, binding = 1) readonly buffer Slopes { vec4 slopes[]; };
layout(std430, binding = 2) buffer Sides { vec2 sides[]; };

layout(push_constant) uniform Params {
    int width;
    int height;
};

void main() {
    ivec2 p = ivec2(gl_GlobalInvocationID.xy);
    if (p.x >= width || p.y >= height) {
        return;
    }
    int at = p.y * width + p.x;
    float own = matrices[at].w;
    vec4 slope = slopes[at];
    // The pull of each neighbour, as in `relax`, times the change that the mean slope predicts.
    vec2 predicted = vec2(0.0);
    if (p.x > 0) {
        int other = at - 1;
        predicted += (own + matrices[other].w) * (slope.xz + slopes[other].xz);
    }
    if (p.x + 1 < width) {
        int other = at + 1;
        predicted -= (own + matrices[other].w) * (slope.xz + slopes[other].xz);
    }
    if (p.y > 0) {
        int other = at - width;
        predicted += (own + matrices[other].w) * (slope.yw + slopes[other].yw);
    }
    if (p.y + 1 < height) {
        int other = at + width;
        predicted -= (own + matrices[other].w) * (slope.yw + slopes[other].yw);
    }
    sides[at] += 0.25 * predicted;
}
