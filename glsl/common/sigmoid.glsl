// The logistic function and its slope. Both keep the exponential at most 1.
float sigmoid(float x) {
    float e = exp(-abs(x));
    return x >= 0.0 ? 1.0 / (1.0 + e) : e / (1.0 + e);
}

// sigmoid(x) · sigmoid(-x): as 1 - sigmoid it would lose a digit for every 2.3 of x above 0
// (case render/opacity_slopes).
float sigmoid_slope(float x) {
    float e = exp(-abs(x));
    return e / (1.0 + e) / (1.0 + e);
}
