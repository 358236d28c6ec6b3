// Forward–backward agreement. Needs `backward`, `width`, `height` and flow/sample.glsl.

// How far going there and back misses, squared, over what is tolerated; negative where the flow
// leaves the image.
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
