#version 460
// One step of Adam over a flat array of parameters, with a vec4 per invocation: on software devices
// the number of accesses matters more than their width.
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_EXT_scalar_block_layout : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer Visible { uint visible[]; };
layout(scalar, binding = 1) readonly buffer Gradients { vec4 gradients[]; };
layout(scalar, binding = 2) buffer Parameters { vec4 parameters[]; };
layout(scalar, binding = 3) buffer First { vec4 first[]; };
layout(scalar, binding = 4) buffer Second { vec4 second[]; };
layout(std430, binding = 5) buffer Broken { uint broken; };

layout(push_constant) uniform Params {
    uint count;
    float rate;
    float beta1;
    float beta2;
    float rest1;       // 1 - beta1, formed in f64
    float rest2;       // 1 - beta2
    float unbias1;     // 1 / (1 - beta1^step)
    float unbias2;     // 1 / (1 - beta2^step)
    float epsilon;
    uint row;          // number of values in a row, if ANY_ROW is set
};

// Whether rows whose entry in `visible` is 0 stay unchanged; the number of values in a row; whether
// a row has fewer than three values; whether the parameter `row` replaces ROW. These are constants
// because software devices divide by constants several times faster, and also execute branches that
// are not taken.
layout(constant_id = 0) const bool MASKED = false;
layout(constant_id = 1) const uint ROW = 1u;
layout(constant_id = 2) const bool SHORT_ROWS = true;
layout(constant_id = 3) const bool ANY_ROW = false;

#include "common/grid.glsl"

// Gradients are clamped to this magnitude. The sum of their squares then stays finite, so a single
// huge gradient cannot freeze a parameter permanently.
const float LARGEST_GRADIENT = 1e18;

// Whether the visibility lets the step change each of the four values from `base` on.
bvec4 visible_from(uint base) {
    bvec4 steps;
    uint values = ANY_ROW ? row : ROW;
    uint last = count - 1u;
    if (SHORT_ROWS) {
        [[unroll]] for (uint k = 0u; k < 4u; k++) {
            steps[k] = visible[min(base + k, last) / values] != 0u;
        }
    } else {
        // Four values lie in at most two rows.
        uint row_index = base / values;
        bool first_steps = visible[row_index] != 0u;
        bool next_steps = visible[min(base + 3u, last) / values] != 0u;
        [[unroll]] for (uint k = 0u; k < 4u; k++) {
            steps[k] = base + k - row_index * values < values ? first_steps : next_steps;
        }
    }
    return steps;
}

void main() {
    uint i = group_index() * 64u + gl_LocalInvocationIndex;
    uint vectors = count / 4u;
    bool whole = i < vectors;
    // The scalar tail: one value for each of the last invocations.
    uint base = whole ? 4u * i : i + 3u * vectors;
    if (base >= count) {
        return;
    }
    bvec4 steps = bvec4(true);
    if (MASKED) {
        steps = visible_from(base);
    }
    if (!any(steps)) {
        return;
    }
    vec4 g, parameter, m, v;
    if (whole) {
        g = gradients[i];
        parameter = parameters[i];
        m = first[i];
        v = second[i];
    } else {
        g = vec4(gradients[base / 4u][base % 4u], vec3(0.0));
        parameter = vec4(parameters[base / 4u][base % 4u], vec3(0.0));
        m = vec4(first[base / 4u][base % 4u], vec3(0.0));
        v = vec4(second[base / 4u][base % 4u], vec3(0.0));
    }
    // The comparison is also false for NaN.
    bvec4 finite = lessThanEqual(abs(g), vec4(3.4028234e38));
    uvec4 left_out = uvec4(steps) * uvec4(not(finite));
    uint count_broken = left_out.x + left_out.y + left_out.z + left_out.w;
    if (count_broken != 0u) {
        atomicAdd(broken, count_broken);
    }
    g = clamp(g, -LARGEST_GRADIENT, LARGEST_GRADIENT);
    vec4 new_m = beta1 * m + rest1 * g;
    vec4 new_v = beta2 * v + rest2 * g * g;
    vec4 new_parameter = parameter - rate * (new_m * unbias1) / (sqrt(new_v * unbias2) + epsilon);
    [[unroll]] for (int k = 0; k < 4; k++) {
        bool changes = steps[k] && finite[k];
        m[k] = changes ? new_m[k] : m[k];
        v[k] = changes ? new_v[k] : v[k];
        parameter[k] = changes ? new_parameter[k] : parameter[k];
    }
    if (whole) {
        parameters[i] = parameter;
        first[i] = m;
        second[i] = v;
    } else {
        parameters[base / 4u][base % 4u] = parameter.x;
        first[base / 4u][base % 4u] = m.x;
        second[base / 4u][base % 4u] = v.x;
    }
}
