// Counter-based random numbers. The random words are the same on every device, the normal numbers
// up to the rounding of log and sqrt. Requires common/sine.glsl.

// Four random words for a counter (pcg4d, Jarzynski and Olano 2020).
uvec4 random_words(uvec4 counter) {
    uvec4 v = counter * 1664525u + 1013904223u;
    v.x += v.y * v.w;
    v.y += v.z * v.x;
    v.z += v.x * v.y;
    v.w += v.y * v.z;
    v ^= v >> 16u;
    v.x += v.y * v.w;
    v.y += v.z * v.x;
    v.z += v.x * v.y;
    v.w += v.y * v.z;
    return v;
}

// Three standard normal random numbers for a counter (Box-Muller).
vec3 random_normals(uvec4 counter) {
    uvec4 words = random_words(counter) >> 8u;
    const float STEP = 1.0 / 16777216.0;
    const float TAU = 6.283185307179586;
    // The logarithm's argument lies in (0, 1], so the logarithm is finite.
    vec2 radii = sqrt(-2.0 * log(vec2(words.xz + 1u) * STEP));
    vec2 angles = TAU * vec2(words.yw) * STEP;
    float sine, cosine, other_sine, other_cosine;
    sine_cosine(angles.x, sine, cosine);
    sine_cosine(angles.y, other_sine, other_cosine);
    return vec3(radii.x * cosine, radii.x * sine, radii.y * other_cosine);
}

// The upper 32 bits of the 64-bit product.
uint multiply_high(uint a, uint b) {
    uint a0 = a & 0xffffu, a1 = a >> 16u;
    uint b0 = b & 0xffffu, b1 = b >> 16u;
    uint middle = a1 * b0 + ((a0 * b0) >> 16u);
    return a1 * b1 + (middle >> 16u) + ((a0 * b1 + (middle & 0xffffu)) >> 16u);
}
