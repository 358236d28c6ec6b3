//! Settings of density control.

/// Which Gaussians take part in a round of relocation. It restricts relocation so that dead dynamic
/// Gaussians move onto dynamic ones, and static ones onto static ones.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub enum MotionClass {
    /// All Gaussians.
    Any = 0,
    /// Those whose motion logit is 0 or less; all in a scene without motion logits.
    Static = 1,
    /// Those whose motion logit is above 0.
    Dynamic = 2,
}

impl MotionClass {
    /// The largest integer weight when sampling from `count` Gaussians: it keeps the sum of all
    /// weights below 2³².
    pub fn largest_weight(count: usize) -> u32 {
        (u32::MAX as usize / count.max(1)).clamp(1, 65_535) as u32
    }
}

/// Thresholds of adaptive control.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AdaptSettings {
    /// Mean screen-space gradient norm above which a Gaussian is cloned or split.
    pub gradient: f64,
    /// Largest scale up to which it is cloned rather than split.
    pub small: f64,
    /// Opacity below which it is pruned.
    pub opacity: f64,
    /// Largest scale beyond which it is pruned; infinite for never.
    pub large: f64,
}

impl Default for AdaptSettings {
    /// The thresholds of 3D Gaussian Splatting, for a scene of radius 1; large Gaussians are kept.
    fn default() -> Self {
        AdaptSettings { gradient: 2e-4, small: 0.01, opacity: 0.005, large: f64::INFINITY }
    }
}

impl AdaptSettings {
    /// The scales of a split Gaussian's parts are divided by this factor.
    pub const SPLIT_SHRINK: f64 = 1.6;
}
