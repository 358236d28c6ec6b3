// Sine and cosine to f32 precision. Vulkan guarantees only an absolute error of 2^-11 for sin()
// within [-pi, pi], and some drivers are no more precise than that. The argument is reduced by a
// multiple of pi/2, subtracted in three parts (Cody-Waite), which is accurate for |x| up to about
// ten thousand. Taylor polynomials then give both functions.
void sine_cosine(float x, out float s, out float c) {
    float n = round(x * 0.6366197723675814);
    precise float r = x - n * 1.5703125;
    r = r - n * 4.837512969970703e-4;
    r = r - n * 7.549789948768648e-8;
    float z = r * r;
    float sine = r + r * z * (-1.6666666666e-1 + z * (8.3333331e-3 + z * (-1.98412698e-4 + z * 2.75573e-6)));
    float cosine = 1.0 - 0.5 * z
        + z * z * (4.1666668e-2 + z * (-1.38888889e-3 + z * (2.4801587e-5 - z * 2.755732e-7)));
    uint quadrant = uint(int(n)) & 3u;
    bool swapped = (quadrant & 1u) != 0u;
    float a = swapped ? cosine : sine;
    float b = swapped ? sine : cosine;
    s = quadrant >= 2u ? -a : a;
    c = (quadrant == 1u || quadrant == 2u) ? -b : b;
}
