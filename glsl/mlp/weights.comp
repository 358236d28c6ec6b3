#version 460
// Gradients of one layer's weights and biases over one segment of the rows. Each invocation
// computes 8 outputs × 8 inputs. The bias is the weight of an additional input that is always 1.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer Activations { vec4 activations[]; };
layout(std430, binding = 1) readonly buffer Deltas { vec4 deltas[]; };
layout(std430, binding = 2) writeonly buffer Partials { float partials[]; };

layout(push_constant) uniform Params {
    uint stride4;
    uint inputs;
    uint outputs;
    uint encoded;
    uint source;      // first plane of the inputs that are not encoded
    uint delta;       // first plane of the layer's gradient
    uint segment4;    // number of vectors of four rows in a segment
};

#include "common/grid.glsl"
#include "mlp/shared.glsl"

uint plane_of(uint k) {
    uint input_at = min(k, inputs - 1u);
    return (input_at < encoded ? input_at : source + input_at - encoded) * stride4;
}

void store(mat4 c, uint segment, uint o, uint k) {
    for (uint j = 0u; j < 4u; j++) {
        for (uint i = 0u; i < 4u; i++) {
            if (o + i < outputs && k + j <= inputs) {
                partials[(segment * outputs + o + i) * (inputs + 1u) + k + j] = c[j][i];
            }
        }
    }
}

// Values of four inputs, each for a vector of four rows. The values are ones where `ones` is 1,
// which marks the bias's input.
mat4 inputs_at(uvec4 planes, uint own, uint r, vec4 ones, float own_one) {
    mat4 x;
    if (SHARED) {
        x = all_four(mix(activations[own + r], vec4(1.0), own_one));
    } else {
        x = mat4(mix(activations[planes.x + r], vec4(1.0), ones.x),
                 mix(activations[planes.y + r], vec4(1.0), ones.y),
                 mix(activations[planes.z + r], vec4(1.0), ones.z),
                 mix(activations[planes.w + r], vec4(1.0), ones.w));
    }
    return x;
}

mat4 deltas_at(uvec4 planes, uint r) {
    return transpose(mat4(deltas[planes.x + r], deltas[planes.y + r], deltas[planes.z + r],
                          deltas[planes.w + r]));
}

void main() {
    uint columns = (inputs + 8u) / 8u;
    uint rows = (outputs + 7u) / 8u;
    // Adjacent invocations have the same inputs.
    uint i = shared_index();
    uint o = i % rows * 8u;
    uint k = i / rows % columns * 8u;
    uint segment = i / (columns * rows);
    uint first = segment * segment4;
    if (first >= stride4) {
        return;
    }
    uint last = min(first + segment4, stride4);
    uvec4 d_low = (delta + min(uvec4(o, o + 1u, o + 2u, o + 3u), uvec4(outputs - 1u))) * stride4;
    uvec4 d_high = (delta + min(uvec4(o + 4u, o + 5u, o + 6u, o + 7u), uvec4(outputs - 1u))) * stride4;
    uvec4 x_low = uvec4(plane_of(k), plane_of(k + 1u), plane_of(k + 2u), plane_of(k + 3u));
    uvec4 x_high = uvec4(plane_of(k + 4u), plane_of(k + 5u), plane_of(k + 6u), plane_of(k + 7u));
    uint own_low = own_of(x_low), own_high = own_of(x_high);
    // 1 for the input that is the bias's, else 0.
    vec4 one_low = vec4(equal(uvec4(k, k + 1u, k + 2u, k + 3u), uvec4(inputs)));
    vec4 one_high = vec4(equal(uvec4(k + 4u, k + 5u, k + 6u, k + 7u), uvec4(inputs)));
    float own_one_low = own_of(one_low), own_one_high = own_of(one_high);
    mat4 c00 = mat4(0.0), c10 = mat4(0.0), c01 = mat4(0.0), c11 = mat4(0.0);
    for (uint r = first; r < last; r++) {
        mat4 d0 = deltas_at(d_low, r);
        mat4 d1 = deltas_at(d_high, r);
        mat4 x0 = inputs_at(x_low, own_low, r, one_low, own_one_low);
        mat4 x1 = inputs_at(x_high, own_high, r, one_high, own_one_high);
        c00 += d0 * x0;
        c10 += d1 * x0;
        c01 += d0 * x1;
        c11 += d1 * x1;
    }
    store(c00, segment, o, k);
    store(c10, segment, o + 4u, k);
    store(c01, segment, o, k + 4u);
    store(c11, segment, o + 4u, k + 4u);
}
