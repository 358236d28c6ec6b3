// The host's own drawing: a triangle, and the splats over whatever is there.

@vertex
fn corner(@location(0) at: vec2f) -> @builtin(position) vec4f {
    return vec4f(at, 0.0, 1.0);
}

// TRIANGLE in stage.rs.
@fragment
fn plain() -> @location(0) vec4f {
    return vec4f(51.0, 102.0, 204.0, 255.0) / 255.0;
}

// One triangle that covers everything.
@vertex
fn everywhere(@builtin(vertex_index) i: u32) -> @builtin(position) vec4f {
    return vec4f(f32(i & 1u) * 4.0 - 1.0, f32(i >> 1u) * 4.0 - 1.0, 0.0, 1.0);
}

@group(0) @binding(0) var splats: texture_2d<f32>;

// Premultiplied colour and alpha, as the blending wants it.
@fragment
fn over(@builtin(position) at: vec4f) -> @location(0) vec4f {
    return textureLoad(splats, vec2u(at.xy), 0);
}
