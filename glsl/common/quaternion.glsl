// Quaternions (w, x, y, z) as vec4(w, x, y, z).

#include "common/finite.glsl"

const vec4 NO_ROTATION = vec4(1.0, 0.0, 0.0, 0.0);

// Normalises q. Returns false, and the identity in `unit`, if q is NaN or its largest component is
// not in (1e-18, 1e18]. The division by the largest component keeps the squares from overflowing or
// underflowing. The comparisons are false for a NaN in any component.
bool unit_quaternion(vec4 q, out vec4 unit, out float norm) {
    vec4 a = abs(q);
    float largest = max(max(a.x, a.y), max(a.z, a.w));
    bool usable = all(lessThanEqual(a, vec4(1e18))) && largest > 1e-18;
    vec4 scaled = q / largest;
    float l = length(scaled);
    unit = usable ? scaled / l : NO_ROTATION;
    norm = l * largest;
    return usable;
}

// The gradient with respect to q, given the gradient with respect to its unit quaternion.
vec4 unit_quaternion_backward(vec4 q, vec4 gradient) {
    vec4 u;
    float norm;
    return unit_quaternion(q, u, norm) ? (gradient - u * dot(u, gradient)) / norm : vec4(0.0);
}

vec4 multiply(vec4 a, vec4 b) {
    vec3 v = a.x * b.yzw + b.x * a.yzw + cross(a.yzw, b.yzw);
    return vec4(a.x * b.x - dot(a.yzw, b.yzw), v);
}

vec4 conjugate(vec4 q) {
    return vec4(q.x, -q.yzw);
}

// R(q) v - v for a unit quaternion: exactly zero for the identity, and without cancellation for a
// small rotation.
vec3 turn_offset(vec4 q, vec3 v) {
    vec3 t = 2.0 * cross(q.yzw, v);
    return q.x * t + cross(q.yzw, t);
}

// The gradient with respect to the components of q, given the gradient with respect to R(q) v as a
// polynomial in q.
vec4 turn_backward(vec4 q, vec3 v, vec3 gradient) {
    vec3 a = cross(q.yzw, v);
    float by_w = 2.0 * dot(gradient, a);
    vec3 by_v = 2.0 * (q.x * cross(v, gradient) + cross(a, gradient) + cross(v, cross(gradient, q.yzw)));
    return vec4(by_w, by_v);
}
