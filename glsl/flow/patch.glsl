// Patches of 8×8 pixels at a stride of 4. Along each axis, patch i covers the 8 pixels from 4i − 2
// on, as far as they lie in the image. Requires `width`, `height`, luma_a, luma_b, derivatives_a
// and flow/sample.glsl.
const int PATCH = 8;
const int STRIDE = 4;
const int OVERHANG = (PATCH - STRIDE) / 2;

struct Patch {
    vec2 flow;      // displacement of the centre, pixels
    vec4 slope;     // du/dx, du/dy, dv/dx, dv/dy
    float shift;    // mean of (second image − first image)
    float cost;     // mean squared residual after subtraction of `shift`
};

ivec2 patch_grid() {
    return (ivec2(width, height) + STRIDE - 1) / STRIDE;
}

vec2 patch_centre(ivec2 id) {
    return vec2(id * STRIDE) + 0.5 * float(STRIDE - 1);
}

vec2 patch_flow(Patch p, vec2 from_centre) {
    return p.flow + vec2(dot(p.slope.xy, from_centre), dot(p.slope.zw, from_centre));
}

float residual(ivec2 pixel, vec2 there) {
    Taps t = taps(there, ivec2(width, height));
    vec4 v = vec4(luma_b[t.at.x], luma_b[t.at.y], luma_b[t.at.z], luma_b[t.at.w]);
    return blend(v, t.part) - luma_a[pixel.y * width + pixel.x];
}
