#version 460
// The 3×3 median of each component of the flow. Pixels at the image's edges are repeated.

layout(local_size_x = 16, local_size_y = 4) in;

layout(std430, binding = 0) readonly buffer Flow { vec2 flow[]; };
layout(std430, binding = 1) writeonly buffer Filtered { vec2 filtered[]; };

layout(push_constant) uniform Params {
    int width;
    int height;
};

void order(inout vec2 a, inout vec2 b) {
    vec2 low = min(a, b);
    b = max(a, b);
    a = low;
}

void main() {
    ivec2 p = ivec2(gl_GlobalInvocationID.xy);
    if (p.x >= width || p.y >= height) {
        return;
    }
    vec2 v[9];
    for (int j = 0; j < 3; j++) {
        int row = clamp(p.y + j - 1, 0, height - 1) * width;
        for (int i = 0; i < 3; i++) {
            v[3 * j + i] = flow[row + clamp(p.x + i - 1, 0, width - 1)];
        }
        order(v[3 * j], v[3 * j + 1]);
        order(v[3 * j + 1], v[3 * j + 2]);
        order(v[3 * j], v[3 * j + 1]);
    }
    // The median of nine values in three sorted rows is the median of the largest low, the median
    // middle and the smallest high value.
    vec2 low = max(max(v[0], v[3]), v[6]);
    vec2 high = min(min(v[2], v[5]), v[8]);
    vec2 middle = max(min(v[1], v[4]), min(max(v[1], v[4]), v[7]));
    filtered[p.y * width + p.x] = max(min(low, middle), min(max(low, middle), high));
}
