//! Settings of the Adam optimiser.

/// The settings of one Adam step for one group of parameters.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AdamSettings {
    /// Learning rate of the group.
    pub rate: f64,
    /// Decay of the first moment.
    pub beta1: f64,
    /// Decay of the second moment.
    pub beta2: f64,
    /// Added to the root of the second moment.
    pub epsilon: f64,
    /// Number of this step, from 1.
    pub step: u32,
}

impl Default for AdamSettings {
    /// The usual values for Gaussian splatting.
    fn default() -> Self {
        AdamSettings { rate: 1e-3, beta1: 0.9, beta2: 0.999, epsilon: 1e-15, step: 1 }
    }
}
