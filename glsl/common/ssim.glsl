// The window of SSIM and how the loss kernels walk over an image.
//
// Every pass blurs along one axis. An invocation walks over a run of neighbouring pixels and loads
// each value once: a value is added, tap by tap, to the WINDOW outputs that it belongs to, and the
// output that has seen its last value leaves (a filter in its transposed form). So a pass costs its
// loads and stores, which is what software devices pay most for, and an output's sum has the same
// order whatever the length of the run.
const int WINDOW = 11;
const int HALF = 5;
const float C1 = 1e-4;
const float C2 = 9e-4;
// exp(-d²/(2·1.5²)), normalised to sum 1.
const float TAPS[WINDOW] =
    float[](0.0010283801, 0.0075987581, 0.0360007721, 0.1093606895, 0.2130055377, 0.2660117249,
            0.2130055377, 0.1093606895, 0.0360007721, 0.0075987581, 0.0010283801);

// Takes the value at a place p into the sums; sums[0] is then the window's output at p − HALF.
#define SLIDE(sums, value)                                                                         \
    {                                                                                              \
        [[unroll]] for (int k = 0; k < WINDOW - 1; k++) {                                          \
            sums[k] = sums[k + 1] + TAPS[k] * (value);                                             \
        }                                                                                          \
        sums[WINDOW - 1] = TAPS[WINDOW - 1] * (value);                                             \
    }

// Channel `channel` of a reference image's packed pixel; the fourth byte is the pixel's weight.
float unpack(uint packed_pixel, uint channel) {
    return float((packed_pixel >> (8u * channel)) & 0xffu) / 255.0;
}
