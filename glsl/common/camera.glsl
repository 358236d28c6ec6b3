// A camera on the device: 20 floats in the layout of ops::render::device_camera.
struct Camera {
    mat3 rotation;     // rotation part of view_from_world
    vec3 centre;       // camera centre in the world frame, rounded to f32
    vec3 centre_rest;  // exact centre minus `centre`
    vec2 focal;
    vec2 principal;
};

Camera load_camera() {
    Camera c;
    // Stored row by row; GLSL matrices are built column by column.
    c.rotation = transpose(mat3(camera[0], camera[1], camera[2], camera[3], camera[4], camera[5],
                                camera[6], camera[7], camera[8]));
    c.centre = vec3(camera[9], camera[10], camera[11]);
    c.centre_rest = vec3(camera[12], camera[13], camera[14]);
    c.focal = vec2(camera[15], camera[16]);
    c.principal = vec2(camera[17], camera[18]);
    return c;
}

// Returns the offset from the camera centre to a point, in world axes. Rotating the point and then
// adding the translation would lose 0.06 units a million units from the origin (case
// render/far_from_the_origin). Subtracting the centre first is exact for points near the camera.
// `precise` keeps the compiler from reordering the subtractions.
vec3 sight(Camera c, vec3 position) {
    precise vec3 near = position - c.centre;
    precise vec3 offset = near - c.centre_rest;
    return offset;
}

// Returns the range of x/z and y/z in which the projection's Jacobian may be evaluated: the image's
// edges, widened on each side by (tangent_clamp - 1) times half the image's extent.
void tangent_limits(Camera c, vec2 size, float tangent_clamp, out vec2 lowest, out vec2 highest) {
    vec2 margin = (tangent_clamp - 1.0) * 0.5 * size / c.focal;
    lowest = -(c.principal / c.focal + margin);
    highest = (size - c.principal) / c.focal + margin;
}
