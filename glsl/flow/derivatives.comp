#version 460
// First derivatives (five-point) and second derivatives (three-point) of each pixel's luminance, in
// the order x, y, xx, xy, yy. Pixels at the image's edges are repeated.

layout(local_size_x = 16, local_size_y = 4) in;

layout(std430, binding = 0) readonly buffer Luma { float luma[]; };
layout(std430, binding = 1) writeonly buffer Derivatives { float derivatives[]; };

layout(push_constant) uniform Params {
    int width;
    int height;
};

float at(ivec2 p) {
    p = clamp(p, ivec2(0), ivec2(width, height) - 1);
    return luma[p.y * width + p.x];
}

float first(float a, float b, float c, float d) {
    return (8.0 * (c - b) - (d - a)) / 12.0;
}

void main() {
    ivec2 p = ivec2(gl_GlobalInvocationID.xy);
    if (p.x >= width || p.y >= height) {
        return;
    }
    float here = at(p);
    float west = at(p - ivec2(1, 0)), east = at(p + ivec2(1, 0));
    float north = at(p - ivec2(0, 1)), south = at(p + ivec2(0, 1));
    int to = 5 * (p.y * width + p.x);
    derivatives[to] = first(at(p - ivec2(2, 0)), west, east, at(p + ivec2(2, 0)));
    derivatives[to + 1] = first(at(p - ivec2(0, 2)), north, south, at(p + ivec2(0, 2)));
    derivatives[to + 2] = east - 2.0 * here + west;
    derivatives[to + 3] =
        0.25 * (at(p + 1) - at(p + ivec2(-1, 1)) - at(p + ivec2(1, -1)) + at(p - 1));
    derivatives[to + 4] = south - 2.0 * here + north;
}
