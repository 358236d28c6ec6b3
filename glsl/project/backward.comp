#version 460
// Gradients of the projected splats to every parameter of the Gaussians and to the camera's pose.
//
// A culled Gaussian gets zeros. The pose's gradient is that of a left perturbation,
// view_from_world <- exp(twist) * view_from_world, twist = (translation, rotation); each workgroup
// leaves its sum, and project/pose adds them up.
#extension GL_GOOGLE_include_directive : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer CameraBuffer { float camera[]; };
layout(std430, binding = 1) readonly buffer Positions { float positions[]; };
layout(std430, binding = 2) readonly buffer LogScales { float log_scales[]; };
layout(std430, binding = 3) readonly buffer Rotations { vec4 rotations[]; };
layout(std430, binding = 4) readonly buffer Sh1Buffer { float sh1[]; };
layout(std430, binding = 5) readonly buffer Sh2Buffer { float sh2[]; };
layout(std430, binding = 6) readonly buffer Sh3Buffer { float sh3[]; };
layout(std430, binding = 7) readonly buffer Visible { uint visible[]; };
layout(std430, binding = 8) readonly buffer OpacityLogits { float opacity_logits[]; };
layout(std430, binding = 9) readonly buffer Colours { vec4 colours[]; };
// As raster/gather writes them.
layout(std430, binding = 10) readonly buffer MeanGradients { vec4 mean_gradients[]; };
layout(std430, binding = 11) readonly buffer CovarianceGradients { vec4 covariance_gradients[]; };
layout(std430, binding = 12) readonly buffer ColourGradients { vec4 colour_gradients[]; };
layout(std430, binding = 13) writeonly buffer PositionGradients { float position_gradients[]; };
layout(std430, binding = 14) writeonly buffer LogScaleGradients { float log_scale_gradients[]; };
layout(std430, binding = 15) writeonly buffer RotationGradients { vec4 rotation_gradients[]; };
layout(std430, binding = 16) writeonly buffer OpacityGradients { float opacity_gradients[]; };
layout(std430, binding = 17) writeonly buffer Sh0Gradients { float sh0_gradients[]; };
layout(std430, binding = 18) writeonly buffer Sh1Gradients { float sh1_gradients[]; };
layout(std430, binding = 19) writeonly buffer Sh2Gradients { float sh2_gradients[]; };
layout(std430, binding = 20) writeonly buffer Sh3Gradients { float sh3_gradients[]; };
// Eight words per workgroup, six of them used.
layout(std430, binding = 21) writeonly buffer PosePartials { float pose_partials[]; };

layout(push_constant) uniform Params {
    uint count;
    uint width;
    uint height;
    uint sh_degree;
    float near;
    float dilation;
    float tangent_clamp;
    uint with_pose;
};

#include "common/grid.glsl"
#include "common/camera.glsl"
#include "common/sigmoid.glsl"
#include "common/splat.glsl"
#include "common/sh.glsl"

shared float pose_sums[6][64];

void write3(uint which, uint at, vec3 v) {
    for (uint k = 0u; k < 3u; k++) {
        switch (which) {
        case 0u: position_gradients[at + k] = v[k]; break;
        case 1u: log_scale_gradients[at + k] = v[k]; break;
        case 2u: sh0_gradients[at + k] = v[k]; break;
        case 3u: sh1_gradients[at + k] = v[k]; break;
        case 4u: sh2_gradients[at + k] = v[k]; break;
        default: sh3_gradients[at + k] = v[k]; break;
        }
    }
}

void write_zeros(uint i) {
    write3(0u, 3u * i, vec3(0.0));
    write3(1u, 3u * i, vec3(0.0));
    rotation_gradients[i] = vec4(0.0);
    opacity_gradients[i] = 0.0;
    write3(2u, 3u * i, vec3(0.0));
    if (sh_degree >= 1u) {
        for (uint k = 0u; k < 3u; k++) {
            write3(3u, 9u * i + 3u * k, vec3(0.0));
        }
    }
    if (sh_degree >= 2u) {
        for (uint k = 0u; k < 5u; k++) {
            write3(4u, 15u * i + 3u * k, vec3(0.0));
        }
    }
    if (sh_degree >= 3u) {
        for (uint k = 0u; k < 7u; k++) {
            write3(5u, 21u * i + 3u * k, vec3(0.0));
        }
    }
}

// Writes the coefficients' gradients and returns the direction's.
vec3 colour_backward(uint i, vec3 d, vec3 g) {
    write3(2u, 3u * i, SH0 * g);
    vec3 by_direction = vec3(0.0);
    if (sh_degree >= 1u) {
        float b[3];
        vec3 db[3];
        sh_band1(d, b);
        sh_band1_gradient(db);
        for (uint k = 0u; k < 3u; k++) {
            uint at = 9u * i + 3u * k;
            write3(3u, at, b[k] * g);
            by_direction += dot(g, vec3(sh1[at], sh1[at + 1u], sh1[at + 2u])) * db[k];
        }
    }
    if (sh_degree >= 2u) {
        float b[5];
        vec3 db[5];
        sh_band2(d, b);
        sh_band2_gradient(d, db);
        for (uint k = 0u; k < 5u; k++) {
            uint at = 15u * i + 3u * k;
            write3(4u, at, b[k] * g);
            by_direction += dot(g, vec3(sh2[at], sh2[at + 1u], sh2[at + 2u])) * db[k];
        }
    }
    if (sh_degree >= 3u) {
        float b[7];
        vec3 db[7];
        sh_band3(d, b);
        sh_band3_gradient(d, db);
        for (uint k = 0u; k < 7u; k++) {
            uint at = 21u * i + 3u * k;
            write3(5u, at, b[k] * g);
            by_direction += dot(g, vec3(sh3[at], sh3[at + 1u], sh3[at + 2u])) * db[k];
        }
    }
    return by_direction;
}

// Gradient by the unit quaternion (w, x, y, z) of what has gradient g by its rotation matrix.
vec4 quaternion_gradient(vec4 q, mat3 g) {
    // g[column][row]
    float w = q.x, x = q.y, y = q.z, z = q.w;
    float s01 = g[1][0] + g[0][1], s02 = g[2][0] + g[0][2], s12 = g[2][1] + g[1][2];
    float a21 = g[1][2] - g[2][1], a02 = g[2][0] - g[0][2], a10 = g[0][1] - g[1][0];
    return 2.0 * vec4(x * a21 + y * a02 + z * a10,
                      y * s01 + z * s02 - 2.0 * x * (g[1][1] + g[2][2]) + w * a21,
                      x * s01 + z * s12 - 2.0 * y * (g[0][0] + g[2][2]) + w * a02,
                      x * s02 + y * s12 - 2.0 * z * (g[0][0] + g[1][1]) + w * a10);
}

// The columns of the half covariance M, whitened: U m_k, with U the factor of the conic. The first row
// is what is left of a column's x when y explains its share: by cross products, so that a needle's
// does not cancel.
void whiten(Shape s, out vec3 across, out vec3 along) {
    vec3 normal = cross(s.row_x, s.row_y);
    vec3 rest = cross(s.row_y, normal) + s.dilation * s.row_x;
    across = s.inverse.x * (rest / s.covariance.z);
    along = s.inverse.y * s.row_y;
}

// Writes the Gaussian's gradients; the pose's share comes back in `translation` and `rotation`.
void backward(uint i, out vec3 translation, out vec3 rotation) {
    Camera c = load_camera();
    vec2 size = vec2(width, height);
    vec3 position = vec3(positions[3u * i], positions[3u * i + 1u], positions[3u * i + 2u]);
    vec3 log_scale = vec3(log_scales[3u * i], log_scales[3u * i + 1u], log_scales[3u * i + 2u]);
    vec4 unit;
    float length_q;
    normalised(rotations[i], unit, length_q);
    Shape s;
    shape_of(c, size, near, tangent_clamp, dilation, position, log_scale, unit, s);
    vec4 mean_gradient = mean_gradients[i];
    opacity_gradients[i] = mean_gradient.w * sigmoid_slope(opacity_logits[i]);

    // The mean and the depth.
    vec2 f = c.focal / s.view.z;
    vec2 by_mean = mean_gradient.xy * f;
    vec3 by_view = vec3(by_mean, mean_gradient.z - dot(by_mean, s.view.xy / s.view.z));

    // The shape.
    // With g the gradient by the whitened covariance, that by the covariance is 2 U^T g U, and that by
    // a column of the half covariance 4 U^T g (U m).
    vec3 across, along;
    whiten(s, across, along);
    vec3 g = covariance_gradients[i].xyz;
    vec3 by_across = g.x * across + g.y * along, by_along = g.y * across + g.z * along;
    write3(1u, 3u * i, 4.0 * (across * by_across + along * by_along));
    vec3 by_x = 4.0 * s.conic.x * by_across;
    vec3 by_y = 4.0 * (s.conic.y * by_across + s.conic.z * by_along);
    vec3 along_x = by_x * s.scales, along_y = by_y * s.scales;
    mat3 rows = transpose(s.axes);
    vec2 by_tangent = -f * vec2(dot(along_x, rows[2]), dot(along_y, rows[2]));
    vec2 by_f = vec2(dot(along_x, rows[0] - s.tangent.x * rows[2]),
                     dot(along_y, rows[1] - s.tangent.y * rows[2]));
    by_view.z -= dot(by_f, f) / s.view.z;
    by_tangent = mix(by_tangent, vec2(0.0), s.clamped) / s.view.z;
    by_view += vec3(by_tangent, -dot(by_tangent, s.view.xy / s.view.z));
    mat3 by_axes_rows = mat3(f.x * along_x, f.y * along_y,
                             -f.x * s.tangent.x * along_x - f.y * s.tangent.y * along_y);
    mat3 by_axes = transpose(by_axes_rows);
    vec4 by_unit = quaternion_gradient(unit, transpose(c.rotation) * by_axes);
    rotation_gradients[i] = (by_unit - unit * dot(unit, by_unit)) / length_q;

    // The colour, where it was not clamped.
    vec3 offset = sight(c, position);
    float range = length(offset);
    vec3 direction = range > 0.0 ? offset / range : vec3(0.0, 0.0, 1.0);
    vec3 by_colour = mix(vec3(0.0), colour_gradients[i].rgb, greaterThan(colours[i].rgb, vec3(0.0)));
    vec3 by_direction = colour_backward(i, direction, by_colour);
    vec3 by_offset = range > 0.0
                         ? (by_direction - direction * dot(direction, by_direction)) / range
                         : vec3(0.0);

    write3(0u, 3u * i, transpose(c.rotation) * by_view + by_offset);
    translation = by_view + c.rotation * by_offset;
    rotation = cross(s.view, by_view) + cross(s.axes[0], by_axes[0])
               + cross(s.axes[1], by_axes[1]) + cross(s.axes[2], by_axes[2]);
}

void main() {
    uint i = group_index() * 64u + gl_LocalInvocationIndex;
    vec3 translation = vec3(0.0), rotation = vec3(0.0);
    if (i < count) {
        if (visible[i] != 0u) {
            backward(i, translation, rotation);
        } else {
            write_zeros(i);
        }
    }
    if (with_pose == 0u) {
        return;
    }
    uint id = gl_LocalInvocationIndex;
    for (uint k = 0u; k < 3u; k++) {
        pose_sums[k][id] = translation[k];
        pose_sums[k + 3u][id] = rotation[k];
    }
    for (uint step = 32u; step > 0u; step /= 2u) {
        barrier();
        if (id < step) {
            for (uint k = 0u; k < 6u; k++) {
                pose_sums[k][id] += pose_sums[k][id + step];
            }
        }
    }
    barrier();
    if (id < 6u && group_index() * 64u < count) {
        pose_partials[8u * group_index() + id] = pose_sums[id][0];
    }
}
