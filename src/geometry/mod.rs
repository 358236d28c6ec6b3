//! SE(3), Sim(3), PnP, RANSAC, two-view geometry and bundle adjustment, in f64.
