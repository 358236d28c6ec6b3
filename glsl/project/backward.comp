#version 460
// Gradients with respect to every parameter of the Gaussians and to the camera's pose, from the
// gradients with respect to the projected splats.
//
// A culled Gaussian gets zeros. The pose's gradient is with respect to a left perturbation,
// view_from_world <- exp(twist) * view_from_world, twist = (translation, rotation). Each workgroup
// writes the sum of its contributions, and project/pose adds these sums.
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_scalar_block_layout : require
#extension GL_KHR_shader_subgroup_arithmetic : require
#extension GL_KHR_shader_subgroup_basic : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer CameraBuffer { float camera[]; };
layout(scalar, binding = 1) readonly buffer Positions { vec3 positions[]; };
layout(scalar, binding = 2) readonly buffer LogScales { vec3 log_scales[]; };
layout(std430, binding = 3) readonly buffer Rotations { vec4 rotations[]; };
layout(scalar, binding = 4) readonly buffer Sh1Buffer { vec3 sh1[]; };
layout(scalar, binding = 5) readonly buffer Sh2Buffer { vec3 sh2[]; };
layout(scalar, binding = 6) readonly buffer Sh3Buffer { vec3 sh3[]; };
layout(std430, binding = 7) readonly buffer Visible { uint visible[]; };
layout(std430, binding = 8) readonly buffer OpacityLogits { float opacity_logits[]; };
layout(std430, binding = 9) readonly buffer Colours { vec4 colours[]; };
// The three gradients with respect to the splats are as raster/gather writes them.
layout(std430, binding = 10) readonly buffer MeanGradients { vec4 mean_gradients[]; };
layout(std430, binding = 11) readonly buffer CovarianceGradients { vec4 covariance_gradients[]; };
layout(std430, binding = 12) readonly buffer ColourGradients { vec4 colour_gradients[]; };
layout(scalar, binding = 13) writeonly buffer PositionGradients { vec3 position_gradients[]; };
layout(scalar, binding = 14) writeonly buffer LogScaleGradients { vec3 log_scale_gradients[]; };
layout(std430, binding = 15) writeonly buffer RotationGradients { vec4 rotation_gradients[]; };
layout(std430, binding = 16) writeonly buffer OpacityGradients { float opacity_gradients[]; };
layout(scalar, binding = 17) writeonly buffer Sh0Gradients { vec3 sh0_gradients[]; };
layout(scalar, binding = 18) writeonly buffer Sh1Gradients { vec3 sh1_gradients[]; };
layout(scalar, binding = 19) writeonly buffer Sh2Gradients { vec3 sh2_gradients[]; };
layout(scalar, binding = 20) writeonly buffer Sh3Gradients { vec3 sh3_gradients[]; };
// Eight values per workgroup, of which six are used: translation, rotation.
layout(std430, binding = 21) writeonly buffer PosePartials { float pose_partials[]; };

layout(push_constant) uniform Params {
    uint count;
    uint width;
    uint height;
    float near;
    float dilation;
    float tangent_clamp;
};

// Whether the colours have bands 1, 2, 3 of the spherical harmonics, and whether the pose's
// gradient is computed. These are specialisation constants because software devices also execute
// branches that are not taken.
layout(constant_id = 0) const bool BAND1 = true;
layout(constant_id = 1) const bool BAND2 = true;
layout(constant_id = 2) const bool BAND3 = true;
layout(constant_id = 3) const bool WITH_POSE = true;

#include "common/grid.glsl"
#include "common/camera.glsl"
#include "common/sigmoid.glsl"
#include "common/splat.glsl"
#include "common/sh.glsl"

// Sums of each subgroup: translation, rotation.
shared float pose_sums[64][6];

// The gradient of dot(g, colour) with respect to the viewing direction d.
vec3 direction_gradient(uint i, vec3 d, vec3 g) {
    vec3 by_direction = vec3(0.0);
    if (BAND1) {
        vec3 db[3];
        sh_band1_gradient(db);
        for (uint k = 0u; k < 3u; k++) {
            by_direction += dot(g, sh1[3u * i + k]) * db[k];
        }
    }
    if (BAND2) {
        vec3 db[5];
        sh_band2_gradient(d, db);
        for (uint k = 0u; k < 5u; k++) {
            by_direction += dot(g, sh2[5u * i + k]) * db[k];
        }
    }
    if (BAND3) {
        vec3 db[7];
        sh_band3_gradient(d, db);
        for (uint k = 0u; k < 7u; k++) {
            by_direction += dot(g, sh3[7u * i + k]) * db[k];
        }
    }
    return by_direction;
}

// Writes the gradients with respect to the SH coefficients.
void colour_backward(uint i, vec3 d, vec3 g) {
    sh0_gradients[i] = SH0 * g;
    if (BAND1) {
        float b[3];
        sh_band1(d, b);
        for (uint k = 0u; k < 3u; k++) {
            sh1_gradients[3u * i + k] = b[k] * g;
        }
    }
    if (BAND2) {
        float b[5];
        sh_band2(d, b);
        for (uint k = 0u; k < 5u; k++) {
            sh2_gradients[5u * i + k] = b[k] * g;
        }
    }
    if (BAND3) {
        float b[7];
        sh_band3(d, b);
        for (uint k = 0u; k < 7u; k++) {
            sh3_gradients[7u * i + k] = b[k] * g;
        }
    }
}

// The gradient with respect to the unit quaternion q (w, x, y, z), given the gradient g with
// respect to its rotation matrix.
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

// The whitened columns of the half covariance M: U m_k, with U the factor of the conic. `across` is
// the first row: x of a column minus the part that is explained by its y. Cross products compute it
// without cancellation for a needle. `along` is the second row.
void whiten(Shape s, out vec3 across, out vec3 along) {
    vec3 normal = cross(s.row_x, s.row_y);
    vec3 rest = cross(s.row_y, normal) + s.dilation * s.row_x;
    across = s.inverse.x * (rest / s.covariance.z);
    along = s.inverse.y * s.row_y;
}

// The gradients of one Gaussian; zeros if it is culled.
struct Gradients {
    vec3 position;
    vec3 log_scale;
    vec4 rotation;
    float opacity;
    // With respect to the colour; and the viewing direction.
    vec3 colour;
    vec3 direction;
    // Contribution to the pose's gradient.
    vec3 translation;
    vec3 twist;
};

void backward(Camera c, uint i, inout Gradients to) {
    vec2 size = vec2(width, height);
    vec3 position = positions[i];
    vec3 log_scale = log_scales[i];
    vec4 unit;
    float length_q;
    normalised(rotations[i], unit, length_q);
    Shape s;
    shape_of(c, size, near, tangent_clamp, dilation, position, log_scale, unit, s);
    vec4 mean_gradient = mean_gradients[i];
    to.opacity = mean_gradient.w * sigmoid_slope(opacity_logits[i]);

    // The mean and the depth.
    vec2 f = c.focal / s.view.z;
    vec2 by_mean = mean_gradient.xy * f;
    vec3 by_view = vec3(by_mean, mean_gradient.z - dot(by_mean, s.view.xy / s.view.z));

    // The shape. If g is the gradient with respect to the whitened covariance, the gradient with
    // respect to the covariance is 2 U^T g U, and with respect to a column m of the half covariance
    // 4 U^T g (U m).
    vec3 across, along;
    whiten(s, across, along);
    vec3 g = covariance_gradients[i].xyz;
    vec3 by_across = g.x * across + g.y * along, by_along = g.y * across + g.z * along;
    to.log_scale = 4.0 * (across * by_across + along * by_along);
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
    to.rotation = (by_unit - unit * dot(unit, by_unit)) / length_q;

    // The colour. Components that were clamped get no gradient.
    vec3 offset = sight(c, position);
    float range = length(offset);
    to.direction = range > 0.0 ? offset / range : to.direction;
    to.colour = mix(vec3(0.0), colour_gradients[i].rgb, greaterThan(colours[i].rgb, vec3(0.0)));
    vec3 by_direction = direction_gradient(i, to.direction, to.colour);
    vec3 by_offset = range > 0.0
                         ? (by_direction - to.direction * dot(to.direction, by_direction)) / range
                         : vec3(0.0);

    to.position = transpose(c.rotation) * by_view + by_offset;
    to.translation = by_view + c.rotation * by_offset;
    to.twist = cross(s.view, by_view) + cross(s.axes[0], by_axes[0])
               + cross(s.axes[1], by_axes[1]) + cross(s.axes[2], by_axes[2]);
}

// Sums the workgroup's contributions to the pose's gradient.
void sum_pose(Gradients g) {
    vec3 translation = subgroupAdd(g.translation);
    vec3 twist = subgroupAdd(g.twist);
    if (gl_SubgroupInvocationID == 0u) {
        for (uint k = 0u; k < 3u; k++) {
            pose_sums[gl_SubgroupID][k] = translation[k];
            pose_sums[gl_SubgroupID][k + 3u] = twist[k];
        }
    }
    barrier();
    uint id = gl_LocalInvocationIndex;
    if (id < 6u && group_index() * 64u < count) {
        float sum = 0.0;
        for (uint k = 0u; k < gl_NumSubgroups; k++) {
            sum += pose_sums[k][id];
        }
        pose_partials[8u * group_index() + id] = sum;
    }
}

void main() {
    // Loaded before any branch, where software devices detect that every invocation reads the same
    // values.
    Camera c = load_camera();
    uint i = group_index() * 64u + gl_LocalInvocationIndex;
    Gradients g = Gradients(vec3(0.0), vec3(0.0), vec4(0.0), 0.0, vec3(0.0), vec3(0.0, 0.0, 1.0),
                            vec3(0.0), vec3(0.0));
    if (i < count) {
        if (visible[i] != 0u) {
            backward(c, i, g);
        }
        position_gradients[i] = g.position;
        log_scale_gradients[i] = g.log_scale;
        rotation_gradients[i] = g.rotation;
        opacity_gradients[i] = g.opacity;
        colour_backward(i, g.direction, g.colour);
    }
    if (WITH_POSE) {
        sum_pose(g);
    }
}
