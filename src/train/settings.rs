//! Every number that training depends on.

use crate::types::{DEPTH_BITS, RasterKind, RenderSettings};

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

/// How Gaussians are added, moved and removed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum GrowthSettings {
    /// The dead move to the living.
    Mcmc(McmcSettings),
    /// Clone, split, prune.
    Adaptive(AdaptiveSettings),
}

impl Default for GrowthSettings {
    fn default() -> Self {
        GrowthSettings::Mcmc(McmcSettings::default())
    }
}

/// MCMC density control (3DGS-MCMC): a share of new Gaussians every so often, the dead move to the
/// living, noise moves the faint ones, and two regularisers keep opacity and scale small.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct McmcSettings {
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

impl McmcSettings {
    /// Whether a round is due after a step, as long as there are rounds.
    pub(super) fn due(&self, step: u32) -> bool {
        step >= self.from && step.is_multiple_of(self.every)
    }

    /// The last of so many steps that may have a round.
    pub(super) fn last_of(&self, steps: u32) -> u32 {
        (f64::from(steps) * self.until) as u32
    }

    /// Gaussians that a round adds to so many where there is room.
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

/// Adaptive density control (3D Gaussian Splatting): a Gaussian whose place in the picture the loss
/// keeps pulling at is cloned where it is small and split where it is large; faint and huge ones
/// are pruned; now and then all opacities fall, so that what the pictures do not need stays faint.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AdaptiveSettings {
    /// First step with a round.
    pub from: u32,
    /// Share of the steps after which rounds end.
    pub until: f64,
    /// Steps between rounds.
    pub every: u32,
    /// Mean gradient by the place in the picture, in units of half the picture, above which a
    /// Gaussian is cloned or split.
    pub gradient: f64,
    /// Largest scale that is cloned rather than split, in units of the scene's reach: the cameras'
    /// extent or the median distance of the first Gaussians from the cameras' middle, whichever is
    /// more. (The source knows the extent only; a camera that hardly moves has next to none.)
    pub small: f64,
    /// Largest scale that is kept, in units of the scene's reach, once opacities have been reset.
    pub large: f64,
    /// Opacity below which a Gaussian is pruned.
    pub opacity: f64,
    /// Steps between two resets of the opacity; 0 for none.
    pub reset_every: u32,
    /// No opacity is above this after a reset.
    pub reset_opacity: f64,
}

impl AdaptiveSettings {
    /// 3D Gaussian Splatting's schedule, made for 30,000 steps, in proportion to `steps`. Two things
    /// do not shrink with the schedule: a round's statistics need some 25 pictures, and opacities
    /// need some 500 steps to recover from a reset.
    pub fn scaled_to(steps: u32) -> AdaptiveSettings {
        let scaled = |of_30k: f64| (of_30k * f64::from(steps) / 30_000.0).round() as u32;
        let every = scaled(100.0).clamp(25, 100);
        AdaptiveSettings {
            from: scaled(500.0).max(every),
            until: 0.5,
            every,
            gradient: 2e-4,
            small: 0.01,
            large: 0.1,
            opacity: 0.005,
            reset_every: scaled(3000.0).max(500),
            reset_opacity: 0.01,
        }
    }
}

/// How control points are added where the loss pulls, and removed where nothing follows them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ControlSettings {
    /// Steps between rounds.
    pub every: u32,
    /// Share of the steps after which rounds end.
    pub until: f64,
    /// Most control points.
    pub most: usize,
    /// A control point gets company where its importance is more than so many times the median.
    pub above: f64,
    /// Most that are added in a round, as a share of those that there are.
    pub share: f64,
}

impl ControlSettings {
    /// Some eight rounds' time in `steps`, at most 500 steps apart, the last ones left out so that
    /// everything settles; up to `most` control points. Importances are means over many followers
    /// and differ little: twice the median is rare.
    pub fn scaled_to(steps: u32, most: usize) -> ControlSettings {
        let every = (steps / 8).clamp(100, 500);
        ControlSettings { every, until: 0.7, most, above: 1.5, share: 0.05 }
    }

    /// Whether a round is due after `step` of `steps`.
    pub(super) fn due(&self, step: u32, steps: u32) -> bool {
        step.is_multiple_of(self.every.max(1)) && f64::from(step) <= f64::from(steps) * self.until
    }
}

/// How it is trained which Gaussians move. Up to a step motion is soft: a Gaussian moves by its
/// probability of motion; from there on it moves fully or not at all.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SelectionSettings {
    /// Learning rate of the motion logits.
    pub rate: f64,
    /// Share of the steps in which motion is soft.
    pub until: f64,
    /// Logit below which a Gaussian is clearly static: it neither moves nor pays for it.
    pub least_logit: f32,
    /// Weight of the mask loss at the first step, on average over all steps.
    pub mask_weight: f64,
    /// At the last step with soft motion.
    pub mask_weight_last: f64,
    /// Steps between pictures with a mask loss.
    pub mask_every: u32,
    /// λ_rigid: weight of the mean squared displacement of what the masks show to be still.
    pub rigid_weight: f64,
}

impl SelectionSettings {
    /// For so many steps. A logit's way is its rate times its steps: SC-GS's rate of 2.5e-3, there
    /// over 10,000 steps with a mask loss, goes up as these become fewer, to 0.1 at most.
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

    /// The steps of `steps` in which motion is soft.
    pub(super) fn steps_of(&self, steps: u32) -> u32 {
        (f64::from(steps) * self.until.clamp(0.0, 1.0)) as u32
    }
}

/// How motion is trained.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MotionSettings {
    /// Learning rate of network and radii at the first step.
    pub rate: f64,
    /// At the last step.
    pub rate_last: f64,
    /// Learning rate of the control points' paths at the first step.
    pub path_rate: f64,
    /// At the last step.
    pub path_rate_last: f64,
    /// Weight of the as-rigid-as-possible energy.
    pub arap_weight: f64,
    /// Edges of a control point in that energy.
    pub arap_edges: usize,
    /// How control points are added and removed; `None` keeps those that there are.
    pub control: Option<ControlSettings>,
    /// How it is trained which Gaussians move; `None` keeps their motion logits.
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
    /// The unit of the positions' learning rate; `None`: the extent of the cameras.
    pub position_unit: Option<f64>,
    /// λ, the share of D-SSIM in the loss.
    pub ssim_share: f32,
    /// Factor of the depth term, where a depth is known.
    pub depth_scale: f32,
    /// Behind everything.
    pub background: [f32; 3],
    /// Constants of blending.
    pub render: RenderSettings,
    /// How many of a depth's bits decide the order of splats; see
    /// [`Tuning::depth_bits`](crate::types::Tuning::depth_bits).
    pub depth_bits: u32,
    /// How an image is blended.
    pub raster: RasterKind,
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
    /// The usual settings for a run of so many steps: where it is shorter than 30,000, the bands of the
    /// spherical harmonics come sooner in proportion, so that they are trained at all.
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

    /// The number of Gaussians that training can reach from `first`, at most.
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
