//! Every number that training depends on.

use crate::types::RenderSettings;

/// Learning rates. Positions decay exponentially from the first to the last value over the steps and
/// are in units of the scene's extent; the others are constant.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rates {
    /// Positions, at the first step.
    pub position: f64,
    /// Positions, at the last step.
    pub position_last: f64,
    /// Logarithms of the scales.
    pub log_scale: f64,
    /// Quaternions.
    pub rotation: f64,
    /// Opacity logits.
    pub opacity: f64,
    /// The constant spherical harmonic.
    pub sh0: f64,
    /// The other bands.
    pub sh_rest: f64,
}

impl Default for Rates {
    /// 3D Gaussian Splatting's.
    fn default() -> Self {
        Rates {
            position: 1.6e-4,
            position_last: 1.6e-6,
            log_scale: 5e-3,
            rotation: 1e-3,
            opacity: 0.05,
            sh0: 2.5e-3,
            sh_rest: 1.25e-4,
        }
    }
}

/// MCMC density control (3DGS-MCMC): a share of new Gaussians every so often, the dead move to the
/// living, noise moves the faint ones, and two regularisers keep opacity and scale small.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GrowthSettings {
    /// First step with a round.
    pub from: u32,
    /// Share of the steps after which rounds end.
    pub until: f64,
    /// Steps between rounds.
    pub every: u32,
    /// Number of Gaussians after a round over that before.
    pub factor: f64,
    /// Weight of the mean opacity in the loss.
    pub opacity_weight: f64,
    /// Weight of the mean scale in the loss.
    pub scale_weight: f64,
    /// Size of the noise, in units of the positions' learning rate.
    pub noise: f64,
}

impl Default for GrowthSettings {
    fn default() -> Self {
        GrowthSettings {
            from: 500,
            until: 0.85,
            every: 100,
            factor: 1.05,
            opacity_weight: 0.01,
            scale_weight: 0.01,
            noise: 5e5,
        }
    }
}

/// How motion is trained.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MotionSettings {
    /// Learning rate of network and radii at the first step.
    pub rate: f64,
    /// At the last step.
    pub rate_last: f64,
    /// Weight of the as-rigid-as-possible energy.
    pub arap_weight: f64,
    /// Edges of a control point in that energy.
    pub arap_edges: usize,
}

impl Default for MotionSettings {
    /// SC-GS's learning rates.
    fn default() -> Self {
        MotionSettings { rate: 8e-4, rate_last: 1.6e-6, arap_weight: 1e-2, arap_edges: 10 }
    }
}

/// How a scene is trained.
#[derive(Clone, Debug, PartialEq)]
pub struct TrainSettings {
    /// Number of steps, one picture each.
    pub steps: u32,
    /// Growth ends here.
    pub max_gaussians: usize,
    /// Highest degree of the spherical harmonics.
    pub sh_degree: u32,
    /// A band is added each time so many steps have passed; 0 uses all bands from the first step.
    pub sh_interval: u32,
    /// Learning rates.
    pub rates: Rates,
    /// λ, the share of D-SSIM in the loss.
    pub ssim_share: f32,
    /// Factor of the depth term, where a depth is known.
    pub depth_scale: f32,
    /// Behind everything.
    pub background: [f32; 3],
    /// Constants of blending.
    pub render: RenderSettings,
    /// Density control; `None` keeps the Gaussians that there are.
    pub growth: Option<GrowthSettings>,
    /// How motion is trained, where there is any.
    pub motion: MotionSettings,
    /// Decides the order of the pictures and everything random.
    pub seed: u64,
}

impl Default for TrainSettings {
    fn default() -> Self {
        TrainSettings {
            steps: 30_000,
            max_gaussians: 1_000_000,
            sh_degree: 3,
            sh_interval: 1000,
            rates: Rates::default(),
            ssim_share: 0.2,
            depth_scale: 0.0,
            background: [0.0; 3],
            render: RenderSettings::default(),
            growth: Some(GrowthSettings::default()),
            motion: MotionSettings::default(),
            seed: 0,
        }
    }
}

impl TrainSettings {
    /// The degree of the spherical harmonics at a step.
    pub fn sh_degree_at(&self, step: u32) -> u32 {
        match self.sh_interval {
            0 => self.sh_degree,
            interval => self.sh_degree.min(step / interval),
        }
    }

    /// The positions' learning rate at a step, in units of the scene's extent.
    pub fn position_rate_at(&self, step: u32) -> f64 {
        exponential(self.rates.position, self.rates.position_last, step, self.steps)
    }
}

/// Log-linear from `first` at step 0 to `last` at step `steps`.
pub fn exponential(first: f64, last: f64, step: u32, steps: u32) -> f64 {
    let share = (f64::from(step) / f64::from(steps.max(1))).min(1.0);
    (first.ln() * (1.0 - share) + last.ln() * share).exp()
}
