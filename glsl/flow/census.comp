#version 460
// Census transform: one bit for each of the 24 neighbours in a 5×5 window, set if the neighbour is
// brighter than the centre. Pixels at the image's edges are repeated.

layout(local_size_x = 16, local_size_y = 4) in;

layout(std430, binding = 0) readonly buffer Luma { float luma[]; };
layout(std430, binding = 1) writeonly buffer Census { uint census[]; };

layout(push_constant) uniform Params {
    int width;
    int height;
};

void main() {
    ivec2 p = ivec2(gl_GlobalInvocationID.xy);
    if (p.x >= width || p.y >= height) {
        return;
    }
    float centre = luma[p.y * width + p.x];
    uint bits = 0u, n = 0u;
    for (int j = -2; j <= 2; j++) {
        int row = clamp(p.y + j, 0, height - 1) * width;
        for (int i = -2; i <= 2; i++) {
            if (i == 0 && j == 0) {
                continue;
            }
            bits |= uint(luma[row + clamp(p.x + i, 0, width - 1)] > centre) << n;
            n++;
        }
    }
    census[p.y * width + p.x] = bits;
}
