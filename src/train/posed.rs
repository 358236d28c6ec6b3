//! From posed images of a moving scene to a 4D scene, without motion masks: every Gaussian follows the
//! control points, and static parts learn not to move.
//!
//! A static warm-up moves the Gaussians to the mean position of the subject. Control points are then
//! spread over them by farthest-point sampling, as in Sparse-Controlled Gaussian Splatting (Huang et
//! al., CVPR 2024), and everything is trained together.

use super::glimpse::Placed;
use super::motion::MotionStart;
use super::observer::{Checkpoint, Observer, Phase, run};
use super::scale::TrainingScale;
use super::seed::first_logit;
use super::sequence;
use super::settings::{
    ControlSettings, GrowthSettings, McmcSettings, MotionSettings, Rates, TrainSettings,
};
use super::trainer::Trainer;
use super::views::{TrainingView, scene_radius};
use crate::Result;
use crate::gpu::Device;
use crate::scene::Scene;
use crate::types::{ControlPoints, DeformNet, Gaussians, MotionScale, NetShape};

/// The motion model, and the length of the static warm-up.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PosedMotion {
    /// Share of the steps that the static warm-up takes.
    pub warm_up: f64,
    /// Largest number of control points.
    pub control_points: usize,
    /// The deformation network.
    pub network: NetShape,
    /// Number of control points that a Gaussian follows.
    pub neighbours: usize,
}

impl Default for PosedMotion {
    fn default() -> Self {
        PosedMotion {
            warm_up: 0.1,
            control_points: ControlSettings::default().most,
            network: NetShape {
                depth: 4,
                width: 128,
                skip: 2,
                position_frequencies: 6,
                time_frequencies: 6,
                position_octave: 0,
            },
            neighbours: 4,
        }
    }
}

/// Motion logit of every Gaussian.
const STRENGTH: f32 = 4.0;

/// Trains a scene on posed images, from the beginning or from a checkpoint of the same views and
/// settings: a moving scene, or a static one without `motion`. The scene has no cameras. The report of a
/// moving scene holds the number of control points that were added and removed (`control_points_added`,
/// `control_points_removed`), and the number of gradients that were not finite and were skipped
/// (`broken_gradients`).
///
/// The poses may have any unit. Training works in the unit of [`posed_unit`], which also applies to
/// `near` of the settings; the returned scene is in the unit of the poses. `views` are scaled during the
/// training and restored afterwards.
///
/// # Errors
/// As for [`Trainer::new`] and [`Trainer::step`]; [`Error::Input`](crate::Error::Input) for a checkpoint
/// of another training; [`Error::Failed`](crate::Error::Failed) where a number leaves its range in
/// training; any error of `observer`.
pub fn fit_posed(
    device: &Device,
    views: &mut [TrainingView],
    seeds: &Gaussians,
    motion: Option<&PosedMotion>,
    settings: &TrainSettings,
    resume: Option<Checkpoint>,
    observer: &mut dyn Observer,
) -> Result<Scene> {
    let unit = posed_unit(views, seeds);
    let mut first = Scene::of(seeds.clone());
    first.enlarge(1.0 / unit);
    enlarge(views, 1.0 / unit);
    let place = |scene: &mut Scene| {
        scene.settings = settings.render;
        scene.enlarge(unit);
    };
    let mut observer = Placed { inner: observer, place: &place };
    let fitted = fit(device, views, first.gaussians, motion, settings, resume, &mut observer);
    // Scaling by a power of two is exact.
    enlarge(views, unit);
    let mut scene = fitted?;
    place(&mut scene);
    sequence::sound(scene)
}

/// The unit in which [`fit_posed`] works: the power of two that brings the scene radius nearest to 4,
/// that of cameras on a sphere of radius 4. Rates and frequencies were chosen for this size.
pub fn posed_unit(views: &[TrainingView], seeds: &Gaussians) -> f64 {
    let octaves = (scene_radius(views, seeds) / USUAL_SCENE_RADIUS).log2().round();
    if octaves.abs() <= MOST_OCTAVES { octaves.exp2() } else { 1.0 }
}

/// The scene radius in the unit of training.
const USUAL_SCENE_RADIUS: f64 = 4.0;
/// Largest absolute exponent of a unit; a scene beyond it has a number out of range.
const MOST_OCTAVES: f64 = 40.0;

/// Scales the world of the views by `factor`: translations of the cameras, and disparities.
fn enlarge(views: &mut [TrainingView], factor: f64) {
    for view in views {
        view.camera.view_from_world.translation *= factor;
        let disparity = view.disparity.iter_mut().flat_map(|d| d.pixels.chunks_exact_mut(2));
        disparity.for_each(|pair| pair[0] /= factor as f32);
    }
}

/// As [`fit_posed`], in the unit of training.
fn fit(
    device: &Device,
    views: &[TrainingView],
    seeds: Gaussians,
    motion: Option<&PosedMotion>,
    settings: &TrainSettings,
    resume: Option<Checkpoint>,
    observer: &mut dyn Observer,
) -> Result<Scene> {
    let Some(motion) = motion else {
        return fit_static(device, views, &seeds, settings.clone(), resume, observer)
            .map(Scene::of);
    };
    let warm_up = ((f64::from(settings.steps) * motion.warm_up) as u32).min(settings.steps - 1);
    let joint = joint_settings(motion, settings, settings.steps - warm_up);
    let mut trainer = match resume {
        Some(Checkpoint::Joint(state)) => Trainer::resume(device, views, state, joint)?,
        earlier => {
            let mut gaussians = seeds;
            if warm_up > 0 {
                // Higher bands would explain motion by the view direction.
                let still = TrainSettings {
                    steps: warm_up,
                    growth: None,
                    max_gaussians: 0,
                    sh_interval: u32::MAX,
                    ..settings.clone()
                };
                gaussians = fit_static(device, views, &gaussians, still, earlier, observer)?;
            }
            gaussians.motion_logits = vec![STRENGTH; gaussians.len()];
            let start = MotionStart {
                points: spread(
                    &gaussians,
                    sequence::first_control_points(motion.control_points),
                    settings.seed,
                )?,
                network: Some(DeformNet::random(motion.network, settings.seed)),
                neighbours: motion.neighbours,
            };
            Trainer::new(device, views, &gaussians, Some(&start), joint)?
        }
    };
    run(&mut trainer, Phase::Joint, observer, Checkpoint::Joint)?;
    let mut scene = Scene::of(trainer.gaussians()?);
    if let Some((points, network)) = trainer.motion()? {
        scene.control_points = points;
        scene.network = network;
    }
    scene.neighbours = motion.neighbours.min(scene.control_points.len()) as u32;
    scene.report = sequence::report(&mut trainer)?;
    Ok(scene)
}

/// The size of the training of [`fit_posed`] at its largest, which is that of the joint training.
pub fn posed_scale(
    views: &[TrainingView],
    gaussians: usize,
    motion: Option<&PosedMotion>,
    settings: &TrainSettings,
) -> TrainingScale {
    let joint = match motion {
        Some(motion) => joint_settings(motion, settings, settings.steps),
        None => settings.clone(),
    };
    let scale = motion.map(|motion| MotionScale {
        control_points: motion.control_points,
        keys: 0,
        network: Some(motion.network),
        neighbours: motion.neighbours,
    });
    TrainingScale::new(views, gaussians, scale, joint)
}

/// Largest factor of the learning rates where there are fewer steps than they were made for.
const FASTEST: f64 = 3.0;

/// The settings of the joint training. Rates that were made for 30,000 steps are increased in proportion
/// where there are fewer, since motion must be found within these. The subject fills a small part of its
/// images, so the regularisers of density control are reduced; they would outweigh the photometric loss.
fn joint_settings(motion: &PosedMotion, settings: &TrainSettings, steps: u32) -> TrainSettings {
    let faster = (30_000.0 / f64::from(steps.max(1))).clamp(1.0, FASTEST);
    let rate = faster * settings.motion.rate;
    let growth = settings.growth.map(|growth| match growth {
        GrowthSettings::Mcmc(mcmc) => GrowthSettings::Mcmc(McmcSettings {
            from: mcmc.from.min(200),
            opacity_weight: 0.1 * mcmc.opacity_weight,
            scale_weight: 0.1 * mcmc.scale_weight,
            // Keeps the size of the noise, which is in units of the learning rate.
            noise: mcmc.noise / faster,
            ..mcmc
        }),
        adaptive => adaptive,
    });
    TrainSettings {
        steps,
        growth,
        rates: Rates {
            position: faster * settings.rates.position,
            position_last: faster * settings.rates.position_last,
            ..settings.rates
        },
        motion: MotionSettings {
            rate,
            // Keeps the last steps effective: 1e-4 for 5,000 steps.
            rate_last: settings.motion.rate_last.max(0.5 / f64::from(steps.max(1))).min(rate),
            control: Some(ControlSettings::scaled_to(steps, motion.control_points)),
            ..settings.motion
        },
        ..settings.clone()
    }
}

fn fit_static(
    device: &Device,
    views: &[TrainingView],
    seeds: &Gaussians,
    settings: TrainSettings,
    resume: Option<Checkpoint>,
    observer: &mut dyn Observer,
) -> Result<Gaussians> {
    let mut trainer = match resume {
        Some(Checkpoint::Static(state)) => Trainer::resume(device, views, state, settings)?,
        Some(other) => return Err(other.foreign()),
        None => Trainer::new(device, views, seeds, None, settings)?,
    };
    run(&mut trainer, Phase::Static, observer, Checkpoint::Static)?;
    trainer.gaussians()
}

/// Control points spread over the Gaussians whose opacity the warm-up has raised above the initial one;
/// over all Gaussians where these are too few.
fn spread(gaussians: &Gaussians, count: usize, seed: u64) -> Result<ControlPoints> {
    let seen = |i: &usize| gaussians.opacity_logits[*i] > first_logit();
    let mut chosen: Vec<usize> = (0..gaussians.len()).filter(seen).collect();
    if chosen.len() < count.min(gaussians.len()) {
        chosen = (0..gaussians.len()).collect();
    }
    let candidates: Vec<[f32; 3]> = chosen.iter().map(|&i| gaussians.positions[i]).collect();
    Ok(sequence::spread(&candidates, count, seed)?.0)
}
