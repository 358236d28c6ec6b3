// Values four at a time: software devices pay for each access more than for its width. Needs
// `values` as uvec4.

// The four values from `at`, a multiple of 4; 0 from the n-th on.
uvec4 load_four(uint at, uint n) {
    uvec4 four = uvec4(0u);
    uint left = n - min(at, n);
    if (left >= 4u) {
        four = values[at / 4u];
    } else {
        [[unroll]] for (uint k = 0u; k < 3u; k++) {
            if (k < left) {
                four[k] = values[at / 4u][k];
            }
        }
    }
    return four;
}
