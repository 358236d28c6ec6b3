//! From a tracked clip to a 4D scene: static Gaussians, then everything together.
//!
//! 1. The static world is trained on what does not move.
//! 2. Control points are chosen among the nodes of the track's scaffold, and take their paths.
//!    Gaussians are seeded on the movers, in the canonical frame, and follow the control points; all is
//!    trained on all pixels.
//!
//! 4D3R's stage 1, control points drawn as temporary Gaussians to train a network that moves them, is
//! left out: paths that begin where dense flow has carried the nodes are better without it.
//!
//! Both steps train on the frames and on what some of them show from aside ([`aside`](SequenceSettings::aside)).
//!
//! A clip in which nothing moves gets no control points.

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
    /// Steps on the static world alone.
    pub static_steps: u32,
    /// Steps of all together.
    pub steps: u32,
    /// Growth ends here.
    pub max_gaussians: usize,
    /// Most control points.
    pub control_points: usize,
    /// Control points that a dynamic Gaussian follows.
    pub neighbours: usize,
    /// Highest degree of the spherical harmonics.
    pub sh_degree: u32,
    /// Whether it is trained which Gaussians move, where a clip is one window; else the masks decide
    /// once, beforehand.
    pub train_selection: bool,
    /// Whether a clip in which the look of movers changes much is cut into windows, in each of which what
    /// moves has Gaussians and control points of its own.
    pub windows: bool,
    /// Whether control points are added and removed in training; else it begins with all of them.
    pub revise_control: bool,
    /// Weight of the as-rigid-as-possible energy of the control points; 0 leaves it out.
    pub arap_weight: f64,
    /// Whether Gaussians are added and moved to where they are needed; else those that were seeded stay.
    pub grow: bool,
    /// Factor of the depth term; 0 leaves it out.
    pub depth_scale: f32,
    /// Weight of the depth of movers' pixels in the depth term, in which static ones have at most 1; 0
    /// leaves it to the pictures how far movers are.
    pub movers_depth: f32,
    /// Whether control points are there only in the frames in which what they move is; else always.
    pub lifespans: bool,
    /// Pictures from aside to train on as well, drawn from the frames by their depth: so many in a round
    /// through the frames, per frame.
    pub aside: f64,
    /// Whether these show the flanks of what moves, where no frame does: a guess by its width.
    pub flanks: bool,
    /// Clips whose movers cover less of the pixels than this are static.
    pub least_dynamic_share: f64,
    /// Decides everything random.
    pub seed: u64,
}

/// Pictures from aside there are about so many, as long as each is shown in one of so many rounds, at least: a
/// long training learns a few of them by heart, and what looks wrong from anywhere else.
const ASIDE_PICTURES: f64 = 36.0;
const ASIDE_ROUNDS: f64 = 4.0;
/// Pixels so near to a mover's may show it: the static world is not trained on them.
const MARGIN: usize = 2;
/// Training steps for every key time of the control points' paths.
const VISITS: usize = 20;
/// With fewer key times than this a short training would not follow a clip's motion at all.
const LEAST_KEYS: usize = 32;

impl SequenceSettings {
    /// How large the training of [`fit_sequence`] is at its largest, on so many frames of some size in
    /// which something moves.
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

    /// How many key times the control points' paths have on so many frames: one for each, as long as
    /// training has [`VISITS`] steps for every one.
    fn keys(&self, frames: usize) -> usize {
        frames.min((self.steps as usize / VISITS).max(LEAST_KEYS))
    }

    /// How many pictures from aside so many frames give.
    pub fn pictures_aside(&self, frames: usize) -> usize {
        let rounds = f64::from(self.rounds_of_aside(frames));
        (frames as f64 * self.aside.max(0.0) * rounds) as usize
    }

    /// A picture from aside is shown in one of so many rounds: the fewer there are in a round, the more of
    /// them take turns.
    fn rounds_of_aside(&self, frames: usize) -> u32 {
        let in_a_round = frames as f64 * self.aside.max(0.0);
        (ASIDE_PICTURES / in_a_round).round().clamp(1.0, ASIDE_ROUNDS) as u32
    }

    /// The same with so many steps of all together; those before go in proportion.
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
            control_points: 256,
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
    /// The frames, RGB, as they were filmed; training takes off the lens's distortion and makes their exposures equal.
    pub frames: &'a [Image],
    /// Their times in [0, 1].
    pub times: &'a [f64],
    /// Cameras, masks and depth.
    pub track: &'a Track,
}

/// Trains a scene on a tracked clip, from the beginning or from a checkpoint of the same clip and
/// settings. The scene is in the unit of the supplied poses, where there are any ([`Track::unit`]). The scene's report says how many control points were added and removed in the last phase,
/// `control_points_added` and `control_points_removed`, and how many of its gradients were not finite and
/// so left out, `broken_gradients`; where something moves also into how many windows the clip was cut, `windows`.
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

/// The Gaussians that [`fit_sequence`] begins with, movers where they are in the canonical frame: how
/// many tiles they reach tells what memory the training of dense ones takes
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

/// The flanks in each frame; none where no picture would show them.
fn flanks_of(sequence: Sequence<'_>, settings: &SequenceSettings) -> Vec<Vec<Option<Flank>>> {
    if settings.flanks && settings.pictures_aside(sequence.frames.len()) > 0 {
        flanks(sequence.track, sequence.frames)
    } else {
        Vec::new()
    }
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
    settings: &SequenceSettings,
    resume: Option<Checkpoint>,
    observer: &mut dyn Observer,
) -> Result<Scene> {
    let windows = windows(sequence, settings);
    let mut train = joint_settings(settings);
    if windows.len() > 1 {
        // What was seeded in a window does not stand still at its canonical place.
        train.motion.selection = None;
    }
    let flanks = flanks_of(sequence, settings);
    // Not before they are needed: the static world is trained on views of its own.
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
            Trainer::with_scene_radius(device, &views, &gaussians, Some(&start), train, scene_radius)?
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

/// The static world, on what surely does not move.
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

/// Motion logits of what is seeded as static or dynamic.
pub(super) const STRENGTH: f32 = 4.0;

/// The unit of the positions' learning rate, in that of the track (the median depth): the extent of a
/// hand-held camera's path about a scene. That of the clip itself would hardly let them move where it is
/// short, and is nothing where the camera is fixed.
const POSITION_UNIT: f64 = 0.35;

fn joint_settings(settings: &SequenceSettings) -> TrainSettings {
    let growth = McmcSettings { from: 200, ..McmcSettings::default() };
    TrainSettings {
        steps: settings.steps,
        max_gaussians: settings.max_gaussians,
        sh_degree: settings.sh_degree,
        sh_interval: (settings.steps / 2).clamp(1, 1000),
        // Few pictures and few steps: positions may move faster than over 30,000 steps.
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

/// The frames as training views; `weight` gives a pixel's weight by whether it is on a mover or beside
/// one. The depth that was measured on static pixels, and that of lifted movers, comes along. Then what
/// they show from aside, with what flanks there are in each frame.
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
            // A shadow's Gaussians, which move, cover what it falls on by as much as it takes away.
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
                // The picture alone does not hold a mover at its depth.
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

/// Every so-manieth, so that at most `most` stay.
pub(super) fn thinned<T>(points: Vec<T>, most: usize) -> Vec<T> {
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
pub(super) fn report(trainer: &mut Trainer) -> Result<Value> {
    let changes = trainer.control_changes();
    Ok(json!({
        "control_points_added": changes.added,
        "control_points_removed": changes.removed,
        "broken_gradients": trainer.broken_gradients()?,
    }))
}

/// Control points spread over the nodes of the scaffold in each window, with these nodes' paths.
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
        // As many as its share of all nodes; what is seeded in a window follows one at least.
        let count = (count * nodes.len() / all.max(1)).max(1).min(nodes.len());
        let (own, chosen) = spread(&places, count, settings.seed)?;
        points.positions.extend(own.positions);
        points.log_radii.extend(own.log_radii);
        paths.extend(chosen.iter().map(|&k| path(nodes[k], window, keys, settings.lifespans)));
    }
    points.paths = (0..keys).flat_map(|key| paths.iter().map(move |path| path[key])).collect();
    Ok(points)
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
