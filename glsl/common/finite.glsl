#ifndef FINITE_GLSL
#define FINITE_GLSL

// The test reads the exponent's bits, because a driver that assumes that there are no NaNs may drop
// a comparison.
bool finite(float x) {
    return (floatBitsToUint(x) & 0x7f800000u) != 0x7f800000u;
}
bool finite(vec3 v) {
    return finite(v.x) && finite(v.y) && finite(v.z);
}

#endif
