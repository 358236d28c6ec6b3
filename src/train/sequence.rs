//! From a tracked clip to a 4D scene: static Gaussians, control points (stage 1), then everything
//! together (stage 2).
//!
//! 1. The static world is trained on what does not move.
//! 2. Control points are chosen among the movers' points; the network is fitted to their
//!    trajectories, as far as flow and depth show them.
//! 3. Stage 1: every control point is drawn as a temporary Gaussian before the frozen static world,
//!    and the network is trained on the movers' pixels. The temporary Gaussians are thrown away.
//! 4. Stage 2: Gaussians are seeded on the movers, follow the control points, and all is trained on
//!    all pixels.
//!
//! A clip in which nothing moves gets no control points and no network.

use super::motion::MotionStart;
use super::network::{TranslationFit, TranslationFitState, Translations};
use super::observer::{Checkpoint, Observer, Phase, run};
use super::rounds::ControlChanges;
use super::sampling::farthest_point_sample;
use super::scale::{MotionScale, PictureKind, TrainingScale};
use super::seed::seed_from_points;
use super::settings::{
    ControlSettings, GrowthSettings, McmcSettings, MotionSettings, Rates, SelectionSettings,
    TrainSettings,
};
use super::state::TrainerState;
use super::surface::{lay, normal};
use super::trainer::Trainer;
use super::trajectories::{MOVING, Trajectories, camera, lift, value};
use super::views::TrainingView;
use crate::data::Point;
use crate::gpu::Device;
use crate::scene::{Scene, SceneCamera};
use crate::track::{StaticPoint, Track};
use crate::types::{ControlPoints, DeformNet, Gaussians, Image, NetShape, RenderSettings};
use crate::{Error, Result};
use glam::DVec2;
use rayon::prelude::*;
use serde_json::{Value, json};
use std::collections::HashSet;

/// How a clip is turned into a scene.
#[derive(Clone, Debug)]
pub struct SequenceSettings {
    /// Steps on the static world alone.
    pub static_steps: u32,
    /// Steps of the network's fit to the control points' trajectories.
    pub trajectory_steps: u32,
    /// Steps of stage 1.
    pub control_steps: u32,
    /// Steps of stage 2, or of all training where nothing moves.
    pub steps: u32,
    /// Growth ends here.
    pub max_gaussians: usize,
    /// Most control points.
    pub control_points: usize,
    /// The deformation network.
    pub network: NetShape,
    /// Control points that a dynamic Gaussian follows.
    pub neighbours: usize,
    /// Highest degree of the spherical harmonics.
    pub sh_degree: u32,
    /// Whether it is trained which Gaussians move; else the masks decide once, before stage 2.
    pub train_selection: bool,
    /// Clips whose movers cover less of the pixels than this are static.
    pub least_dynamic_share: f64,
    /// Decides everything random.
    pub seed: u64,
}

impl SequenceSettings {
    /// How large the training of [`fit_sequence`] is at its largest, on so many frames of some size in
    /// which something moves.
    pub fn scale(&self, frames: usize, (width, height): (u32, u32)) -> TrainingScale {
        let kind = PictureKind { width, height, disparity: true, mask: true };
        TrainingScale {
            pictures: [(kind, frames)].into(),
            gaussians: self.max_gaussians,
            intersections: 0,
            motion: Some(MotionScale {
                control_points: self.control_points,
                network: self.network,
                neighbours: self.neighbours,
            }),
            settings: joint_settings(self),
        }
    }

    /// For frames of some size: a Gaussian for every three pixels where the frames are large.
    pub fn for_size(width: u32, height: u32) -> SequenceSettings {
        let usual = SequenceSettings::default();
        let pixels = width as usize * height as usize;
        SequenceSettings { max_gaussians: usual.max_gaussians.max(pixels / 3), ..usual }
    }
}

impl Default for SequenceSettings {
    fn default() -> Self {
        SequenceSettings {
            static_steps: 500,
            trajectory_steps: 2000,
            control_steps: 300,
            steps: 2200,
            max_gaussians: 40_000,
            control_points: 256,
            network: NetShape {
                depth: 6,
                width: 64,
                skip: 3,
                position_frequencies: 6,
                time_frequencies: 6,
            },
            neighbours: 4,
            sh_degree: 1,
            train_selection: true,
            least_dynamic_share: 0.002,
            seed: 0,
        }
    }
}

/// A tracked clip.
#[derive(Clone, Copy)]
pub struct Sequence<'a> {
    /// The frames, RGB.
    pub frames: &'a [Image],
    /// Their times in [0, 1].
    pub times: &'a [f64],
    /// Cameras, masks and depth.
    pub track: &'a Track,
}

/// Trains a scene on a tracked clip, from the beginning or from a checkpoint of the same clip and
/// settings. The scene's report says how many control points were added and removed on the way:
/// `control_points_added`, `control_points_removed`.
///
/// # Errors
/// [`Error::Input`] when the clip has no static point to begin with, or the checkpoint is of another
/// training; out of memory; a failed submission; whatever `observer` returns.
pub fn fit_sequence(
    device: &Device,
    sequence: Sequence<'_>,
    settings: &SequenceSettings,
    resume: Option<Checkpoint>,
    observer: &mut dyn Observer,
) -> Result<Scene> {
    let track = sequence.track;
    if track.points.is_empty() {
        return Err(Error::Input(
            "no static point was found to begin with: the clip shows no static surroundings".into(),
        ));
    }
    let seeds = seed_static(track, settings);
    let dynamic = track.quality.dynamic_share >= settings.least_dynamic_share;
    let trajectories = dynamic.then(|| Trajectories::of(track));
    let mut scene = match trajectories {
        Some(trajectories) if !trajectories.all.is_empty() => {
            fit_moving(device, sequence, &seeds, &trajectories, settings, resume, observer)?
        }
        _ => {
            let views = views(sequence, |_| 1.0);
            let train = joint_settings(settings);
            let mut trainer = match resume {
                Some(Checkpoint::Static(state)) => Trainer::resume(device, &views, state, train)?,
                Some(other) => return Err(other.foreign()),
                None => Trainer::new(device, &views, &seeds, None, train)?,
            };
            run(&mut trainer, Phase::Static, observer, Checkpoint::Static)?;
            let scene = Scene::of(trainer.gaussians()?);
            Scene { report: report(ControlChanges::default()), ..scene }
        }
    };
    scene.settings = RenderSettings::default();
    scene.cameras = sequence
        .times
        .iter()
        .enumerate()
        .map(|(frame, &time)| SceneCamera { time, camera: camera(track, frame) })
        .collect();
    scene.set_up_from_cameras();
    sound(scene)
}

/// A trained scene, if it can be used.
///
/// # Errors
/// A number ran out of its range in training.
pub(super) fn sound(scene: Scene) -> Result<Scene> {
    match scene.check() {
        Ok(()) => Ok(scene),
        Err(what) => Err(Error::Failed(format!(
            "the training ran off: {what}; look for cameras that do not fit their pictures, or \
             train for fewer steps"
        ))),
    }
}

/// Gaussians on the static points, laid along the surfaces of the frames that they were taken from.
fn seed_static(track: &Track, settings: &SequenceSettings) -> Gaussians {
    let points = thinned(track.points.iter().collect(), settings.max_gaussians / 2);
    let at =
        |p: &&StaticPoint| Point { position: p.position.as_vec3().to_array(), colour: p.colour };
    let positions: Vec<Point> = points.iter().map(at).collect();
    let mut seeds = seed_from_points(&positions, settings.sh_degree);
    for (i, point) in points.iter().enumerate() {
        let view_from_world = track.view_from_world[point.frame];
        let ray = view_from_world.apply(point.position);
        let pixel = track.intrinsics.project(ray);
        if let Some(normal) = normal(&track.depth[point.frame], &track.intrinsics, pixel) {
            let world_from_view = view_from_world.rotation.conjugate();
            lay(&mut seeds, i, world_from_view * ray, world_from_view * normal);
        }
    }
    seeds
}

fn fit_moving(
    device: &Device,
    sequence: Sequence<'_>,
    seeds: &Gaussians,
    trajectories: &Trajectories,
    settings: &SequenceSettings,
    resume: Option<Checkpoint>,
    observer: &mut dyn Observer,
) -> Result<Scene> {
    let train = joint_settings(settings);
    let all = || views(sequence, |_| 1.0);
    let mut trainer = match resume {
        Some(Checkpoint::Joint(state)) => Trainer::resume(device, &all(), state, train)?,
        earlier => {
            let before = BeforeJoint { device, sequence, trajectories, settings };
            let (gaussians, start) = before.run(seeds, earlier, observer)?;
            Trainer::new(device, &all(), &gaussians, Some(&start), train)?
        }
    };
    run(&mut trainer, Phase::Joint, observer, Checkpoint::Joint)?;
    let mut scene = Scene::of(trainer.gaussians()?);
    if let Some((points, network)) = trainer.motion()? {
        scene.control_points = points;
        scene.network = Some(network);
    }
    scene.neighbours = settings.neighbours.min(scene.control_points.len()) as u32;
    scene.report = report(trainer.control_changes());
    Ok(scene)
}

/// Motion logits of what is seeded as static or dynamic.
const STRENGTH: f32 = 4.0;

/// What comes before stage 2.
#[derive(Clone, Copy)]
struct BeforeJoint<'a> {
    device: &'a Device,
    sequence: Sequence<'a>,
    trajectories: &'a Trajectories,
    settings: &'a SequenceSettings,
}

impl BeforeJoint<'_> {
    /// The Gaussians and the motion that stage 2 begins with.
    fn run(
        self,
        seeds: &Gaussians,
        resume: Option<Checkpoint>,
        observer: &mut dyn Observer,
    ) -> Result<(Gaussians, MotionStart)> {
        let (still, start, state) = match resume {
            Some(Checkpoint::Control { still, start, trainer }) => (still, start, Some(*trainer)),
            Some(Checkpoint::Trajectories { still, fit }) => {
                let start = self.follow_trajectories(&still, Some(fit), observer)?;
                (still, start, None)
            }
            Some(other @ Checkpoint::Joint(_)) => return Err(other.foreign()),
            earlier => {
                let state = match earlier {
                    Some(Checkpoint::Static(state)) => Some(state),
                    _ => None,
                };
                let still = self.static_world(seeds, state, observer)?;
                let start = self.follow_trajectories(&still, None, observer)?;
                (still, start, None)
            }
        };
        let network = self.control_stage(&still, &start, state, observer)?;
        let movers = seed_movers(self.sequence, self.trajectories, self.settings);
        let mut gaussians = still;
        append(&mut gaussians, &movers);
        let neighbours = self.settings.neighbours;
        Ok((gaussians, MotionStart { points: start.points, network, neighbours }))
    }

    /// The static world, on what surely does not move.
    fn static_world(
        self,
        seeds: &Gaussians,
        resume: Option<TrainerState>,
        observer: &mut dyn Observer,
    ) -> Result<Gaussians> {
        let views = views(self.sequence, |moving| if moving > 0.0 { 0.0 } else { 1.0 });
        let train = TrainSettings {
            steps: self.settings.static_steps,
            growth: None,
            max_gaussians: 0,
            ..joint_settings(self.settings)
        };
        let mut trainer = match resume {
            Some(state) => Trainer::resume(self.device, &views, state, train)?,
            None => Trainer::new(self.device, &views, seeds, None, train)?,
        };
        run(&mut trainer, Phase::Static, observer, Checkpoint::Static)?;
        let mut still = trainer.gaussians()?;
        still.motion_logits = vec![-STRENGTH; still.len()];
        Ok(still)
    }

    /// Control points, and a network that follows their trajectories.
    fn follow_trajectories(
        self,
        still: &Gaussians,
        resume: Option<TranslationFitState>,
        observer: &mut dyn Observer,
    ) -> Result<MotionStart> {
        let BeforeJoint { sequence, trajectories, settings, .. } = self;
        let (points, chosen) = control_points(trajectories, settings)?;
        let mut network = DeformNet::random(settings.network, settings.seed);
        let targets: Vec<Vec<[f32; 3]>> = chosen
            .iter()
            .map(|&k| {
                let path = &trajectories.all[k].positions;
                let origin = path[trajectories.canonical];
                path.iter().map(|p| (*p - origin).as_vec3().to_array()).collect()
            })
            .collect();
        let goal = Translations { times: sequence.times, targets: &targets };
        let steps = settings.trajectory_steps;
        let state = resume.unwrap_or_else(|| TranslationFitState::begin(&network, settings.seed));
        let mut fit = TranslationFit::new(self.device, &network, &points, goal, steps, &state)?;
        while fit.steps_done() < steps {
            fit.step()?;
            observer.progress(Phase::Trajectories, fit.steps_done(), steps)?;
            if observer.wants_checkpoint() {
                let fit = fit.state()?;
                observer.checkpoint(&Checkpoint::Trajectories { still: still.clone(), fit })?;
            }
        }
        network.parameters = fit.parameters()?;
        Ok(MotionStart { points, network, neighbours: 1 })
    }

    /// Stage 1: the control points as temporary Gaussians before the frozen static world.
    fn control_stage(
        self,
        still: &Gaussians,
        start: &MotionStart,
        resume: Option<TrainerState>,
        observer: &mut dyn Observer,
    ) -> Result<DeformNet> {
        let BeforeJoint { device, sequence, trajectories, settings } = self;
        if settings.control_steps == 0 {
            return Ok(start.network.clone());
        }
        let views = views(sequence, |moving| if moving > 0.0 { 1.0 } else { 0.05 });
        // The temporary Gaussians keep place and shape: motion is for the network to learn.
        let rates = Rates {
            position: 1e-12,
            position_last: 1e-12,
            log_scale: 0.0,
            rotation: 0.0,
            ..Rates::default()
        };
        let train = TrainSettings {
            steps: settings.control_steps,
            growth: None,
            max_gaussians: 0,
            rates,
            motion: MotionSettings { rate: 4e-4, rate_last: 4e-5, ..MotionSettings::default() },
            ..joint_settings(settings)
        };
        let mut trainer = match resume {
            Some(state) => Trainer::resume(device, &views, state, train)?,
            None => {
                let mut gaussians = still.clone();
                append(&mut gaussians, &temporary(sequence, start, trajectories, settings));
                let mut trainer = Trainer::new(device, &views, &gaussians, Some(start), train)?;
                let trainable: Vec<bool> = (0..gaussians.len()).map(|i| i >= still.len()).collect();
                trainer.set_trainable(&trainable)?;
                trainer
            }
        };
        run(&mut trainer, Phase::Control, observer, |trainer| Checkpoint::Control {
            still: still.clone(),
            start: start.clone(),
            trainer: Box::new(trainer),
        })?;
        Ok(trainer.motion()?.map_or_else(|| start.network.clone(), |(_, network)| network))
    }
}

/// The control points as Gaussians, in the colours of the canonical frame.
fn temporary(
    sequence: Sequence<'_>,
    start: &MotionStart,
    trajectories: &Trajectories,
    settings: &SequenceSettings,
) -> Gaussians {
    let frame = trajectories.canonical;
    let camera = camera(sequence.track, frame);
    let colours: Vec<Point> = start
        .points
        .positions
        .iter()
        .map(|&position| {
            let view = camera.view_from_world.apply(glam::Vec3::from(position).as_dvec3());
            let pixel = camera.intrinsics.project(view);
            Point { position, colour: colour(&sequence.frames[frame], pixel) }
        })
        .collect();
    let mut nodes = seed_from_points(&colours, settings.sh_degree);
    nodes.opacity_logits.fill(1.0);
    nodes.motion_logits = vec![STRENGTH; nodes.len()];
    nodes
}

fn joint_settings(settings: &SequenceSettings) -> TrainSettings {
    TrainSettings {
        steps: settings.steps,
        max_gaussians: settings.max_gaussians,
        sh_degree: settings.sh_degree,
        sh_interval: (settings.steps / 2).clamp(1, 1000),
        // Few pictures and few steps: positions may move faster than over 30,000 steps.
        rates: Rates { position: 4e-4, position_last: 1e-5, ..Rates::default() },
        depth_scale: 0.1,
        growth: Some(GrowthSettings::Mcmc(McmcSettings { from: 200, ..McmcSettings::default() })),
        motion: MotionSettings {
            rate: 4e-4,
            rate_last: 2e-5,
            control: Some(ControlSettings::scaled_to(settings.steps, settings.control_points)),
            selection: settings
                .train_selection
                .then(|| SelectionSettings::scaled_to(settings.steps)),
            ..MotionSettings::default()
        },
        seed: settings.seed,
        ..TrainSettings::default()
    }
}

/// Weight of the depth of movers' pixels: in the depth term they are few.
const LIFTED_WEIGHT: f32 = 1.0;

/// The frames as training views; `weight` turns the movers' nearness (1 on a mover, 0 away from any)
/// into a pixel's weight. The depth that was measured on static pixels, and that of lifted movers,
/// comes along.
fn views(sequence: Sequence<'_>, weight: impl Fn(f32) -> f32 + Sync) -> Vec<TrainingView> {
    let track = sequence.track;
    (0..sequence.frames.len())
        .into_par_iter()
        .map(|frame| {
            let mask = dilated(&track.masks[frame], 2);
            let mut weights = mask.clone();
            weights.pixels.iter_mut().for_each(|w| *w = weight(*w));
            let (depth, confidence) = (&track.depth[frame], &track.depth_confidence[frame]);
            let owners = &track.owners[frame];
            let mut disparity = Image::new(depth.width, depth.height, 2);
            for (i, pair) in disparity.pixels.chunks_exact_mut(2).enumerate() {
                let z = depth.pixels[i];
                let measured = mask.pixels[i] == 0.0 && confidence.pixels[i] > 0.5;
                // The picture alone does not hold a mover at its depth.
                let lifted = owners.pixels[i] > 0.0;
                if z > 0.0 && (measured || lifted) {
                    let weight = if measured { confidence.pixels[i] } else { LIFTED_WEIGHT };
                    pair.copy_from_slice(&[1.0 / z, weight]);
                }
            }
            TrainingView {
                camera: camera(track, frame),
                time: sequence.times[frame],
                image: sequence.frames[frame].clone(),
                weights: Some(weights),
                disparity: Some(disparity),
                mask: Some(track.masks[frame].clone()),
            }
        })
        .collect()
}

/// 1 on what moves and within some pixels of it, else 0.
fn dilated(mask: &Image, radius: i64) -> Image {
    let mut out = Image::new(mask.width, mask.height, 1);
    let (width, height) = (i64::from(mask.width), i64::from(mask.height));
    for y in 0..height {
        for x in 0..width {
            let near = (-radius..=radius).any(|dy| {
                (-radius..=radius).any(|dx| {
                    let (px, py) = (x + dx, y + dy);
                    (0..width).contains(&px)
                        && (0..height).contains(&py)
                        && mask.pixels[(py * width + px) as usize] > MOVING
                })
            });
            out.pixels[(y * width + x) as usize] = f32::from(u8::from(near));
        }
    }
    out
}

fn colour(image: &Image, pixel: DVec2) -> [f32; 3] {
    let x = (pixel.x.max(0.0) as u32).min(image.width - 1);
    let y = (pixel.y.max(0.0) as u32).min(image.height - 1);
    let c = image.at(x, y);
    [c[0], c[1], c[2]]
}

/// Every so-manieth, so that at most `most` stay.
fn thinned<T>(points: Vec<T>, most: usize) -> Vec<T> {
    let keep = points.len().div_ceil(most.max(1)).max(1);
    points.into_iter().step_by(keep).collect()
}

/// The share of the most control points that there may be with which training begins; the rest are
/// added where the loss asks.
const FIRST_SHARE: f64 = 0.75;

/// How many control points to begin with where there may be `most`.
pub(super) fn first_control_points(most: usize) -> usize {
    (most as f64 * FIRST_SHARE).ceil() as usize
}

/// What training tells of itself.
pub(super) fn report(changes: ControlChanges) -> Value {
    json!({
        "control_points_added": changes.added,
        "control_points_removed": changes.removed,
    })
}

/// Control points spread over the movers, and the trajectories they stand for.
fn control_points(
    trajectories: &Trajectories,
    settings: &SequenceSettings,
) -> Result<(ControlPoints, Vec<usize>)> {
    let canonical: Vec<[f32; 3]> = trajectories
        .all
        .iter()
        .map(|path| path.positions[trajectories.canonical].as_vec3().to_array())
        .collect();
    let count = first_control_points(settings.control_points).min(canonical.len());
    spread(&canonical, count, settings.seed)
}

/// At most `count` control points spread over some positions, and which positions they are.
pub(super) fn spread(
    candidates: &[[f32; 3]],
    count: usize,
    seed: u64,
) -> Result<(ControlPoints, Vec<usize>)> {
    let chosen = farthest_point_sample(candidates.as_flattened(), 3, count, seed)?;
    let positions: Vec<[f32; 3]> = chosen.iter().map(|&k| candidates[k]).collect();
    // The radius is the distance to the nearest others, which seeding knows as a scale.
    let stand_ins: Vec<Point> =
        positions.iter().map(|&position| Point { position, colour: [0.5; 3] }).collect();
    let log_radii = seed_from_points(&stand_ins, 0).log_scales.iter().map(|s| s[0]).collect();
    Ok((ControlPoints { positions, log_radii }, chosen))
}

/// Gaussians on the movers, brought back to the canonical frame from several frames, one per cell of
/// a grid.
fn seed_movers(
    sequence: Sequence<'_>,
    trajectories: &Trajectories,
    settings: &SequenceSettings,
) -> Gaussians {
    let track = sequence.track;
    let count = sequence.frames.len();
    let every = count.div_ceil(8).max(1);
    let canonical = trajectories.canonical;
    let mut order: Vec<usize> = (0..count).step_by(every).collect();
    order.insert(0, canonical);
    // A cell is what two pixels cover at the movers' depth.
    let spacing = {
        let mask = &track.masks[canonical];
        let depths: Vec<f32> = mask
            .pixels
            .iter()
            .zip(&track.depth[canonical].pixels)
            .filter(|(m, _)| **m > MOVING)
            .map(|(_, z)| *z)
            .collect();
        let mean = depths.iter().sum::<f32>() / depths.len().max(1) as f32;
        f64::from(mean) / track.intrinsics.fx * 2.0
    };
    let mut taken = HashSet::new();
    let mut points = Vec::new();
    for frame in order {
        let mask = &track.masks[frame];
        for y in 0..mask.height {
            for x in 0..mask.width {
                let pixel = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
                if value(mask, pixel) <= MOVING {
                    continue;
                }
                let here = lift(track, frame, pixel);
                let position = trajectories.to_canonical(track, frame, pixel, here);
                let Some(position) = position else { continue };
                let cell = (position / spacing.max(1e-9)).floor().as_i64vec3();
                if position.is_finite() && taken.insert(cell) {
                    points.push(Point {
                        position: position.as_vec3().to_array(),
                        colour: colour(&sequence.frames[frame], pixel),
                    });
                }
            }
        }
    }
    let points = thinned(points, settings.max_gaussians / 3);
    let mut gaussians = seed_from_points(&points, settings.sh_degree);
    gaussians.motion_logits = vec![STRENGTH; gaussians.len()];
    gaussians
}

fn append(to: &mut Gaussians, more: &Gaussians) {
    to.positions.extend_from_slice(&more.positions);
    to.log_scales.extend_from_slice(&more.log_scales);
    to.rotations.extend_from_slice(&more.rotations);
    to.opacity_logits.extend_from_slice(&more.opacity_logits);
    to.sh.extend_from_slice(&more.sh);
    to.motion_logits.extend_from_slice(&more.motion_logits);
}
