// A pixel before it is packed: over what lies behind it, what is not finite counting as nothing.
#include "common/finite.glsl"

float some(float value) {
    return finite(value) ? value : 0.0;
}

vec4 over(vec4 rgba, vec4 background) {
    vec4 pixel = vec4(some(rgba.r), some(rgba.g), some(rgba.b), some(rgba.a));
    return pixel + (1.0 - pixel.a) * background;
}
