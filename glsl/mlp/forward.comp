#version 460
// Evaluates one layer. Each invocation computes 8 features of 8 rows, so that each loaded value is
// used in eight products. A plane holds one feature of all rows, as `stride4` vectors of four rows
// each.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer Parameters { float parameters[]; };
layout(std430, binding = 1) buffer Activations { vec4 activations[]; };

layout(push_constant) uniform Params {
    uint stride4;        // rows / 4; even
    uint inputs;
    uint outputs;
    uint encoded;        // number of leading inputs that are encodings, from plane 0 on
    uint source;         // first plane of the other inputs
    uint target;         // first plane of the outputs
    uint weights_at;
    uint relu;
};

#include "common/grid.glsl"
#include "mlp/shared.glsl"

vec4 weights(uvec4 rows, uint own, uint k) {
    vec4 four;
    if (SHARED) {
        four = all_four(parameters[own + k]);
    } else {
        four = vec4(parameters[rows.x + k], parameters[rows.y + k], parameters[rows.z + k],
                    parameters[rows.w + k]);
    }
    return four;
}

void accumulate(uint first, uint count, uint plane, uint row4, uint o, inout mat4 c00, inout mat4 c10,
                inout mat4 c01, inout mat4 c11) {
    // Indices beyond the last feature are clamped to it. Their results are not stored.
    uvec4 low = weights_at + first + min(uvec4(o, o + 1u, o + 2u, o + 3u), uvec4(outputs - 1u)) * inputs;
    uvec4 high = weights_at + first
        + min(uvec4(o + 4u, o + 5u, o + 6u, o + 7u), uvec4(outputs - 1u)) * inputs;
    uint own_low = own_of(low), own_high = own_of(high);
    uint at = plane * stride4 + row4;
    for (uint k = 0u; k < count; k++) {
        vec4 x0 = activations[at];
        vec4 x1 = activations[at + 1u];
        vec4 w0 = weights(low, own_low, k);
        vec4 w1 = weights(high, own_high, k);
        c00 += outerProduct(x0, w0);
        c10 += outerProduct(x1, w0);
        c01 += outerProduct(x0, w1);
        c11 += outerProduct(x1, w1);
        at += stride4;
    }
}

void store(mat4 low, mat4 high, uint row4, uint o) {
    for (uint j = 0u; j < 4u; j++) {
        if (o + j < outputs) {
            float bias = parameters[weights_at + inputs * outputs + o + j];
            vec4 a = low[j] + bias;
            vec4 b = high[j] + bias;
            uint at = (target + o + j) * stride4 + row4;
            activations[at] = relu != 0u ? max(a, 0.0) : a;
            activations[at + 1u] = relu != 0u ? max(b, 0.0) : b;
        }
    }
}

void main() {
    uint tiles = stride4 / 2u;
    uint i = shared_index();
    uint row4 = i % tiles * 2u;
    uint o = i / tiles * 8u;
    if (o >= outputs) {
        return;
    }
    mat4 c00 = mat4(0.0), c10 = mat4(0.0), c01 = mat4(0.0), c11 = mat4(0.0);
    accumulate(0u, encoded, 0u, row4, o, c00, c10, c01, c11);
    accumulate(encoded, inputs - encoded, source, row4, o, c00, c10, c01, c11);
    store(c00, c10, row4, o);
    store(c01, c11, row4, o + 4u);
}
