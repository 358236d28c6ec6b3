// Which pixels a splat reaches. Counting, emission and the raster's culling share this file, so
// that they agree.
const uint TILE = 16u;

// The least power, and with it the largest alpha, that the splat has within a rectangle of pixel
// centres: 0 where its mean lies inside, else on one of the edges that face the mean.
float least_power(vec2 mean, vec3 conic, vec2 lowest, vec2 highest) {
    vec2 low = lowest - mean, high = highest - mean;
    vec2 near = clamp(vec2(0.0), low, high);
    float best = 0.0;
    bool outside_x = near.x != 0.0, outside_y = near.y != 0.0;
    if (outside_x) {
        float y = conic.z > 0.0 ? clamp(-conic.y * near.x / conic.z, low.y, high.y) : near.y;
        best = 0.5 * (conic.x * near.x * near.x + conic.z * y * y) + conic.y * near.x * y;
    }
    if (outside_y) {
        float x = conic.x > 0.0 ? clamp(-conic.y * near.y / conic.x, low.x, high.x) : near.x;
        float other = 0.5 * (conic.x * x * x + conic.z * near.y * near.y) + conic.y * x * near.y;
        best = outside_x ? min(best, other) : other;
    }
    return best;
}

// The power at which alpha falls to the cut, widened by what rounding may lose.
float power_limit(float opacity, float alpha_cut) {
    return log(opacity / alpha_cut) * 1.0001 + 1e-4;
}

// The rectangle of tiles [first, last) around the ellipse's bounding box.
void tile_rectangle(vec2 mean, vec2 extent, uvec2 tiles, out uvec2 first, out uvec2 last) {
    // A pixel's centre lies at +0.5, so the box reaches pixel p when p + 0.5 lies within.
    vec2 low = floor((mean - extent - 0.5) / float(TILE));
    vec2 high = floor((mean + extent - 0.5) / float(TILE)) + 1.0;
    first = uvec2(clamp(low, vec2(0.0), vec2(tiles)));
    last = uvec2(clamp(high, vec2(0.0), vec2(tiles)));
}

bool reaches_tile(vec2 mean, vec3 conic, float limit, uvec2 tile) {
    vec2 lowest = vec2(tile * TILE) + 0.5;
    return least_power(mean, conic, lowest, lowest + float(TILE - 1u)) <= limit;
}
