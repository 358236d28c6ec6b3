// Forward–backward agreement. Requires `backward`, `width`, `height` and flow/sample.glsl.

// The squared forward–backward error (forward flow plus the backward flow at its end), divided by
// the tolerated squared error. It is negative if the flow leaves the image.
float miss(vec2 here, vec2 forward_flow) {
    vec2 there = here + forward_flow;
    ivec2 size = ivec2(width, height);
    if (any(lessThan(there, vec2(-0.5))) || any(greaterThan(there, vec2(size) - 0.5))) {
        return -1.0;
    }
    Taps t = taps(there, size);
    vec2 back = blend(backward[t.at.x], backward[t.at.y], backward[t.at.z], backward[t.at.w], t.part);
    vec2 d = forward_flow + back;
    float tolerated = 0.01 * (dot(forward_flow, forward_flow) + dot(back, back)) + 0.5;
    return dot(d, d) / tolerated;
}
