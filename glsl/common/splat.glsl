// The geometry of one projected Gaussian, shared by the forward and the backward pass.

#include "common/finite.glsl"

mat3 rotation_matrix(vec4 q) {
    float w = q.x, x = q.y, y = q.z, z = q.w;
    return mat3(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
                2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
                2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}

// A Gaussian is culled as not finite if a coordinate of its position (camera frame) or one of its
// SH coefficients exceeds this, because products of them in the gradients would overflow (case
// fuzz/regressions).
const float LARGEST = 1e18;

// Quaternions shorter than this count as zero.
const float LEAST_QUATERNION = 1e-10;

const float TWO_TO_64 = 18446744073709551616.0;

// Normalises q. Returns false if q is not finite or shorter than LEAST_QUATERNION. The division by
// the largest component keeps the squares of huge quaternions from overflowing and of tiny ones
// from underflowing.
bool normalised(vec4 q, out vec4 unit, out float length_q) {
    if (!finite(q.xyz) || !finite(q.w)) {
        return false;
    }
    float largest = max(max(abs(q.x), abs(q.y)), max(abs(q.z), abs(q.w)));
    if (largest == 0.0) {
        return false;
    }
    // The reciprocal of a number above 2^126 is subnormal, and GPUs flush it to zero. A power of
    // two scales large quaternions down first.
    float down = largest > TWO_TO_64 ? 1.0 / TWO_TO_64 : 1.0;
    vec4 scaled = (q * down) / (largest * down);
    float l = length(scaled);
    unit = scaled / l;
    length_q = l * largest;
    return length_q >= LEAST_QUATERNION && finite(length_q);
}

// The intermediate values of a projected Gaussian's shape. With J the projection's Jacobian at the
// (clamped) centre, N the rotation of view_from_world times the Gaussian's own rotation, and S the
// scales, half_covariance = J N S. The 2D covariance is half_covariance times its transpose, plus
// the dilation.
//
// The conic, half the inverse of the covariance, is stored as its triangular factor: at an offset d
// from the mean the power is (conic.x d.x + conic.y d.y)^2 + (conic.z d.y)^2. The entries are at
// most 1/sqrt(2 dilation), and a sum of two squares does not cancel. With the usual entries A, B,
// C, the power at pixels on a needle 1e7 pixels long can become negative, and rounding errors
// exceed the gradients with respect to its length (cases fuzz/regressions).
struct Shape {
    vec3 view;          // centre in the camera frame
    vec2 tangent;       // x/z and y/z, clamped
    bvec2 clamped;
    mat3 axes;          // N
    vec3 scales;
    vec3 row_x, row_y;  // rows of half_covariance, divided by `unit`
    float unit;         // >= the largest entry of half_covariance; keeps squares finite
    float dilation;     // divided by unit²
    vec3 covariance;    // xx, xy, yy, divided by unit²
    vec2 inverse;       // unit times conic.x and conic.z
    vec3 conic;
};

// Computes the shape. Returns false if the centre is not beyond the near plane, if an intermediate
// value is not finite, or if the covariance is singular.
bool shape_of(Camera c, vec2 size, float near, float tangent_clamp, float dilation, vec3 position,
              vec3 log_scale, vec4 unit_rotation, out Shape s) {
    s.view = c.rotation * sight(c, position);
    if (!finite(s.view) || any(greaterThan(abs(s.view), vec3(LARGEST))) || s.view.z <= near) {
        return false;
    }
    vec2 lowest, highest;
    tangent_limits(c, size, tangent_clamp, lowest, highest);
    vec2 tangent = s.view.xy / s.view.z;
    s.tangent = clamp(tangent, lowest, highest);
    s.clamped = bvec2(tangent.x < lowest.x || tangent.x > highest.x,
                      tangent.y < lowest.y || tangent.y > highest.y);
    s.scales = exp(log_scale);
    if (!finite(s.scales)) {
        return false;
    }
    s.axes = c.rotation * rotation_matrix(unit_rotation);
    vec2 f = c.focal / s.view.z;
    vec3 along_x = f.x * (vec3(s.axes[0].x, s.axes[1].x, s.axes[2].x)
                          - s.tangent.x * vec3(s.axes[0].z, s.axes[1].z, s.axes[2].z));
    vec3 along_y = f.y * (vec3(s.axes[0].y, s.axes[1].y, s.axes[2].y)
                          - s.tangent.y * vec3(s.axes[0].z, s.axes[1].z, s.axes[2].z));
    s.row_x = along_x * s.scales;
    s.row_y = along_y * s.scales;
    vec3 largest = max(abs(s.row_x), abs(s.row_y));
    s.unit = max(max(largest.x, largest.y), max(largest.z, sqrt(dilation)));
    if (!finite(s.unit)) {
        return false;
    }
    s.row_x /= s.unit;
    s.row_y /= s.unit;
    float d = dilation / s.unit / s.unit;
    s.dilation = d;
    float xx = dot(s.row_x, s.row_x), xy = dot(s.row_x, s.row_y), yy = dot(s.row_y, s.row_y);
    s.covariance = vec3(xx + d, xy, yy + d);
    // By the Cauchy-Binet formula, the determinant of a matrix times its transpose is a sum of
    // squares. For a needle it does not cancel, as xx*yy - xy*xy would.
    vec3 normal = cross(s.row_x, s.row_y);
    float determinant = dot(normal, normal) + d * (xx + yy) + d * d;
    float variance_y = s.covariance.z;
    if (!(determinant > 0.0) || !finite(determinant) || !(variance_y > 0.0)) {
        return false;
    }
    // Given y, the conditional variance of x is determinant / variance_y, and its conditional mean
    // is y * xy / variance_y.
    s.inverse = vec2(sqrt(0.5 * (variance_y / determinant)), inversesqrt(2.0 * variance_y));
    s.conic = vec3(s.inverse.x, -xy / variance_y * s.inverse.x, s.inverse.y) / s.unit;
    return finite(s.conic);
}
