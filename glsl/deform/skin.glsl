// The neighbours of one Gaussian and the blend of their motions, shared by skinning and its
// backward pass. Requires Positions, Neighbours, Nodes, LogRadii, Transforms and `transforms_at`.

// Largest number of neighbours per Gaussian.
const uint MOST_FOLLOWED = 8u;
// Neighbours per Gaussian, at least 1.
layout(constant_id = 0) const uint K = 4u;

const uint NONE = 0xffffffffu;
const float LARGEST_LOG_RADIUS = 40.0;
// Represents an exponent of minus infinity.
const float NEVER = -3.4e38;

struct Neighbour {
    uint node;
    float weight;
    float slope;        // d exponent / d ln radius; 0 where the radius gets no gradient
    vec3 offset;        // the Gaussian's centre minus the control point
    vec3 moved;         // displacement of the centre by this control point alone
    float fade;         // value added to the opacity logit
    vec4 rotation;      // unit quaternion; after blend(), in the hemisphere of the heaviest
};

float inverse_square(float log_radius) {
    return exp(-2.0 * clamp(log_radius, -LARGEST_LOG_RADIUS, LARGEST_LOG_RADIUS));
}

// Loads the neighbours and computes their weights. Returns false if there is no neighbour. The
// rotations have their own signs until blend() aligns them.
//
// Exponents reach 1e5 if radii are small. f32 resolves such exponents only to 0.01, which is too
// coarse for weights whose slopes are as large (case deform/underflow). The exponents are therefore
// computed relative to the largest one, from the differences of the offsets and of the inverse
// squared radii, before rounding discards these differences.
bool load_neighbours(uint row, vec3 point, out Neighbour near[MOST_FOLLOWED], out uint heaviest) {
    float exponents[MOST_FOLLOWED], inverse_squares[MOST_FOLLOWED];
    float largest = NEVER;
    heaviest = 0u;
    for (uint s = 0u; s < K; s++) {
        uint node = neighbours[row * K + s];
        near[s].node = node;
        near[s].weight = 0.0;
        near[s].slope = 0.0;
        near[s].offset = vec3(0.0);
        near[s].moved = vec3(0.0);
        near[s].fade = 0.0;
        near[s].rotation = NO_ROTATION;
        exponents[s] = NEVER;
        inverse_squares[s] = 0.0;
        if (node != NONE) {
            vec3 offset = point - nodes[node];
            float log_radius = log_radii[node];
            inverse_squares[s] = inverse_square(log_radius);
            float ratio = dot(offset, offset) * inverse_squares[s];
            // A radius that is NaN, or an infinite ratio, gives weight 0.
            if (!isnan(log_radius) && ratio <= 3.0e38) {
                exponents[s] = -0.5 * ratio;
                near[s].slope = abs(log_radius) <= LARGEST_LOG_RADIUS ? ratio : 0.0;
            }
            float norm;
            unit_quaternion(transforms[2u * (transforms_at + node) + 1u], near[s].rotation, norm);
            near[s].offset = offset;
            vec4 shift = transforms[2u * (transforms_at + node)];
            near[s].moved = turn_offset(near[s].rotation, offset) + shift.xyz;
            near[s].fade = shift.w;
        }
        if (exponents[s] > largest) {
            largest = exponents[s];
            heaviest = s;
        }
    }
    if (near[0].node == NONE) {
        return false;
    }
    if (largest == NEVER) {
        // Every weight underflows, so the nearest neighbour gets weight 1.
        near[0].weight = 1.0;
        return true;
    }
    vec3 base = vec3(0.0);
    float base_inverse = 0.0;
    for (uint s = 0u; s < K; s++) {
        base = s == heaviest ? near[s].offset : base;
        base_inverse = s == heaviest ? inverse_squares[s] : base_inverse;
    }
    largest = NEVER;
    for (uint s = 0u; s < K; s++) {
        if (exponents[s] > NEVER) {
            float farther = dot(near[s].offset - base, near[s].offset + base);
            float narrower = inverse_squares[s] - base_inverse;
            float relative = -0.5 * (inverse_squares[s] * farther + narrower * dot(base, base));
            exponents[s] = clamp(relative, 0.5 * NEVER, -0.5 * NEVER);
            if (exponents[s] > largest) {
                largest = exponents[s];
                heaviest = s;
            }
        }
    }
    float sum = 0.0;
    for (uint s = 0u; s < K; s++) {
        near[s].weight = exponents[s] > NEVER ? exp(exponents[s] - largest) : 0.0;
        sum += near[s].weight;
    }
    for (uint s = 0u; s < K; s++) {
        near[s].weight /= sum;
    }
    return true;
}

// The displacement of the centre, and the sum of the rotations, each with the sign that brings it
// into the hemisphere of the heaviest one.
void blend(inout Neighbour near[MOST_FOLLOWED], uint heaviest, out vec3 delta, out vec4 sum) {
    vec4 pole = NO_ROTATION;
    for (uint s = 0u; s < K; s++) {
        pole = s == heaviest ? near[s].rotation : pole;
    }
    delta = vec3(0.0);
    sum = vec4(0.0);
    for (uint s = 0u; s < K; s++) {
        near[s].rotation = dot(near[s].rotation, pole) < 0.0 ? -near[s].rotation : near[s].rotation;
        delta += near[s].weight * near[s].moved;
        sum += near[s].weight * near[s].rotation;
    }
}

// The blended rotation mixed with the identity by m (soft motion), before normalisation. `side` is
// the sign that brings `blended` into the hemisphere of the identity.
vec4 soften(vec4 blended, float m, out float side) {
    side = blended.x < 0.0 ? -1.0 : 1.0;
    return (1.0 - m) * NO_ROTATION + m * side * blended;
}
