#version 460
// Computes the next level of the pyramid: the filter (1 3 3 1)/8 along both axes at every second
// pixel. Pixels at the image's edges are repeated.

layout(local_size_x = 16, local_size_y = 4) in;

layout(std430, binding = 0) readonly buffer Luma { float luma[]; };
layout(std430, binding = 1) writeonly buffer Halved { float halved[]; };

layout(push_constant) uniform Params {
    int width;
    int height;
};

const float TAPS[4] = float[](0.125, 0.375, 0.375, 0.125);

void main() {
    ivec2 size = ivec2(width, height);
    ivec2 smaller = (size + 1) / 2;
    ivec2 p = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(p, smaller))) {
        return;
    }
    float sum = 0.0;
    for (int j = 0; j < 4; j++) {
        int row = clamp(2 * p.y + j - 1, 0, height - 1) * width;
        float along = 0.0;
        for (int i = 0; i < 4; i++) {
            along += TAPS[i] * luma[row + clamp(2 * p.x + i - 1, 0, width - 1)];
        }
        sum += TAPS[j] * along;
    }
    halved[p.y * smaller.x + p.x] = sum;
}
