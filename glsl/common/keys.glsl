// Catmull-Rom interpolation between values (keys) at evenly spaced times of [0, 1]. The curve
// passes through the keys. The first and the last key are repeated beyond the ends.

struct Keys {
    int first;      // index of the first of four keys, may lie outside
    vec4 weights;   // weights of the four keys, summing to 1
};

Keys keys_at(float time, uint count) {
    float place = clamp(time, 0.0, 1.0) * float(count - 1u);
    float before = clamp(floor(place), 0.0, max(float(count) - 2.0, 0.0));
    float u = place - before;
    float u2 = u * u;
    float u3 = u2 * u;
    return Keys(int(before) - 1, 0.5 * vec4(-u3 + 2.0 * u2 - u, 3.0 * u3 - 5.0 * u2 + 2.0,
                                            -3.0 * u3 + 4.0 * u2 + u, u3 - u2));
}

uint key_of(Keys keys, int slot, uint count) {
    return uint(clamp(keys.first + slot, 0, int(count) - 1));
}
