#version 460
// Estimates the slopes of the flow around each pixel: a weighted least-squares fit of an affine flow
// to the flow of the surroundings. Pixels whose flow differs much have little weight, because they
// belong to another surface.

layout(local_size_x = 16, local_size_y = 4) in;

layout(std430, binding = 0) readonly buffer Flow { vec2 flow[]; };
layout(std430, binding = 1) readonly buffer Trust { float trust[]; };
// du/dx, du/dy, dv/dx, dv/dy.
layout(std430, binding = 2) writeonly buffer Slopes { vec4 slopes[]; };

layout(push_constant) uniform Params {
    int width;
    int height;
};

// The surroundings: every SLOPE_STEP pixels, up to SLOPE_REACH steps to each side.
const int SLOPE_STEP = 4;
const int SLOPE_REACH = 6;
// Difference of the flow at which the weight has fallen to a quarter, pixels.
const float SLOPE_ALIKE = 0.5;
// Added to the moments of the positions, pixels². It keeps the slopes at 0 where few pixels are alike.
const float SLOPE_RIDGE = 500.0;

void main() {
    ivec2 p = ivec2(gl_GlobalInvocationID.xy);
    if (p.x >= width || p.y >= height) {
        return;
    }
    int at = p.y * width + p.x;
    vec2 own = flow[at];
    float weights = 0.0;
    vec2 places = vec2(0.0), changes = vec2(0.0);
    // Moments xx, xy, yy of the positions, and of the changes of the flow with the positions.
    vec3 moments = vec3(0.0);
    vec4 mixed = vec4(0.0);
    ivec2 first = -min(ivec2(SLOPE_REACH), p / SLOPE_STEP);
    ivec2 last = min(ivec2(SLOPE_REACH), (ivec2(width, height) - 1 - p) / SLOPE_STEP);
    for (int j = first.y; j <= last.y; j++) {
        for (int i = first.x; i <= last.x; i++) {
            int other = at + SLOPE_STEP * (j * width + i);
            vec2 change = flow[other] - own;
            float alike = 1.0 / (1.0 + dot(change, change) / (SLOPE_ALIKE * SLOPE_ALIKE));
            float weight = trust[other] * alike * alike;
            vec2 d = float(SLOPE_STEP) * vec2(i, j);
            weights += weight;
            places += weight * d;
            changes += weight * change;
            moments += weight * vec3(d.x * d.x, d.x * d.y, d.y * d.y);
            mixed += weight * vec4(change.x * d, change.y * d);
        }
    }
    vec2 mean = places / weights;
    moments -= vec3(places.x * mean, places.y * mean.y);
    mixed -= vec4(changes.x * mean, changes.y * mean);
    float a = moments.x + SLOPE_RIDGE, b = moments.y, c = moments.z + SLOPE_RIDGE;
    float inverse = 1.0 / (a * c - b * b);
    slopes[at] = inverse * vec4(c * mixed.x - b * mixed.y, a * mixed.y - b * mixed.x,
                                c * mixed.z - b * mixed.w, a * mixed.w - b * mixed.z);
}
