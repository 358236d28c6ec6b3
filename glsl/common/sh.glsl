// Real spherical harmonics up to degree 3 in the order and with the signs of the 3DGS files.
const float SH0 = 0.28209479177387814;
const float SH1 = 0.4886025119029199;
const float SH2[5] = float[](1.0925484305920792, -1.0925484305920792, 0.31539156525252005,
                             -1.0925484305920792, 0.5462742152960396);
const float SH3[7] = float[](-0.5900435899266435, 2.890611442640554, -0.4570457994644658,
                             0.3731763325901154, -0.4570457994644658, 1.445305721320277,
                             -0.5900435899266435);

void sh_band1(vec3 d, out float b[3]) {
    b[0] = -SH1 * d.y;
    b[1] = SH1 * d.z;
    b[2] = -SH1 * d.x;
}

void sh_band2(vec3 d, out float b[5]) {
    vec3 s = d * d;
    b[0] = SH2[0] * d.x * d.y;
    b[1] = SH2[1] * d.y * d.z;
    b[2] = SH2[2] * (2.0 * s.z - s.x - s.y);
    b[3] = SH2[3] * d.x * d.z;
    b[4] = SH2[4] * (s.x - s.y);
}

void sh_band3(vec3 d, out float b[7]) {
    vec3 s = d * d;
    b[0] = SH3[0] * d.y * (3.0 * s.x - s.y);
    b[1] = SH3[1] * d.x * d.y * d.z;
    b[2] = SH3[2] * d.y * (4.0 * s.z - s.x - s.y);
    b[3] = SH3[3] * d.z * (2.0 * s.z - 3.0 * s.x - 3.0 * s.y);
    b[4] = SH3[4] * d.x * (4.0 * s.z - s.x - s.y);
    b[5] = SH3[5] * d.z * (s.x - s.y);
    b[6] = SH3[6] * d.x * (s.x - 3.0 * s.y);
}

// Derivatives of each basis function with respect to the direction.
void sh_band1_gradient(out vec3 g[3]) {
    g[0] = vec3(0.0, -SH1, 0.0);
    g[1] = vec3(0.0, 0.0, SH1);
    g[2] = vec3(-SH1, 0.0, 0.0);
}

void sh_band2_gradient(vec3 d, out vec3 g[5]) {
    g[0] = SH2[0] * vec3(d.y, d.x, 0.0);
    g[1] = SH2[1] * vec3(0.0, d.z, d.y);
    g[2] = SH2[2] * vec3(-2.0 * d.x, -2.0 * d.y, 4.0 * d.z);
    g[3] = SH2[3] * vec3(d.z, 0.0, d.x);
    g[4] = SH2[4] * vec3(2.0 * d.x, -2.0 * d.y, 0.0);
}

void sh_band3_gradient(vec3 d, out vec3 g[7]) {
    vec3 s = d * d;
    g[0] = SH3[0] * vec3(6.0 * d.x * d.y, 3.0 * s.x - 3.0 * s.y, 0.0);
    g[1] = SH3[1] * vec3(d.y * d.z, d.x * d.z, d.x * d.y);
    g[2] = SH3[2] * vec3(-2.0 * d.x * d.y, 4.0 * s.z - s.x - 3.0 * s.y, 8.0 * d.y * d.z);
    g[3] = SH3[3] * vec3(-6.0 * d.x * d.z, -6.0 * d.y * d.z, 6.0 * s.z - 3.0 * s.x - 3.0 * s.y);
    g[4] = SH3[4] * vec3(4.0 * s.z - 3.0 * s.x - s.y, -2.0 * d.x * d.y, 8.0 * d.x * d.z);
    g[5] = SH3[5] * vec3(2.0 * d.x * d.z, -2.0 * d.y * d.z, s.x - s.y);
    g[6] = SH3[6] * vec3(3.0 * s.x - 3.0 * s.y, -6.0 * d.x * d.y, 0.0);
}
