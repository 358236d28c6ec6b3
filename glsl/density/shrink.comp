#version 460
// Computes opacity and scale of every Gaussian that was drawn, so that the Gaussian and its copies
// together look like the Gaussian before (3DGS-MCMC, equation 9).
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_scalar_block_layout : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer Drawn { uint drawn[]; };
layout(std430, binding = 1) buffer OpacityLogits { float opacity_logits[]; };
layout(scalar, binding = 2) buffer LogScales { vec3 log_scales[]; };

layout(push_constant) uniform Params {
    uint count;
    float dead_logit;
};

#include "common/grid.glsl"

const uint LARGEST_SHARE = 51u;

// ln(1 + x) for 0 <= x <= 1, as 2 artanh(x / (2 + x)). Forming 1 + x would lose the low digits of a
// small x, and Vulkan requires the logarithm of a number near 1 only to 2^-21.
float log_one_plus(float x) {
    float z = x / (2.0 + x);
    float w = z * z;
    float tail = 0.11111111 + w * (9.090909e-2 + w * 7.6923077e-2);
    return 2.0 * z * (1.0 + w * (0.33333334 + w * (0.2 + w * (0.14285715 + w * tail))));
}

// ln(1 + e^x)
float softplus(float x) {
    return max(x, 0.0) + log_one_plus(exp(-abs(x)));
}

// 1 - e^-x for x >= 0, without cancellation for a small x.
float one_minus_exp(float x) {
    float tail = 8.333334e-3 - x * (1.3888889e-3 - x * (1.984127e-4 - x * 2.4801588e-5));
    return x < 0.5 ? x * (1.0 - x * (0.5 - x * (0.16666667 - x * (4.1666668e-2 - x * tail))))
                   : 1.0 - exp(-x);
}

// The coverage of N blended Gaussians of this opacity, integrated along a line and divided by
// sqrt(pi). The source gives a double sum with alternating signs, which cancels badly. It equals
//   2 / sqrt(pi) * integral over s >= 0 of 1 - (1 - o e^(-s^2))^N.
// The trapezoid rule converges exponentially for such functions.
float coverage(float opacity, uint share) {
    const float STEP = 0.25;
    float sum = 0.0;
    for (uint i = 0u; i < 25u; i++) {
        float s = STEP * float(i);
        float x = opacity * exp(-s * s);
        float covered = 0.0;
        for (uint n = 0u; n < share; n++) {
            covered += x * (1.0 - covered);
        }
        sum += i == 0u ? 0.5 * covered : covered;
    }
    return 1.1283791670955126 * STEP * sum;
}

void main() {
    uint j = group_index() * 64u + gl_LocalInvocationIndex;
    if (j >= count || drawn[j] == 0u) {
        return;
    }
    uint share = min(drawn[j], LARGEST_SHARE - 1u) + 1u;
    float logit = opacity_logits[j];
    float thickness = softplus(logit) / float(share);
    float part = one_minus_exp(thickness);
    float change = -softplus(-logit) - log(coverage(part, share));
    // ln(e^x - 1) with x the thickness.
    opacity_logits[j] = max(thickness + log(part), dead_logit);
    log_scales[j] += change;
}
