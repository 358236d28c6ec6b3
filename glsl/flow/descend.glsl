// The cost of a patch's displacement, and its refinement. Requires flow/patch.glsl and the
// parameters `search_steps` and `noise`.

// Damping of a Gauss–Newton step, as a fraction of the noise's squared gradients over the patch.
const float DAMPING = 0.1;
// A candidate replaces the best patch so far only if it costs less than this fraction of that
// patch's cost.
const float HYSTERESIS = 0.9;

// The refinement ends after a step below this, in pixels.
const float SETTLED = 0.01;

void patch_span(ivec2 id, out ivec2 low, out ivec2 high) {
    ivec2 start = id * STRIDE - OVERHANG;
    low = max(start, ivec2(0));
    high = min(start + PATCH, ivec2(width, height));
}

float patch_cost(ivec2 id, Patch p) {
    ivec2 low, high;
    patch_span(id, low, high);
    vec2 centre = patch_centre(id);
    float sum = 0.0, square = 0.0;
    for (int y = low.y; y < high.y; y++) {
        for (int x = low.x; x < high.x; x++) {
            vec2 here = vec2(x, y);
            float d = residual(ivec2(x, y), here + patch_flow(p, here - centre));
            sum += d;
            square += d * d;
        }
    }
    vec2 size = vec2(high - low);
    float n = size.x * size.y;
    return max((square - sum * sum / n) / n, 0.0);
}

// Refines a patch by Gauss–Newton steps with the first image's gradients (inverse search). Returns
// the displacement of lowest cost among all steps.
Patch descend(ivec2 id, Patch from) {
    ivec2 low, high;
    patch_span(id, low, high);
    vec2 centre = patch_centre(id);
    vec2 size = vec2(high - low);
    float n = size.x * size.y;
    vec2 sum_g = vec2(0.0);
    vec3 scatter = vec3(0.0);
    for (int y = low.y; y < high.y; y++) {
        for (int x = low.x; x < high.x; x++) {
            int at = 5 * (y * width + x);
            vec2 g = vec2(derivatives_a[at], derivatives_a[at + 1]);
            sum_g += g;
            scatter += vec3(g.x * g.x, g.x * g.y, g.y * g.y);
        }
    }
    vec2 mean = sum_g / n;
    scatter -= vec3(sum_g.x * mean.x, sum_g.x * mean.y, sum_g.y * mean.y);
    // The damping, derived from the gradients of noise, limits the step where the patch has too
    // little texture.
    float damping = n * noise * noise * DAMPING;
    float xx = scatter.x + damping, xy = scatter.y, yy = scatter.z + damping;
    float inverse = 1.0 / (xx * yy - xy * xy);
    Patch now = from;
    Patch best = from;
    bool settled = false;
    for (uint k = 0u; k <= search_steps; k++) {
        float sum = 0.0, square = 0.0;
        vec2 pull = vec2(0.0);
        for (int y = low.y; y < high.y; y++) {
            for (int x = low.x; x < high.x; x++) {
                vec2 here = vec2(x, y);
                float d = residual(ivec2(x, y), here + patch_flow(now, here - centre));
                int at = 5 * (y * width + x);
                sum += d;
                square += d * d;
                pull += vec2(derivatives_a[at], derivatives_a[at + 1]) * d;
            }
        }
        now.shift = sum / n;
        now.cost = max((square - sum * now.shift) / n, 0.0);
        if (k == 0u || now.cost < best.cost) {
            best = now;
        }
        if (k == search_steps || settled) {
            break;
        }
        pull -= mean * sum;
        vec2 step = vec2(yy * pull.x - xy * pull.y, xx * pull.y - xy * pull.x) * inverse;
        now.flow -= step;
        vec2 away = abs(now.flow - from.flow);
        // The search counts as diverged if the displacement changed by more than the size of a
        // patch.
        if (max(away.x, away.y) > float(PATCH)) {
            break;
        }
        settled = max(abs(step.x), abs(step.y)) < SETTLED;
    }
    return best;
}
