#version 460
// One step of Adam over a flat array of parameters.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer Visible { uint visible[]; };
layout(std430, binding = 1) readonly buffer Gradients { float gradients[]; };
layout(std430, binding = 2) buffer Parameters { float parameters[]; };
layout(std430, binding = 3) buffer First { float first[]; };
layout(std430, binding = 4) buffer Second { float second[]; };

layout(push_constant) uniform Params {
    uint count;
    uint row;          // values of a row, for visibility
    uint masked;       // whether rows of visible 0 stay as they are
    float rate;
    float beta1;
    float beta2;
    float rest1;       // 1 - beta1, formed in f64
    float rest2;       // 1 - beta2
    float unbias1;     // 1 / (1 - beta1^step)
    float unbias2;     // 1 / (1 - beta2^step)
    float epsilon;
};

#include "common/grid.glsl"

// Its square, summed, is still finite: one huge gradient cannot freeze a parameter for ever.
const float LARGEST_GRADIENT = 1e18;

void main() {
    uint i = group_index() * 64u + gl_LocalInvocationIndex;
    if (i >= count || (masked != 0u && visible[i / row] == 0u)) {
        return;
    }
    float g = gradients[i];
    // False for NaN too.
    if (!(abs(g) <= 3.4028234e38)) {
        return;
    }
    g = clamp(g, -LARGEST_GRADIENT, LARGEST_GRADIENT);
    float m = beta1 * first[i] + rest1 * g;
    float v = beta2 * second[i] + rest2 * g * g;
    first[i] = m;
    second[i] = v;
    parameters[i] -= rate * (m * unbias1) / (sqrt(v * unbias2) + epsilon);
}
