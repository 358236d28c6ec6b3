// Blending of a pixel over the background before it is packed. Values that are not finite count as
// 0.
#include "common/finite.glsl"

float some(float value) {
    return finite(value) ? value : 0.0;
}

vec4 over(vec4 rgba, vec4 background) {
    vec4 pixel = vec4(some(rgba.r), some(rgba.g), some(rgba.b), some(rgba.a));
    return pixel + (1.0 - pixel.a) * background;
}
