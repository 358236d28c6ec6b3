// Needs `prefix` as uvec4, and scan/fours.glsl.

// Writes what precedes each of the four values from `at`, begun at `running`, and moves that on.
void write_four(uint at, uvec4 four, inout uint running) {
    uvec4 before;
    before.x = running;
    before.y = before.x + four.x;
    before.z = before.y + four.y;
    before.w = before.z + four.z;
    running = before.w + four.w;
    prefix[at / 4u] = before;
}

// The same for the values in [begin, end), fewer than four.
void write_rest(uint begin, uint end, uint running) {
    for (uint at = begin; at < end; at++) {
        prefix[at / 4u][at % 4u] = running;
        running += value(at);
    }
}
