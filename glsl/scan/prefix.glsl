// Needs `prefix` as uvec4.

// Writes the sums before each of the four values from `at`, begun at `running`, and moves that on.
void store_four(uint at, uint n, uvec4 four, inout uint running) {
    uvec4 before;
    [[unroll]] for (uint k = 0u; k < 4u; k++) {
        before[k] = running;
        running += four[k];
    }
    uint left = n - min(at, n);
    if (left >= 4u) {
        prefix[at / 4u] = before;
    } else {
        [[unroll]] for (uint k = 0u; k < 3u; k++) {
            if (k < left) {
                prefix[at / 4u][k] = before[k];
            }
        }
    }
}
