//! The settings of training.

use crate::types::{AdaptSettings, DEPTH_BITS, RasterKind, RenderSettings};

/// Learning rates. The rate of positions decays exponentially from the first to the last value over the
/// steps and is in units of the scene's extent; the others are constant.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rates {
    /// Rate of positions at the first step.
    pub position: f64,
    /// Rate of positions at the last step.
    pub position_last: f64,
    /// Rate of the logarithms of the scales.
    pub log_scale: f64,
    /// Rate of the quaternions.
    pub rotation: f64,
    /// Rate of the opacity logits.
    pub opacity: f64,
    /// Rate of the constant spherical harmonic (band 0).
    pub sh0: f64,
    /// Rate of the other bands of the spherical harmonics.
    pub sh_rest: f64,
}

impl Default for Rates {
    /// The rates of 3D Gaussian Splatting.
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

/// How Gaussians are added, moved and removed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum GrowthSettings {
    /// MCMC: dead Gaussians move to live ones.
    Mcmc(McmcSettings),
    /// Adaptive control: clone, split, prune.
    Adaptive(AdaptiveSettings),
}

impl Default for GrowthSettings {
    fn default() -> Self {
        GrowthSettings::Mcmc(McmcSettings::default())
    }
}

/// MCMC density control (3DGS-MCMC). At intervals the number of Gaussians grows by a factor and dead
/// Gaussians move to live ones. Noise moves the faint ones, and two regularisers keep opacity and scale
/// small.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct McmcSettings {
    /// First step that may have a round.
    pub from: u32,
    /// Share of the steps after which rounds end.
    pub until: f64,
    /// Steps between rounds.
    pub every: u32,
    /// Factor by which a round grows the number of Gaussians.
    pub factor: f64,
    /// Weight of the mean opacity in the loss.
    pub opacity_weight: f64,
    /// Weight of the mean scale in the loss.
    pub scale_weight: f64,
    /// Size of the noise, in units of the positions' learning rate.
    pub noise: f64,
}

impl McmcSettings {
    /// Whether a round is due after a step, if rounds have not ended.
    pub(super) fn due(&self, step: u32) -> bool {
        step >= self.from && step.is_multiple_of(self.every)
    }

    /// The last step that may have a round, in a training of `steps` steps.
    pub(super) fn last_of(&self, steps: u32) -> u32 {
        (f64::from(steps) * self.until) as u32
    }

    /// Number of Gaussians that a round adds to `gaussians`, if the capacity allows.
    pub(super) fn wanted(&self, gaussians: usize) -> usize {
        (gaussians as f64 * (self.factor - 1.0)).ceil() as usize
    }
}

impl Default for McmcSettings {
    fn default() -> Self {
        McmcSettings {
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

/// Adaptive density control (3D Gaussian Splatting). A Gaussian with a large mean gradient with respect
/// to its image position is cloned if it is small and split if it is large. Faint and very large ones
/// are pruned. At intervals all opacities are reset, so that Gaussians that no image needs stay faint.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AdaptiveSettings {
    /// First step that may have a round.
    pub from: u32,
    /// Share of the steps after which rounds end.
    pub until: f64,
    /// Steps between rounds.
    pub every: u32,
    /// Mean norm of the gradient with respect to the image position, in units of half the image, above
    /// which a Gaussian is cloned or split.
    pub gradient: f64,
    /// Largest scale that is cloned rather than split, in units of the scene radius: the larger of the
    /// cameras' extent and the median distance of the first Gaussians from the cameras' mean centre.
    /// (The source uses the extent only, which is almost 0 for a camera that hardly moves.)
    pub small: f64,
    /// Largest scale that is kept after the first opacity reset, in units of the scene radius.
    pub large: f64,
    /// Opacity below which a Gaussian is pruned.
    pub opacity: f64,
    /// Steps between two resets of the opacity; 0 for none.
    pub reset_every: u32,
    /// Upper limit of the opacities after a reset.
    pub reset_opacity: f64,
}

impl Default for AdaptiveSettings {
    /// The schedule for the default number of steps.
    fn default() -> Self {
        AdaptiveSettings::scaled_to(TrainSettings::default().steps)
    }
}

impl AdaptiveSettings {
    /// The schedule of 3D Gaussian Splatting, made for 30,000 steps, scaled in proportion to `steps`.
    /// Two intervals have lower limits: a round's statistics need about 25 images, and opacities need
    /// about 500 steps to recover from a reset.
    pub fn scaled_to(steps: u32) -> AdaptiveSettings {
        let scaled = |of_30k: f64| (of_30k * f64::from(steps) / 30_000.0).round() as u32;
        let every = scaled(100.0).clamp(25, 100);
        let AdaptSettings { gradient, small, opacity, .. } = AdaptSettings::default();
        AdaptiveSettings {
            from: scaled(500.0).max(every),
            until: 0.5,
            every,
            gradient,
            small,
            large: 0.1,
            opacity,
            reset_every: scaled(3000.0).max(500),
            reset_opacity: 0.01,
        }
    }
}

/// How control points are added where the loss has large gradients, and removed where no Gaussian
/// follows them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ControlSettings {
    /// Steps between rounds.
    pub every: u32,
    /// Share of the steps after which rounds end.
    pub until: f64,
    /// Largest number of control points.
    pub most: usize,
    /// A control point is added beside one whose importance is more than this many times the median.
    pub above: f64,
    /// Largest number added in a round, as a share of the present control points.
    pub share: f64,
}

impl Default for ControlSettings {
    /// The settings for the default number of steps, and up to 256 control points.
    fn default() -> Self {
        ControlSettings::scaled_to(TrainSettings::default().steps, 256)
    }
}

impl ControlSettings {
    /// About eight intervals in `steps`, each 100 to 500 steps; no rounds in the last part, so that the
    /// motion settles. Up to `most` control points. Importances are means over many followers and differ
    /// little; values above twice the median are rare.
    pub fn scaled_to(steps: u32, most: usize) -> ControlSettings {
        let every = (steps / 8).clamp(100, 500);
        ControlSettings { every, until: 0.7, most, above: 1.5, share: 0.05 }
    }

    /// Whether a round is due after `step` of `steps`.
    pub(super) fn due(&self, step: u32, steps: u32) -> bool {
        step.is_multiple_of(self.every.max(1)) && f64::from(step) <= f64::from(steps) * self.until
    }
}

/// Training of the motion logits, which decide which Gaussians move. In the first part of the steps
/// motion is soft: a Gaussian's motion is weighted by its probability of motion. After that it moves
/// fully or not at all.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SelectionSettings {
    /// Learning rate of the motion logits.
    pub rate: f64,
    /// Share of the steps in which motion is soft.
    pub until: f64,
    /// Logit below which a Gaussian is treated as static: it does not move and has no rigidity term.
    pub least_logit: f32,
    /// Weight of the mask loss at the first step, on average over all steps.
    pub mask_weight: f64,
    /// Weight of the mask loss at the last step with soft motion.
    pub mask_weight_last: f64,
    /// Steps between two steps with a mask loss.
    pub mask_every: u32,
    /// λ_rigid: weight of the mean squared displacement of Gaussians that the masks show to be static.
    pub rigid_weight: f64,
}

impl Default for SelectionSettings {
    /// The settings for the default number of steps.
    fn default() -> Self {
        SelectionSettings::scaled_to(TrainSettings::default().steps)
    }
}

impl SelectionSettings {
    /// Settings for a number of steps. A logit can change by about its rate times its steps. SC-GS uses
    /// a rate of 2.5e-3 over 10,000 steps with a mask loss; the rate rises as the steps become fewer, to
    /// at most 0.1.
    pub fn scaled_to(steps: u32) -> SelectionSettings {
        let until = 0.6;
        SelectionSettings {
            rate: (25.0 / (until * f64::from(steps.max(1)))).clamp(2.5e-3, 0.1),
            until,
            least_logit: -2.0,
            mask_weight: 0.5,
            mask_weight_last: 1e-2,
            mask_every: 4,
            rigid_weight: 1e-2,
        }
    }

    /// Number of steps with soft motion in a training of `steps` steps.
    pub(super) fn steps_of(&self, steps: u32) -> u32 {
        (f64::from(steps) * self.until.clamp(0.0, 1.0)) as u32
    }
}

/// How motion is trained.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MotionSettings {
    /// Learning rate of the network and of the radii at the first step.
    pub rate: f64,
    /// Learning rate of the network and of the radii at the last step.
    pub rate_last: f64,
    /// Learning rate of the control points' paths at the first step.
    pub path_rate: f64,
    /// Learning rate of the control points' paths at the last step.
    pub path_rate_last: f64,
    /// Weight of the as-rigid-as-possible energy.
    pub arap_weight: f64,
    /// Number of edges of a control point in that energy.
    pub arap_edges: usize,
    /// How control points are added and removed; `None` keeps the initial ones.
    pub control: Option<ControlSettings>,
    /// How the motion logits are trained; `None` keeps them.
    pub selection: Option<SelectionSettings>,
}

impl Default for MotionSettings {
    /// SC-GS's learning rates.
    fn default() -> Self {
        MotionSettings {
            rate: 8e-4,
            rate_last: 1.6e-6,
            path_rate: 4e-4,
            path_rate_last: 1e-5,
            arap_weight: 1e-2,
            arap_edges: 10,
            control: None,
            selection: None,
        }
    }
}

/// How a scene is trained.
#[derive(Clone, Debug, PartialEq)]
pub struct TrainSettings {
    /// Number of steps, one view each.
    pub steps: u32,
    /// Largest number of Gaussians that growth may reach.
    pub max_gaussians: usize,
    /// Highest degree of the spherical harmonics.
    pub sh_degree: u32,
    /// Steps between two additions of a band; 0 uses all bands from the first step.
    pub sh_interval: u32,
    /// Learning rates.
    pub rates: Rates,
    /// The unit of the positions' learning rate, world units; `None` for the extent of the cameras.
    pub position_unit: Option<f64>,
    /// λ, the share of D-SSIM in the loss.
    pub ssim_share: f32,
    /// Factor of the depth term, for pixels with a known depth.
    pub depth_scale: f32,
    /// Background colour, RGB.
    pub background: [f32; 3],
    /// Settings of projection and blending.
    pub render: RenderSettings,
    /// Number of a depth's bits that decide the order of splats; see
    /// [`Tuning::depth_bits`](crate::types::Tuning::depth_bits).
    pub depth_bits: u32,
    /// The blending kernel.
    pub raster: RasterKind,
    /// Density control; `None` keeps the initial Gaussians.
    pub growth: Option<GrowthSettings>,
    /// How motion is trained, if the scene moves.
    pub motion: MotionSettings,
    /// Seed of everything random, including the order of the views.
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
            position_unit: None,
            ssim_share: 0.2,
            depth_scale: 0.0,
            background: [0.0; 3],
            render: RenderSettings::default(),
            depth_bits: DEPTH_BITS,
            raster: RasterKind::default(),
            growth: Some(GrowthSettings::default()),
            motion: MotionSettings::default(),
            seed: 0,
        }
    }
}

impl TrainSettings {
    /// The default settings for a training of `steps` steps. For fewer than 30,000 steps the bands of
    /// the spherical harmonics are added sooner in proportion, so that they are trained at all.
    pub fn of_steps(steps: u32) -> TrainSettings {
        let usual = TrainSettings::default();
        let interval = u64::from(usual.sh_interval) * u64::from(steps.min(usual.steps))
            / u64::from(usual.steps);
        TrainSettings { steps, sh_interval: (interval as u32).clamp(1, usual.sh_interval), ..usual }
    }

    /// The degree of the spherical harmonics at a step.
    pub fn sh_degree_at(&self, step: u32) -> u32 {
        match self.sh_interval {
            0 => self.sh_degree,
            interval => self.sh_degree.min(step / interval),
        }
    }

    /// Upper bound of the number of Gaussians in a training that begins with `first`.
    pub(super) fn reachable(&self, first: usize) -> usize {
        let most = self.max_gaussians.max(first);
        match self.growth {
            None => first,
            Some(GrowthSettings::Adaptive(_)) => most,
            Some(GrowthSettings::Mcmc(mcmc)) => {
                let rounds = (1..=mcmc.last_of(self.steps)).filter(|&step| mcmc.due(step));
                let grown = |n: usize, _| n.saturating_add(mcmc.wanted(n)).min(most);
                rounds.fold(first, grown)
            }
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn buffers_are_as_large_as_growth_can_reach() {
        let mcmc = |steps| TrainSettings { steps, max_gaussians: 1000, ..Default::default() };
        // Rounds after steps 500, 600, 700 and 800 of 1000, each of 5 % rounded up: in floats 5 % of
        // 100 are a little more than 5.
        assert_eq!(mcmc(1000).reachable(100), 124);
        assert_eq!(mcmc(30_000).reachable(100), 1000);
        assert_eq!(mcmc(400).reachable(100), 100, "no round");
        assert_eq!(mcmc(30_000).reachable(2000), 2000, "there already");
        let kept = TrainSettings { growth: None, ..mcmc(30_000) };
        assert_eq!(kept.reachable(100), 100);
    }
}
