// Bilinear interpolation at points in pixels, with the origin at the centre of the first pixel.
// Points are clamped to the edges.

struct Taps {
    ivec4 at;   // indices: upper left, upper right, lower left, lower right
    vec2 part;  // fractions towards the right and downwards
};

Taps taps(vec2 point, ivec2 size) {
    vec2 p = clamp(point, vec2(0.0), vec2(size - 1));
    vec2 corner = floor(p);
    ivec2 low = ivec2(corner);
    ivec2 high = min(low + 1, size - 1);
    ivec2 rows = ivec2(low.y, high.y) * size.x;
    return Taps(ivec4(rows.x + low.x, rows.x + high.x, rows.y + low.x, rows.y + high.x), p - corner);
}

float blend(vec4 v, vec2 part) {
    vec2 sides = v.xz + (v.yw - v.xz) * part.x;
    return sides.x + (sides.y - sides.x) * part.y;
}

vec2 blend(vec2 a, vec2 b, vec2 c, vec2 d, vec2 part) {
    vec2 top = a + (b - a) * part.x;
    vec2 bottom = c + (d - c) * part.x;
    return top + (bottom - top) * part.y;
}
