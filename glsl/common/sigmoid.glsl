// The logistic function and its derivative. In both, the exponential is at most 1.
float sigmoid(float x) {
    float e = exp(-abs(x));
    return x >= 0.0 ? 1.0 / (1.0 + e) : e / (1.0 + e);
}

// The derivative, sigmoid(x) · sigmoid(-x). Computing the second factor as 1 - sigmoid(x) would
// lose a decimal digit for every 2.3 of x above 0 (case render/opacity_slopes).
float sigmoid_slope(float x) {
    float e = exp(-abs(x));
    return e / (1.0 + e) / (1.0 + e);
}
