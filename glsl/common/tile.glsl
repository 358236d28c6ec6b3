// Overlap tests between a splat and rectangles of pixels. The tile counts, the emission and the
// culling of the raster kernels share this file, so that their results agree.
const uint TILE = 16u;

// The power at an offset from the mean. The conic is factored as common/splat.glsl describes.
float power_at(vec3 conic, vec2 offset) {
    float across = conic.x * offset.x + conic.y * offset.y;
    float along = conic.z * offset.y;
    return across * across + along * along;
}

// The smallest power of the splat within a rectangle of pixel centres, where its alpha is largest.
// It is 0 if the mean lies inside, and otherwise lies on one of the edges that face the mean.
float least_power(vec2 mean, vec3 conic, vec2 lowest, vec2 highest) {
    vec2 low = lowest - mean, high = highest - mean;
    vec2 near = clamp(vec2(0.0), low, high);
    float best = 0.0;
    bool outside_x = near.x != 0.0, outside_y = near.y != 0.0;
    if (outside_x) {
        // The division by the larger entry keeps the squares within f32's range.
        float unit = max(abs(conic.y), conic.z);
        vec2 column = conic.yz / unit;
        float y = -(conic.x / unit) * near.x * column.x / dot(column, column);
        best = power_at(conic, vec2(near.x, unit > 0.0 ? clamp(y, low.y, high.y) : near.y));
    }
    if (outside_y) {
        float x = -(conic.y / conic.x) * near.y;
        vec2 at = vec2(conic.x > 0.0 ? clamp(x, low.x, high.x) : near.x, near.y);
        float other = power_at(conic, at);
        best = outside_x ? min(best, other) : other;
    }
    return best;
}

// The power at which alpha falls to alpha_cut.
float power_limit(float opacity, float alpha_cut) {
    return log(opacity / alpha_cut);
}

uvec2 tile_grid(uvec2 size) {
    return (size + TILE - 1u) / TILE;
}

// The rectangle of tiles [first, last) around the pixels whose centres lie in the ellipse's
// bounding box. It is empty if the box contains no pixel centre of the image.
void tile_rectangle(vec2 mean, vec2 extent, uvec2 size, out uvec2 first, out uvec2 last) {
    vec2 low = clamp(ceil(mean - extent - 0.5), vec2(0.0), vec2(size));
    vec2 high = clamp(floor(mean + extent - 0.5) + 1.0, vec2(0.0), vec2(size));
    bool empty = any(greaterThanEqual(low, high));
    first = uvec2(low) / TILE;
    last = empty ? first : (uvec2(high) + TILE - 1u) / TILE;
}

bool reaches_tile(vec2 mean, vec3 conic, float limit, uvec2 tile, uvec2 size) {
    vec2 lowest = vec2(tile * TILE) + 0.5;
    vec2 highest = vec2(min((tile + 1u) * TILE, size)) - 0.5;
    return least_power(mean, conic, lowest, highest) <= limit;
}
