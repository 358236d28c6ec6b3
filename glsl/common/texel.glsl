// A pixel before it is packed: over what lies behind it, what is not finite counting as nothing.
float some(float value) {
    return (floatBitsToUint(value) & 0x7f800000u) == 0x7f800000u ? 0.0 : value;
}

vec4 over(vec4 rgba, vec4 background) {
    vec4 pixel = vec4(some(rgba.r), some(rgba.g), some(rgba.b), some(rgba.a));
    return pixel + (1.0 - pixel.a) * background;
}
