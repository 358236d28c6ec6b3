#version 460
// Propagates the gradient of one layer to the layer below, to the values before its ReLU. Each
// invocation computes 8 features of 8 rows.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer Parameters { float parameters[]; };
layout(std430, binding = 1) readonly buffer Activations { vec4 activations[]; };
layout(std430, binding = 2) buffer Deltas { vec4 deltas[]; };

layout(push_constant) uniform Params {
    uint stride4;     // rows / 4; even
    uint inputs;
    uint outputs;
    uint encoded;     // number of leading inputs that are encodings and get no gradient
    uint activated;   // first plane of the layer below
    uint source;      // first plane of this layer's gradient
    uint target;      // first plane of the layer below's gradient
    uint weights_at;
};

#include "common/grid.glsl"
#include "mlp/shared.glsl"

vec4 weights(uint at) {
    vec4 four;
    if (SHARED) {
        four = all_four(parameters[at + own_of(uvec4(0u, 1u, 2u, 3u))]);
    } else {
        four = vec4(parameters[at], parameters[at + 1u], parameters[at + 2u], parameters[at + 3u]);
    }
    return four;
}

void store(mat4 low, mat4 high, uint row4, uint k) {
    for (uint j = 0u; j < 4u; j++) {
        uint from = (activated + k + j) * stride4 + row4;
        uint to = (target + k + j) * stride4 + row4;
        deltas[to] = mix(vec4(0.0), low[j], greaterThan(activations[from], vec4(0.0)));
        deltas[to + 1u] = mix(vec4(0.0), high[j], greaterThan(activations[from + 1u], vec4(0.0)));
    }
}

void main() {
    // The width of the layer below is a multiple of 16.
    uint width = inputs - encoded;
    uint tiles = stride4 / 2u;
    uint i = shared_index();
    uint row4 = i % tiles * 2u;
    uint k = i / tiles * 8u;
    if (k >= width) {
        return;
    }
    mat4 c00 = mat4(0.0), c10 = mat4(0.0), c01 = mat4(0.0), c11 = mat4(0.0);
    uint from = source * stride4 + row4;
    uint w = weights_at + encoded + k;
    for (uint o = 0u; o < outputs; o++) {
        vec4 d0 = deltas[from];
        vec4 d1 = deltas[from + 1u];
        vec4 w0 = weights(w);
        vec4 w1 = weights(w + 4u);
        c00 += outerProduct(d0, w0);
        c10 += outerProduct(d1, w0);
        c01 += outerProduct(d0, w1);
        c11 += outerProduct(d1, w1);
        from += stride4;
        w += inputs;
    }
    store(c00, c10, row4, k);
    store(c01, c11, row4, k + 4u);
}
