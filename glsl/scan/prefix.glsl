// Requires `prefix` as a buffer of uvec4, and scan/vec4.glsl.

// Writes the exclusive prefix sums of the four values from index `at` on, starting with `running`,
// and adds the four values to `running`.
void write_vec4(uint at, uvec4 v, inout uint running) {
    uvec4 before;
    before.x = running;
    before.y = before.x + v.x;
    before.z = before.y + v.y;
    before.w = before.z + v.z;
    running = before.w + v.w;
    prefix[at / 4u] = before;
}

// The same for the scalar tail: the values in [begin, end), at most 3.
void write_tail(uint begin, uint end, uint running) {
    for (uint at = begin; at < end; at++) {
        prefix[at / 4u][at % 4u] = running;
        running += value(at);
    }
}
