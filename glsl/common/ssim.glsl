// The window of SSIM and how the loss kernels walk over an image.
//
// Every pass blurs along one axis. An invocation makes RUN neighbouring outputs of one channel, so
// that a loaded value serves up to WINDOW of them.
const int WINDOW = 11;
const int HALF = 5;
const int RUN = 8;
const int SPAN = RUN + 2 * HALF;
const float C1 = 1e-4;
const float C2 = 9e-4;
// exp(-d²/(2·1.5²)), normalised to sum 1.
const float TAPS[WINDOW] =
    float[](0.0010283801, 0.0075987581, 0.0360007721, 0.1093606895, 0.2130055377, 0.2660117249,
            0.2130055377, 0.1093606895, 0.0360007721, 0.0075987581, 0.0010283801);

// Channel `channel` of a photograph's packed pixel; the fourth byte is the pixel's weight.
float unpack(uint packed_pixel, uint channel) {
    return float((packed_pixel >> (8u * channel)) & 0xffu) / 255.0;
}
