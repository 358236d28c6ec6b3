// The window of SSIM, and the convolution along one axis that the loss kernels share.
//
// An invocation processes a run of adjacent pixels and loads each value once. It adds each value,
// tap by tap, to the WINDOW outputs that depend on it. An output that has received its last value
// is complete and is stored (a filter in its transposed form). A pass thus costs little more than
// its loads and stores, which are the most expensive operations on software devices, and the order
// of an output's sum does not depend on the length of the run.
const int WINDOW = 11;
const int HALF = 5;
const float C1 = 1e-4;
const float C2 = 9e-4;
// Gaussian window exp(-d²/(2·1.5²)), normalised to sum 1.
const float TAPS[WINDOW] =
    float[](0.0010283801, 0.0075987581, 0.0360007721, 0.1093606895, 0.2130055377, 0.2660117249,
            0.2130055377, 0.1093606895, 0.0360007721, 0.0075987581, 0.0010283801);

// Adds the value at position p to the sums. sums[0] is then the window's output at p − HALF.
#define SLIDE(sums, value)                                                                         \
    {                                                                                              \
        [[unroll]] for (int k = 0; k < WINDOW - 1; k++) {                                          \
            sums[k] = sums[k + 1] + TAPS[k] * (value);                                             \
        }                                                                                          \
        sums[WINDOW - 1] = TAPS[WINDOW - 1] * (value);                                             \
    }

// Channel `channel` of a reference image's packed pixel, in [0, 1]. The fourth byte is the pixel's
// weight.
float unpack(uint packed_pixel, uint channel) {
    return float((packed_pixel >> (8u * channel)) & 0xffu) / 255.0;
}
