//! From a tracked clip to a 4D scene: static Gaussians, then everything together.
//!
//! 1. The static scene is trained on the static pixels.
//!
//! Stage 1 of 4D3R, which renders control points as temporary Gaussians to train a network that moves
//! them, is left out: paths that begin where dense flow has carried the nodes give better results
//! without it.
//!
//! Both steps train on the frames and on views from offset cameras ([`aside`](SequenceSettings::aside)).
//!
//! A clip without motion gets no control points.

use super::aside::aside;
use super::flank::{Flank, flanks};
use super::glimpse::Placed;
use super::lifting::{camera, path};
use super::mesh::Frame;
use super::motion::MotionStart;
use super::movers::seed_movers;
use super::observer::{Checkpoint, Observer, Phase, run};
use super::sampling::farthest_point_sample;
use super::scale::{PictureKind, TrainingScale};
use super::seed::seed_from_points;
use super::settings::{
    ControlSettings, GrowthSettings, McmcSettings, MotionSettings, Rates, SelectionSettings,
    TrainSettings,
};
use super::surface::{lay, normal};
use super::trainer::Trainer;
use super::views::{TrainingView, scene_radius};
use super::windows::{Window, windows};
use crate::data::Point;
use crate::gpu::Device;
use crate::scene::{Scene, SceneCamera};
use crate::track::scaffold::Node;
use crate::track::{StaticPoint, Track};
use crate::types::{ControlPoints, Gaussians, Image, MotionScale, RenderSettings};
use crate::{Error, Result};
use rayon::prelude::*;
use serde_json::{Value, json};

/// How a clip is turned into a scene.
#[derive(Clone, Debug)]
pub struct SequenceSettings {
    /// Number of steps on the static scene alone.
    pub static_steps: u32,
    /// Number of steps of the joint training.
    pub steps: u32,
    /// Largest number of Gaussians that growth may reach.
    pub max_gaussians: usize,
    /// Largest number of control points.
    pub control_points: usize,
    /// Number of control points that a dynamic Gaussian follows.
    pub neighbours: usize,
    /// Highest degree of the spherical harmonics.
    pub sh_degree: u32,
    /// Whether the motion logits are trained, for a clip that is one window; else the masks decide once,
    /// beforehand, which Gaussians move.
    pub train_selection: bool,
    /// Whether a clip in which the appearance of movers changes much is cut into windows, in each of
    /// which the movers have their own Gaussians and control points.
    pub windows: bool,
    /// Whether control points are added and removed in training; else training begins with all of them.
    pub revise_control: bool,
    /// Weight of the as-rigid-as-possible energy of the control points; 0 leaves it out.
    pub arap_weight: f64,
    /// Whether Gaussians are added and relocated in training; else the seeded ones are kept.
    pub grow: bool,
    /// Factor of the depth term; 0 leaves it out.
    pub depth_scale: f32,
    /// Weight of movers' pixels in the depth term, where static pixels have at most 1; with 0 the images
    /// alone determine the movers' distance.
    pub movers_depth: f32,
    /// Whether control points are present only in the frames in which the object that they move is; else
    /// always.
    pub lifespans: bool,
    /// Number of views from offset cameras, rendered from the frames by their depth, per frame in a
    /// round through the frames.
    pub aside: f64,
    /// Whether these views show the unseen sides of movers: a guess from the mover's width.
    pub flanks: bool,
    /// Share of the pixels that movers must cover; clips with less are treated as static.
    pub least_dynamic_share: f64,
    /// Seed of everything random.
    pub seed: u64,
}

/// Approximate number of views from offset cameras, and the largest number of rounds in one of which
/// each of them takes part. A long training on a few views would overfit to them and look wrong from all
/// other viewpoints.
const ASIDE_PICTURES: f64 = 36.0;
const ASIDE_ROUNDS: f64 = 4.0;
/// Distance in pixels within which pixels may show a mover; the static scene is not trained on them.
const MARGIN: usize = 2;
/// Number of training steps per key time of the control points' paths.
const VISITS: usize = 20;
/// Smallest number of key times; with fewer, a short training would not follow a clip's motion.
const LEAST_KEYS: usize = 32;

impl SequenceSettings {
    /// The size of the training of [`fit_sequence`] at its largest, for a number of frames of a size in
    /// pixels, with movers.
    pub fn scale(&self, frames: usize, (width, height): (u32, u32)) -> TrainingScale {
        let kind = PictureKind { width, height, disparity: true, mask: true };
        let aside = PictureKind { mask: false, ..kind };
        TrainingScale {
            pictures: [(kind, frames), (aside, self.pictures_aside(frames))].into(),
            gaussians: self.max_gaussians,
            intersections: 0,
            motion: Some(MotionScale {
                control_points: self.control_points,
                keys: self.keys(frames),
                network: None,
                neighbours: self.neighbours,
            }),
            settings: joint_settings(self),
        }
    }

    /// Number of key times of the control points' paths for a number of frames: one per frame, as long
    /// as training has [`VISITS`] steps for each.
    fn keys(&self, frames: usize) -> usize {
        frames.min((self.steps as usize / VISITS).max(LEAST_KEYS))
    }

    /// Number of views from offset cameras for a number of frames.
    pub fn pictures_aside(&self, frames: usize) -> usize {
        let rounds = f64::from(self.rounds_of_aside(frames));
        (frames as f64 * self.aside.max(0.0) * rounds) as usize
    }

    /// Number of rounds in one of which a view from an offset camera takes part: the fewer such views in
    /// a round, the more of them take turns.
    fn rounds_of_aside(&self, frames: usize) -> u32 {
        let in_a_round = frames as f64 * self.aside.max(0.0);
        (ASIDE_PICTURES / in_a_round).round().clamp(1.0, ASIDE_ROUNDS) as u32
    }

    /// The same with `steps` steps of the joint training; the steps before it are scaled in proportion.
    pub fn of_steps(self, steps: u32) -> SequenceSettings {
        let scaled = u64::from(self.static_steps) * u64::from(steps);
        let static_steps = scaled.div_ceil(u64::from(self.steps.max(1)));
        SequenceSettings {
            static_steps: u32::try_from(static_steps).unwrap_or(u32::MAX),
            steps,
            ..self
        }
    }
}

impl Default for SequenceSettings {
    fn default() -> Self {
        SequenceSettings {
            static_steps: 500,
            steps: 2200,
            max_gaussians: 40_000,
            control_points: ControlSettings::default().most,
            neighbours: 4,
            sh_degree: 1,
            train_selection: false,
            windows: true,
            revise_control: true,
            arap_weight: MotionSettings::default().arap_weight,
            grow: true,
            depth_scale: 0.1,
            movers_depth: 1.0,
            lifespans: true,
            aside: 0.3,
            flanks: true,
            least_dynamic_share: 0.002,
            seed: 0,
        }
    }
}

/// A tracked clip.
#[derive(Clone, Copy)]
pub struct Sequence<'a> {
    /// The frames, RGB, as they were filmed; training removes the lens distortion and equalises their
    /// exposures.
    pub frames: &'a [Image],
    /// Their times in [0, 1].
    pub times: &'a [f64],
    /// Cameras, masks and depth.
    pub track: &'a Track,
}

/// Trains a scene on a tracked clip, from the beginning or from a checkpoint of the same clip and
/// settings. The scene is in the unit of the supplied poses, if any ([`Track::unit`]). The scene's
/// report holds the number of control points that the last phase added and removed
/// (`control_points_added`, `control_points_removed`), the number of gradients that were not finite and
/// were skipped (`broken_gradients`), and for a clip with movers the number of windows (`windows`).
///
/// # Errors
/// [`Error::Input`] when the clip has no static point, or the checkpoint is of another training;
/// [`Error::OutOfMemory`]; a failed submission; any error of `observer`.
pub fn fit_sequence(
    device: &Device,
    sequence: Sequence<'_>,
    settings: &SequenceSettings,
    resume: Option<Checkpoint>,
    observer: &mut dyn Observer,
) -> Result<Scene> {
    let track = sequence.track;
    let frames = track.prepared(sequence.frames);
    let sequence = Sequence { frames: &frames, ..sequence };
    if track.points.is_empty() {
        return Err(Error::Input(
            "no static point was found to begin with: the clip shows no static surroundings".into(),
        ));
    }
    let cameras: Vec<SceneCamera> = sequence
        .times
        .iter()
        .enumerate()
        .map(|(frame, &time)| SceneCamera { time, camera: camera(track, frame) })
        .collect();
    let place = |scene: &mut Scene| {
        scene.settings = RenderSettings::default();
        scene.cameras.clone_from(&cameras);
        scene.set_up_from_cameras();
        scene.enlarge(track.unit);
    };
    let observer = &mut Placed { inner: observer, place: &place };
    let seeds = seed_static(track, settings);
    let mut scene = match moves(track, settings) {
        true => fit_moving(device, sequence, &seeds, settings, resume, observer)?,
        false => {
            let views = views(sequence, settings, &[], |_| 1.0);
            let train = joint_settings(settings);
            let mut trainer = match resume {
                Some(Checkpoint::Static(state)) => Trainer::resume(device, &views, state, train)?,
                Some(other) => return Err(other.foreign()),
                None => Trainer::new(device, &views, &seeds, None, train)?,
            };
            run(&mut trainer, Phase::Static, observer, Checkpoint::Static)?;
            let scene = Scene::of(trainer.gaussians()?);
            Scene { report: report(&mut trainer)?, ..scene }
        }
    };
    place(&mut scene);
    sound(scene)
}

/// The Gaussians that [`fit_sequence`] begins with, movers in the canonical frame. The number of tiles
/// that they overlap determines the memory that training on dense frames takes
/// ([`TrainingScale::intersections`]).
pub fn first_gaussians(sequence: Sequence<'_>, settings: &SequenceSettings) -> Gaussians {
    let frames = sequence.track.prepared(sequence.frames);
    let sequence = Sequence { frames: &frames, ..sequence };
    let mut gaussians = seed_static(sequence.track, settings);
    if moves(sequence.track, settings) {
        gaussians.motion_logits = vec![-STRENGTH; gaussians.len()];
        let flanks = flanks_of(sequence, settings);
        let windows = windows(sequence, settings);
        append(&mut gaussians, &seed_movers(sequence, &windows, &flanks, settings));
    }
    gaussians
}

/// Whether a clip is trained with movers.
fn moves(track: &Track, settings: &SequenceSettings) -> bool {
    let dynamic = track.quality.dynamic_share >= settings.least_dynamic_share;
    dynamic && !track.scaffold.nodes.is_empty()
}

/// The unseen sides in each frame; empty where no view would show them.
fn flanks_of(sequence: Sequence<'_>, settings: &SequenceSettings) -> Vec<Vec<Option<Flank>>> {
    if settings.flanks && settings.pictures_aside(sequence.frames.len()) > 0 {
        flanks(sequence.track, sequence.frames)
    } else {
        Vec::new()
    }
}

/// Returns a trained scene if all of its numbers are valid.
///
/// # Errors
/// [`Error::Failed`] where a number left its range in training.
pub(super) fn sound(scene: Scene) -> Result<Scene> {
    match scene.check() {
        Ok(()) => Ok(scene),
        Err(what) => Err(Error::Failed(format!(
            "the training ran off: {what}; look for cameras that do not fit their images, or \
             train for fewer steps"
        ))),
    }
}

/// Gaussians on the static points, aligned with the surfaces of the frames that the points came from.
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
    settings: &SequenceSettings,
    resume: Option<Checkpoint>,
    observer: &mut dyn Observer,
) -> Result<Scene> {
    let windows = windows(sequence, settings);
    let mut train = joint_settings(settings);
    if windows.len() > 1 {
        // Gaussians that were seeded in a window are not static at their canonical position.
        train.motion.selection = None;
    }
    let flanks = flanks_of(sequence, settings);
    // Computed only when needed: the static scene is trained on other views.
    let all = || views(sequence, settings, &flanks, |_| 1.0);
    let mut trainer = match resume {
        Some(Checkpoint::Joint(state)) => Trainer::resume(device, &all(), state, train)?,
        earlier => {
            let mut gaussians = static_world(device, sequence, seeds, settings, earlier, observer)?;
            let views = all();
            let scene_radius = scene_radius(&views, &gaussians);
            append(&mut gaussians, &seed_movers(sequence, &windows, &flanks, settings));
            let points = control_points(sequence, &windows, settings)?;
            let start = MotionStart { points, network: None, neighbours: settings.neighbours };
            Trainer::with_scene_radius(
                device,
                &views,
                &gaussians,
                Some(&start),
                train,
                scene_radius,
            )?
        }
    };
    run(&mut trainer, Phase::Joint, observer, Checkpoint::Joint)?;
    let mut scene = Scene::of(trainer.gaussians()?);
    if let Some((points, network)) = trainer.motion()? {
        (scene.control_points, scene.network) = (points, network);
    }
    scene.neighbours = settings.neighbours.min(scene.control_points.len()) as u32;
    scene.report = report(&mut trainer)?;
    scene.report["windows"] = json!(windows.iter().filter(|w| w.holds_movers()).count());
    Ok(scene)
}

/// Trains the static scene on pixels that are certainly static.
fn static_world(
    device: &Device,
    sequence: Sequence<'_>,
    seeds: &Gaussians,
    settings: &SequenceSettings,
    resume: Option<Checkpoint>,
    observer: &mut dyn Observer,
) -> Result<Gaussians> {
    let views = views(sequence, settings, &[], |near_mover| if near_mover { 0.0 } else { 1.0 });
    let train = TrainSettings {
        steps: settings.static_steps,
        growth: None,
        max_gaussians: 0,
        ..joint_settings(settings)
    };
    let mut trainer = match resume {
        Some(Checkpoint::Static(state)) => Trainer::resume(device, &views, state, train)?,
        Some(other) => return Err(other.foreign()),
        None => Trainer::new(device, &views, seeds, None, train)?,
    };
    run(&mut trainer, Phase::Static, observer, Checkpoint::Static)?;
    let mut still = trainer.gaussians()?;
    still.motion_logits = vec![-STRENGTH; still.len()];
    Ok(still)
}

/// Absolute motion logit of seeds: negative for static ones, positive for dynamic ones.
pub(super) const STRENGTH: f32 = 4.0;

/// The unit of the positions' learning rate, in the unit of the track (the median depth). It is the
/// camera extent of a hand-held camera's path around a scene. The extent of the clip's own cameras would
/// be too small for a short path and 0 for a fixed camera.
const POSITION_UNIT: f64 = 0.35;

fn joint_settings(settings: &SequenceSettings) -> TrainSettings {
    let growth = McmcSettings { from: 200, ..McmcSettings::default() };
    TrainSettings {
        steps: settings.steps,
        max_gaussians: settings.max_gaussians,
        sh_degree: settings.sh_degree,
        sh_interval: (settings.steps / 2).clamp(1, 1000),
        // With few images and few steps, positions may move faster than over 30,000 steps.
        rates: Rates { position: 4e-4, position_last: 1e-5, ..Rates::default() },
        position_unit: Some(POSITION_UNIT),
        depth_scale: settings.depth_scale,
        growth: settings.grow.then_some(GrowthSettings::Mcmc(growth)),
        motion: MotionSettings {
            rate: 4e-4,
            rate_last: 2e-5,
            path_rate: 8e-4,
            path_rate_last: 2e-5,
            arap_weight: settings.arap_weight,
            control: settings
                .revise_control
                .then(|| ControlSettings::scaled_to(settings.steps, settings.control_points)),
            selection: settings
                .train_selection
                .then(|| SelectionSettings::scaled_to(settings.steps)),
            ..MotionSettings::default()
        },
        seed: settings.seed,
        ..TrainSettings::default()
    }
}

/// The frames as training views; `weight` gives a pixel's weight by whether it is on or near a mover.
/// The disparity holds the measured depth of static pixels and the depth of lifted movers. The views
/// from offset cameras follow, with the unseen sides of each frame.
fn views(
    sequence: Sequence<'_>,
    settings: &SequenceSettings,
    flanks: &[Vec<Option<Flank>>],
    weight: impl Fn(bool) -> f32 + Sync,
) -> Vec<TrainingView> {
    let track = sequence.track;
    let mut views: Vec<TrainingView> = (0..sequence.frames.len())
        .into_par_iter()
        .map(|frame| {
            let near_movers = track.masks[frame].near(MARGIN);
            let mut weights = Image::new(track.masks[frame].width, track.masks[frame].height, 1);
            for (w, near) in weights.pixels.iter_mut().zip(&near_movers) {
                *w = weight(*near);
            }
            // The mask of a shadow is its strength: its Gaussians, which are dynamic, cover the ground
            // by that share.
            let mut moving = track.masks[frame].clone();
            let shadows = track.shadows[frame].pixels.chunks_exact(2);
            for (m, shadow) in moving.pixels.iter_mut().zip(shadows).filter(|(_, s)| s[0] > 0.0) {
                *m = shadow[0];
            }
            let (depth, confidence) = (&track.depth[frame], &track.depth_confidence[frame]);
            let owners = &track.owners[frame];
            let mut disparity = Image::new(depth.width, depth.height, 2);
            for (i, pair) in disparity.pixels.chunks_exact_mut(2).enumerate() {
                let z = depth.pixels[i];
                let measured = !near_movers[i] && confidence.pixels[i] > 0.5;
                // The image alone does not determine a mover's depth.
                let lifted = settings.movers_depth > 0.0 && owners.pixels[i] > 0.0;
                if z > 0.0 && (measured || lifted) {
                    let weight =
                        if measured { confidence.pixels[i] } else { settings.movers_depth };
                    pair.copy_from_slice(&[1.0 / z, weight]);
                }
            }
            TrainingView {
                camera: camera(track, frame),
                time: sequence.times[frame],
                image: sequence.frames[frame].clone(),
                weights: Some(weights),
                disparity: Some(disparity),
                mask: Some(moving),
                every: 1,
            }
        })
        .collect();
    let frames: Vec<Frame<'_>> = views
        .iter()
        .enumerate()
        .map(|(frame, view)| {
            let flanks = flanks.get(frame).map_or(&[][..], Vec::as_slice);
            let (depth, mask) = (&track.depth[frame], &track.masks[frame]);
            Frame { view, depth, mask, owners: &track.owners[frame], flanks }
        })
        .collect();
    let pictures = settings.pictures_aside(frames.len());
    let from_aside = aside(&frames, |first| first * pictures / frames.len());
    let every = settings.rounds_of_aside(frames.len());
    views.extend(from_aside.into_iter().map(|view| TrainingView { every, ..view }));
    views
}

/// Every n-th element, with the smallest n that leaves at most `most`.
pub(super) fn thinned<T>(points: Vec<T>, most: usize) -> Vec<T> {
    let keep = points.len().div_ceil(most.max(1)).max(1);
    points.into_iter().step_by(keep).collect()
}

/// The share of the largest number of control points with which training begins; the others are added in
/// training.
const FIRST_SHARE: f64 = 0.75;

/// The initial number of control points for a limit of `most`.
pub(super) fn first_control_points(most: usize) -> usize {
    (most as f64 * FIRST_SHARE).ceil() as usize
}

/// The report of a training.
pub(super) fn report(trainer: &mut Trainer) -> Result<Value> {
    let changes = trainer.control_changes();
    Ok(json!({
        "control_points_added": changes.added,
        "control_points_removed": changes.removed,
        "broken_gradients": trainer.broken_gradients()?,
    }))
}

/// Control points, spread over the nodes of the scaffold in each window, with the paths of these nodes.
fn control_points(
    sequence: Sequence<'_>,
    windows: &[Window],
    settings: &SequenceSettings,
) -> Result<ControlPoints> {
    let track = sequence.track;
    let keys = settings.keys(sequence.frames.len());
    let most = settings.control_points;
    let count = if settings.revise_control { first_control_points(most) } else { most };
    let taken: Vec<Vec<&Node>> =
        windows.iter().map(|window| window.nodes(track).collect()).collect();
    let all: usize = taken.iter().map(Vec::len).sum();
    let mut points = ControlPoints::default();
    let mut paths: Vec<Vec<[f32; 8]>> = Vec::new();
    for (window, nodes) in windows.iter().zip(&taken) {
        let places: Vec<[f32; 3]> =
            nodes.iter().map(|node| window.place(node).as_vec3().to_array()).collect();
        // Proportional to the window's share of all nodes; at least one, since the window's seeds need
        // one to follow.
        let count = (count * nodes.len() / all.max(1)).max(1).min(nodes.len());
        let (own, chosen) = spread(&places, count, settings.seed)?;
        points.positions.extend(own.positions);
        points.log_radii.extend(own.log_radii);
        paths.extend(chosen.iter().map(|&k| path(nodes[k], window, keys, settings.lifespans)));
    }
    points.paths = (0..keys).flat_map(|key| paths.iter().map(move |path| path[key])).collect();
    Ok(points)
}

/// At most `count` control points spread over some positions, and the indices of the chosen positions.
pub(super) fn spread(
    candidates: &[[f32; 3]],
    count: usize,
    seed: u64,
) -> Result<(ControlPoints, Vec<usize>)> {
    let chosen = farthest_point_sample(candidates.as_flattened(), 3, count, seed)?;
    let positions: Vec<[f32; 3]> = chosen.iter().map(|&k| candidates[k]).collect();
    // The radius is the distance to the nearest others, which seeding computes as a scale.
    let stand_ins: Vec<Point> =
        positions.iter().map(|&position| Point { position, colour: [0.5; 3] }).collect();
    let log_radii = seed_from_points(&stand_ins, 0).log_scales.iter().map(|s| s[0]).collect();
    Ok((ControlPoints { positions, log_radii, paths: Vec::new() }, chosen))
}

pub(super) fn append(to: &mut Gaussians, more: &Gaussians) {
    to.positions.extend_from_slice(&more.positions);
    to.log_scales.extend_from_slice(&more.log_scales);
    to.rotations.extend_from_slice(&more.rotations);
    to.opacity_logits.extend_from_slice(&more.opacity_logits);
    to.sh.extend_from_slice(&more.sh);
    to.motion_logits.extend_from_slice(&more.motion_logits);
}
