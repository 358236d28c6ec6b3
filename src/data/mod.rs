//! Video and dataset readers, and synthetic clips with exact ground truth.

pub mod synth;
