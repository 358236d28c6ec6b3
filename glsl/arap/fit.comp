#version 460
// As-rigid-as-possible energy. Computes for every control point the rotation that best maps its
// edges at the first time to those at the second, the remaining energy, and each edge's gradient.
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_scalar_block_layout : require

layout(local_size_x = 64) in;

layout(scalar, binding = 0) readonly buffer Nodes { vec3 nodes[]; };
layout(std430, binding = 1) readonly buffer LogRadii { float log_radii[]; };
layout(std430, binding = 2) readonly buffer Neighbours { uint neighbours[]; };
layout(std430, binding = 3) readonly buffer Transforms { vec4 transforms[]; };
layout(std430, binding = 4) writeonly buffer Energies { float energies[]; };
// Two vectors per place: the gradients with respect to the edge at the second and at the first
// time.
layout(std430, binding = 5) writeonly buffer EdgeGradients { vec4 edge_gradients[]; };

layout(push_constant) uniform Params {
    uint node_count;
    uint k;
    uint first_at;      // first rows of `transforms` at the two times
    uint second_at;
    uint always;        // number of neighbours that count at any distance
    float reach;        // other neighbours count only if nearer than this, world units
    float scale;        // weight of the mean energy, divided by the number of control points
};

#include "common/grid.glsl"
#include "common/quaternion.glsl"

const uint NONE = 0xffffffffu;
const float LARGEST_LOG_RADIUS = 40.0;
// Represents an exponent of minus infinity.
const float NEVER = -3.4e38;

// The edge of control point i at a place; `rest` is its canonical vector. Returns false for an
// empty place and for a neighbour that does not count.
bool edge_of(uint i, uint place, inout uint kept, out uint j, out vec3 rest) {
    j = neighbours[i * k + place];
    if (j == NONE || j == i) {
        return false;
    }
    rest = nodes[j] - nodes[i];
    kept++;
    return kept <= always || dot(rest, rest) < reach * reach;
}

float exponent_of(vec3 rest, float inverse_square) {
    float e = -0.5 * dot(rest, rest) * inverse_square;
    return e >= NEVER ? e : NEVER;
}

void rotate_pair(inout mat4 m, int p, int q, float c, float s) {
    vec4 a = m[p];
    vec4 b = m[q];
    m[p] = c * a - s * b;
    m[q] = s * a + c * b;
}

// One Jacobi rotation, which makes entry (p, q) of the symmetric matrix zero.
void jacobi(inout mat4 a, inout mat4 v, int p, int q) {
    float off = a[q][p];
    if (off == 0.0) {
        return;
    }
    float theta = (a[q][q] - a[p][p]) / (2.0 * off);
    // Beyond 1e18 the square overflows, and the rotation is below f32's resolution.
    float t = abs(theta) > 1e18 ? 0.0 : (theta < 0.0 ? -1.0 : 1.0) / (abs(theta) + sqrt(theta * theta + 1.0));
    float c = inversesqrt(t * t + 1.0);
    rotate_pair(a, p, q, c, t * c);
    a = transpose(a);
    rotate_pair(a, p, q, c, t * c);
    rotate_pair(v, p, q, c, t * c);
}

// The unit quaternion of the best rotation (Horn 1987): the eigenvector of the largest eigenvalue
// of a symmetric 4x4 matrix. The result is never a reflection, and degenerate edges also give a
// rotation.
vec4 best_rotation(mat3 m) {
    // m[b][a] is the weighted sum of from_a to_b.
    float largest = 0.0;
    for (int b = 0; b < 3; b++) {
        vec3 column = abs(m[b]);
        largest = max(largest, max(column.x, max(column.y, column.z)));
    }
    if (!(largest > 0.0) || largest > 3.0e38) {
        return NO_ROTATION;
    }
    m = mat3(m[0] / largest, m[1] / largest, m[2] / largest);
    float xx = m[0][0], yy = m[1][1], zz = m[2][2];
    float xy = m[1][0], yx = m[0][1], yz = m[2][1], zy = m[1][2], zx = m[0][2], xz = m[2][0];
    mat4 a = mat4(xx + yy + zz, yz - zy, zx - xz, xy - yx,
                  yz - zy, xx - yy - zz, xy + yx, zx + xz,
                  zx - xz, xy + yx, yy - xx - zz, yz + zy,
                  xy - yx, zx + xz, yz + zy, zz - xx - yy);
    mat4 v = mat4(1.0);
    // The iteration converges quadratically. After six sweeps the off-diagonal entries are
    // negligible in f32.
    for (int sweep = 0; sweep < 6; sweep++) {
        jacobi(a, v, 0, 1);
        jacobi(a, v, 0, 2);
        jacobi(a, v, 0, 3);
        jacobi(a, v, 1, 2);
        jacobi(a, v, 1, 3);
        jacobi(a, v, 2, 3);
    }
    vec4 best = v[0];
    float value = a[0][0];
    for (int i = 1; i < 4; i++) {
        bool better = a[i][i] > value;
        best = better ? v[i] : best;
        value = better ? a[i][i] : value;
    }
    float norm;
    vec4 unit;
    unit_quaternion(best, unit, norm);
    return unit;
}

void main() {
    uint i = group_index() * 64u + gl_LocalInvocationIndex;
    if (i >= node_count) {
        return;
    }
    float log_radius = log_radii[i];
    float inverse_square =
        isnan(log_radius) ? log_radius : exp(-2.0 * clamp(log_radius, -LARGEST_LOG_RADIUS, LARGEST_LOG_RADIUS));
    vec3 first_here = transforms[2u * (first_at + i)].xyz;
    vec3 second_here = transforms[2u * (second_at + i)].xyz;
    uint j;
    vec3 rest;

    // The largest exponent is subtracted from all, since otherwise all weights might underflow.
    float largest = NEVER;
    uint nearest = NONE;
    uint kept = 0u;
    for (uint s = 0u; s < k; s++) {
        if (edge_of(i, s, kept, j, rest)) {
            nearest = nearest == NONE ? s : nearest;
            largest = max(largest, exponent_of(rest, inverse_square));
        }
    }
    bool alone = largest == NEVER;
    float sum = 0.0;
    mat3 moments = mat3(0.0);
    kept = 0u;
    for (uint s = 0u; s < k; s++) {
        if (edge_of(i, s, kept, j, rest)) {
            float e = exponent_of(rest, inverse_square);
            float w = alone ? float(s == nearest) : (e > NEVER ? exp(e - largest) : 0.0);
            vec3 from = rest + (transforms[2u * (first_at + j)].xyz - first_here);
            vec3 to = rest + (transforms[2u * (second_at + j)].xyz - second_here);
            sum += w;
            moments += outerProduct(from * w, to);
        }
    }
    vec4 q = best_rotation(moments);
    float energy = 0.0;
    kept = 0u;
    for (uint s = 0u; s < k; s++) {
        vec3 by_second = vec3(0.0);
        vec3 by_first = vec3(0.0);
        if (edge_of(i, s, kept, j, rest)) {
            float e = exponent_of(rest, inverse_square);
            float w = alone ? float(s == nearest) : (e > NEVER ? exp(e - largest) : 0.0) / sum;
            vec3 from = rest + (transforms[2u * (first_at + j)].xyz - first_here);
            vec3 to = rest + (transforms[2u * (second_at + j)].xyz - second_here);
            vec3 residual = (to - from) - turn_offset(q, from);
            energy += scale * w * dot(residual, residual);
            by_second = 2.0 * scale * w * residual;
            by_first = -(by_second + turn_offset(conjugate(q), by_second));
        }
        edge_gradients[2u * (i * k + s)] = vec4(by_second, 0.0);
        edge_gradients[2u * (i * k + s) + 1u] = vec4(by_first, 0.0);
    }
    energies[i] = energy;
}
