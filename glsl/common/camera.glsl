// A camera on the device: 20 floats in the layout of ops::render::DeviceCamera.
struct Camera {
    mat3 rotation;     // of view_from_world
    vec3 translation;  // of view_from_world
    vec2 focal;
    vec2 principal;
    vec3 centre;       // in the world
};

Camera load_camera() {
    Camera c;
    // Stored row by row; GLSL matrices are built column by column.
    c.rotation = transpose(mat3(camera[0], camera[1], camera[2], camera[3], camera[4], camera[5],
                                camera[6], camera[7], camera[8]));
    c.translation = vec3(camera[9], camera[10], camera[11]);
    c.focal = vec2(camera[12], camera[13]);
    c.principal = vec2(camera[14], camera[15]);
    c.centre = vec3(camera[16], camera[17], camera[18]);
    return c;
}

// The range of x/z and y/z at which the projection's Jacobian may be evaluated: the image's edges,
// widened by (clamp - 1) half fields of view.
void tangent_limits(Camera c, vec2 size, float tangent_clamp, out vec2 lowest, out vec2 highest) {
    vec2 margin = (tangent_clamp - 1.0) * 0.5 * size / c.focal;
    lowest = -(c.principal / c.focal + margin);
    highest = (size - c.principal) / c.focal + margin;
}
