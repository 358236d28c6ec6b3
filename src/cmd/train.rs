//! `splat4d train`: trains a scene on images with known cameras.

use std::path::PathBuf;

use clap::{Args, ValueEnum};
use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use serde_json::{Value, json};
use splat4d::data::{Dataset, Point, Resize, View};
use splat4d::gpu::Device;
use splat4d::io::{Identity, check_memory, checksum};
use splat4d::renderer::Renderer;
use splat4d::scene::{Scene, SceneCamera};
use splat4d::train::{
    AdaptiveSettings, GrowthSettings, McmcSettings, Phase, PosedMotion, TrainSettings,
    TrainingScale, TrainingView, fit_posed, points_in_hull, posed_scale, posed_unit, random_points,
    seed_from_points,
};
use splat4d::types::{Camera, Gaussians, RenderSettings, Tuning};
use splat4d::{Error, Result};

use super::checkpoints::{self, CheckpointArgs, Checkpoints, shown, summed};
use super::clock::Clock;
use super::common::{
    Answer, Common, bytes, most_pairs, note_broken_gradients, notes, path_text, say, thousands,
};
use super::info::dynamic_share;
use super::live::{Live, LiveArgs, name_of};
use super::model::{self, Choice};
use super::outputs::{Inputs, Outputs};
use super::quality::{self, Quality};
use super::run_page::{self, Run};
use super::train_page::Page;
use super::watcher::{Kept, Watcher};
use super::{reconstruct_pictures, sheet, tuning, values};

const AFTER_HELP: &str = "\
Images that have times (`time` in transforms.json, D-NeRF, HyperNeRF) make a scene that moves; others, and
with --static all, make a static one.

DATASET is a folder, and what is in it tells its kind: transforms.json (nerfstudio, instant-ngp, or the
file itself), transforms_train.json (D-NeRF), scene.json with dataset.json (Nerfies, HyperNeRF, DyCheck; or
one of its rgb/Nx), poses_bounds.npy (LLFF, DyNeRF, NVIDIA dynamic scenes), a COLMAP model (sparse/0, binary
or text), or the images of one sequence of MPI Sintel (training/final/NAME).

Examples:
  splat4d train captures/fox -o fox.safetensors --steps 2000 --size 480
  splat4d train captures/fox -o fox.safetensors --max-gaussians 50000 --density adaptive
  splat4d train captures/fox -o fox.safetensors --view

With --view only this machine reaches the page; with --host the machines that reach that address do, too, and
the page's address then holds a random token. The page changes nothing of the scene that comes out.

JSON: psnr_input, psnr_test (null where nothing is held out), ssim_test, gaussians, control_points,
control_points_added, control_points_removed (null where nothing moves), broken_gradients (values that were
not a number or infinite and were left out), dynamic_share, model [{what, chosen, because, saves}], density
(null where their number is kept), steps, images, held_out, device, predicted_bytes (of device memory, before
it began; with --view also of the page, in the scene without it), all also kept in the scene; and, in
report.json too, peak_bytes, milliseconds_per_step, seconds {load, train, evaluate}; output. report.json alone
has training [{phase (static, joint), step, gaussians, l1, ssim, psnr (dB, or null)}], measured on one image
each";

/// Host memory per Gaussian during initialisation, bytes: the point, the neighbour tree, and all its values
/// twice.
const BYTES_A_SEED: u64 = 1024;

/// How Gaussians are added and removed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Density {
    /// 3DGS-MCMC: the number grows evenly to the maximum, faint Gaussians move to opaque ones
    Mcmc,
    /// 3D Gaussian Splatting: clone and split by image gradients, prune faint Gaussians
    Adaptive,
}

/// Train a scene on images with known cameras
#[derive(Args)]
#[command(after_help = AFTER_HELP)]
pub struct TrainArgs {
    /// The dataset
    dataset: PathBuf,
    /// The output scene file
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// Number of steps, with one image each
    #[arg(long, value_name = "N", default_value_t = 7000,
          value_parser = values::whole::<u32>(1..=values::MOST_STEPS))]
    steps: u32,
    /// Maximum number of Gaussians; 0 keeps the number of initial points
    #[arg(long, value_name = "N", default_value_t = 0,
          value_parser = values::whole::<usize>(0..=values::MOST_GAUSSIANS))]
    max_gaussians: usize,
    /// How Gaussians are added and removed, up to --max-gaussians
    #[arg(long, value_enum, default_value_t = Density::Mcmc, requires = "max_gaussians")]
    density: Density,
    /// Downscale images so that their longer side has at most this many pixels
    #[arg(long, value_name = "LONGEST",
          value_parser = values::whole::<u32>(1..=values::MOST_PIXELS))]
    size: Option<u32>,
    /// Hold out every N-th image for the test, unless the dataset has its own split; 0: none
    #[arg(long, value_name = "N", default_value_t = 8,
          value_parser = values::whole::<usize>(0..=values::MOST_PICTURES))]
    eval_every: usize,
    /// Maximum degree of the spherical harmonics
    #[arg(long, value_name = "0..3", default_value_t = 3,
          value_parser = values::whole::<u32>(0..=3))]
    sh_degree: u32,
    /// Train a static scene, although the images have times
    #[arg(long = "static")]
    still: bool,
    /// Maximum number of control points of a dynamic scene
    #[arg(long, value_name = "N", default_value_t = PosedMotion::default().control_points,
          value_parser = values::whole::<usize>(1..=values::MOST_CONTROL_POINTS))]
    control_points: usize,
    /// Number of initial points if the dataset has none, spread over the visual hull of the alpha channels,
    /// or over what the cameras look at
    #[arg(long, value_name = "N", default_value_t = 20_000,
          value_parser = values::whole::<usize>(1..=values::MOST_POINTS))]
    random_points: usize,
    /// Background colour; default: white for images with an alpha channel, else black
    #[arg(long, value_name = "R,G,B", value_parser = values::colour)]
    background: Option<[f32; 3]>,
    /// Settings that trade accuracy for speed, as `bench --error-budget` writes them: α cut and T stop,
    /// which the scene then keeps, depth bits, maximum SH degree, neighbours; SH stay f32
    #[arg(long, value_name = "FILE")]
    settings: Option<PathBuf>,
    /// Write report.html (a page with all results), report.json and sheet.png (input, render, motion mask,
    /// depth) to this folder
    #[arg(long, value_name = "DIR")]
    report: Option<PathBuf>,
    #[command(flatten)]
    live: LiveArgs,
    #[command(flatten)]
    checkpoints: CheckpointArgs,
}

/// Runs the command.
pub fn run(args: &TrainArgs, common: &Common) -> Result<Answer> {
    let mut outputs = Outputs::default().file(&args.output)?;
    if let Some(folder) = &args.report {
        outputs = outputs.folder(folder, &sheet::FILES)?.folder(folder, &[run_page::FILE])?;
    }
    args.checkpoints.check(&args.output)?;
    let tuning = tuning::read(args.settings.as_deref())?;
    let mut clock = Clock::start();

    let mut set = open_set(args, &outputs)?;
    let (train, test) = set.split(args.eval_every);
    if train.is_empty() {
        let what = "every image is held out; train on some with a larger --eval-every";
        return Err(Error::Input(what.into()));
    }
    let device = common.open_device()?;
    let mut live = args.live.start(&device, &name_of(&args.dataset), tuning)?;
    let size = args.size.map_or(Resize::Keep, Resize::Longest);
    let (train, test) = (set.load(&train, size)?, set.load(&test, size)?);
    let first = first_gaussians(args, &set);
    say(&format!(
        "{} images to train on, {} held out, {} Gaussians to begin with",
        train.len(),
        test.len(),
        thousands(first)
    ));

    let settings = settings(args, common, &set, &tuning);
    let (motion, choice) = motion(args, &set, &tuning);
    let model = [choice];
    say(&model::lines(&model));
    if let Some(live) = &mut live {
        show_input(live, train.iter().chain(&test));
    }
    // The images are large, so they are moved and returned after training.
    let (called, mut views): (Vec<String>, Vec<TrainingView>) =
        train.into_iter().map(|view| (view.name.clone(), view.into())).unzip();
    let mut scale = posed_scale(&views, first, motion.as_ref(), &settings);
    let foresee =
        |scale: &TrainingScale| args.live.foresee(&device, scale, &tuning, turn(args, &set));
    let mut foreseen = foresee(&scale)?;
    check_memory(
        (first as u64).saturating_mul(BYTES_A_SEED),
        &format!("beginning with {} Gaussians", thousands(first)),
    )?;
    let seeded = seed_from_points(&points(common, &set, &views, first), settings.sh_degree);
    clock.lap("load");
    // The initial Gaussians may be large: sparse points are far apart.
    let near = settings.render.near * posed_unit(&views, &seeded) as f32;
    let render = RenderSettings { near, ..settings.render };
    scale.intersections = pairs_of(&device, &seeded, render, &views)?;
    if scale.is_dense() {
        foreseen = foresee(&scale)?;
    }
    let identity = identity(args, &views, &seeded, &tuning, &settings, motion.as_ref());
    let mut checkpoints = Checkpoints::new(&args.output, &args.checkpoints, identity);
    let (resume, history) = checkpoints.load::<Kept>("training")?.unzip();
    let names = |phase: Phase| match (phase, motion.is_some()) {
        (Phase::Static, true) => ("warm-up", "train"),
        _ => ("training", "train"),
    };
    let mut watcher = Watcher::new(&mut clock, &mut checkpoints, &names)
        .measuring(args.report.is_some())
        .shown(live.as_ref())
        .after(history.unwrap_or_default());
    let mut scene =
        fit_posed(&device, &mut views, &seeded, motion.as_ref(), &settings, resume, &mut watcher)?;
    let watched = watcher.finish();
    let train: Vec<View> = called.into_iter().zip(views).map(picture).collect();
    scene.cameras = in_time(train.iter().chain(&test).map(|view| (view.time, view.camera)));
    scene.background = set.background;
    scene.set_up_from_cameras();
    if let Some(live) = &live {
        live.finished_scene(&scene);
        live.stage("evaluating");
    }
    let mut renderer = Renderer::new(&device, &scene)?;
    let on_input = quality::measure(&mut renderer, &train, set.background, "PSNR, input")?;
    let on_test = quality::measure(&mut renderer, &test, set.background, "PSNR, test")?;
    clock.lap("evaluate");

    let psnr = |of: &[Quality]| quality::mean(of.iter().map(|q| Some(q.psnr)));
    let trained = scene.report.take();
    let mut all_notes = std::mem::take(&mut set.notes);
    note_broken_gradients(&trained, &mut all_notes);
    scene.report = json!({
        "psnr_input": psnr(&on_input),
        "psnr_test": psnr(&on_test),
        "ssim_test": quality::mean(on_test.iter().map(|q| Some(q.ssim))),
        "gaussians": scene.gaussians.len(),
        "control_points": scene.control_points.len(),
        "control_points_added": trained["control_points_added"],
        "control_points_removed": trained["control_points_removed"],
        "broken_gradients": trained["broken_gradients"],
        "dynamic_share": dynamic_share(&scene),
        "model": model,
        "density": match settings.growth {
            None => Value::Null,
            Some(_) => json!(args.density.to_possible_value().map(|v| v.get_name().to_owned())),
        },
        "steps": args.steps,
        "images": train.len(),
        "held_out": test.len(),
        "device": device.info().name,
        "predicted_bytes": foreseen.alone,
    });
    scene.save(&args.output)?;
    checkpoints.remove();
    let mut json = watched.report(&scene, foreseen, &device, &clock);
    if let Some(folder) = &args.report {
        let (views, quality) =
            if test.is_empty() { (&train, &on_input) } else { (&test, &on_test) };
        let pictures = reconstruct_pictures::draw(&device, &scene, views)?;
        let run = Run {
            scene: &scene,
            quality,
            pictures: &pictures,
            history: &watched.history,
            model: &model,
            clock: &clock,
            report: &json,
        };
        let (dataset, points) = (&name_of(&args.dataset)[..], &set.points[..]);
        let page = Page { dataset, points, views, notes: &all_notes, run };
        page.run.save(folder, &page.html()?, &device, views)?;
    }
    json["output"] = path_text(&args.output);
    if let Some(live) = live {
        live.finish();
    }
    Ok(Answer { text: text(&json, &clock), json })
}

/// Reads the list of a dataset's images, and checks that no output overwrites them.
fn open_set(args: &TrainArgs, outputs: &Outputs) -> Result<Dataset> {
    let mut set = Dataset::open(&args.dataset)?;
    notes(&set.notes);
    let images = set.frames.iter().map(|frame| &frame.path);
    let read = images.chain(&set.sources).chain(&args.settings).cloned();
    outputs.spare(&Inputs::new(read, []))?;
    set.background = args.background.unwrap_or(set.background);
    if set.frames.len() < 2 {
        let what = "holds one image only; a scene needs two at least, from different places";
        return Err(Error::format(&args.dataset, what));
    }
    Ok(set)
}

fn settings(args: &TrainArgs, common: &Common, set: &Dataset, tuning: &Tuning) -> TrainSettings {
    let most = args.max_gaussians;
    TrainSettings {
        max_gaussians: if most == 0 { first_gaussians(args, set) } else { most },
        sh_degree: args.sh_degree.min(tuning.sh_degree),
        render: tuning.apply(RenderSettings::default()),
        depth_bits: tuning.depth_bits,
        raster: tuning.raster,
        background: set.background,
        // A visual hull is larger than the subject: faint Gaussians are moved to where it is.
        growth: (most > 0 || begins_in_hull(set)).then(|| growth(args)),
        seed: common.seed,
        ..TrainSettings::of_steps(args.steps)
    }
}

/// How the scene moves, if it does, and the reason.
fn motion(args: &TrainArgs, set: &Dataset, tuning: &Tuning) -> (Option<PosedMotion>, Choice) {
    if !set.timed || args.still {
        let because = if set.timed { "--static" } else { "the images have no times" };
        return (None, Choice::new("motion", "none: no control points, no network", because));
    }
    let usual = PosedMotion { control_points: args.control_points, ..Default::default() };
    let most = tuning.neighbours.map_or(usual.neighbours, |k| k as usize);
    let motion = PosedMotion { neighbours: usual.neighbours.min(most), ..usual };
    let chosen = "every Gaussian follows control points (--static: none)";
    (Some(motion), Choice::new("motion", chosen, "the images have times"))
}

/// Shows the dataset's images beside the scene, in the order of their times.
fn show_input<'a>(live: &mut Live, views: impl Iterator<Item = &'a View>) {
    let mut views: Vec<&View> = views.collect();
    views.sort_by(|a, b| a.time.total_cmp(&b.time));
    live.set_cameras(in_time(views.iter().map(|view| (view.time, view.camera))));
    live.set_pictures(views.iter().map(|view| &view.image));
}

/// A training image as it was loaded.
fn picture((name, view): (String, TrainingView)) -> View {
    let TrainingView { camera, time, image, weights, .. } = view;
    View { name, time, camera, image, valid: weights }
}

fn growth(args: &TrainArgs) -> GrowthSettings {
    match args.density {
        Density::Mcmc => GrowthSettings::Mcmc(McmcSettings::default()),
        Density::Adaptive => GrowthSettings::Adaptive(AdaptiveSettings::scaled_to(args.steps)),
    }
}

/// Initial number of Gaussians: one per point, up to the maximum.
fn first_gaussians(args: &TrainArgs, set: &Dataset) -> usize {
    let most = if args.max_gaussians == 0 { usize::MAX } else { args.max_gaussians };
    let points = if set.points.is_empty() { args.random_points } else { set.points.len() };
    points.min(most)
}

/// Whether the initial Gaussians are random points in the visual hull.
fn begins_in_hull(set: &Dataset) -> bool {
    set.points.is_empty() && set.alpha
}

/// The options that make a training smaller.
fn turn(args: &TrainArgs, set: &Dataset) -> &'static str {
    match (args.max_gaussians, set.points.is_empty()) {
        (0, true) => "lower --random-points, --control-points or --size",
        _ => "give a lower --max-gaussians, --control-points or --size",
    }
}

/// The maximum number of (splat, tile) pairs of the initial Gaussians in an image.
fn pairs_of(
    device: &Device,
    seeded: &Gaussians,
    settings: RenderSettings,
    views: &[TrainingView],
) -> Result<usize> {
    let scene = Scene { settings, ..Scene::of(seeded.clone()) };
    let mut renderer = Renderer::new(device, &scene)?;
    most_pairs(&mut renderer, views.len(), |i| (views[i].camera, views[i].time))
}

/// A number of the dataset's points; random ones where it has none.
fn points(common: &Common, set: &Dataset, views: &[TrainingView], count: usize) -> Vec<Point> {
    if set.points.is_empty() {
        let within = if begins_in_hull(set) { " within what the alpha channels show" } else { "" };
        say(&format!(
            "note: the dataset has no points; beginning with {count} random ones{within}"
        ));
        if begins_in_hull(set) {
            return points_in_hull(views, set.background, count, common.seed);
        }
        let cameras: Vec<Camera> = views.iter().map(|view| view.camera).collect();
        return random_points(&cameras, count, common.seed);
    }
    let mut points = set.points.clone();
    if points.len() > count {
        points.shuffle(&mut ChaCha8Rng::seed_from_u64(common.seed));
        points.truncate(count);
    }
    points
}

/// The images, and everything that the training on them depends on.
fn identity(
    args: &TrainArgs,
    views: &[TrainingView],
    seeded: &Gaussians,
    tuning: &Tuning,
    settings: &TrainSettings,
    motion: Option<&PosedMotion>,
) -> Identity {
    let colour = |[r, g, b]: [f32; 3]| format!("{r},{g},{b}");
    let density = args.density.to_possible_value();
    let mut identity = checkpoints::identity([
        ("--steps", settings.steps.to_string()),
        ("--max-gaussians", args.max_gaussians.to_string()),
        ("--density", shown(density.as_ref().map(|value| value.get_name()))),
        ("--size", shown(args.size)),
        ("--eval-every", args.eval_every.to_string()),
        ("--sh-degree", args.sh_degree.to_string()),
        ("--static", shown(args.still.then_some("given"))),
        ("--control-points", args.control_points.to_string()),
        ("--random-points", args.random_points.to_string()),
        ("--background", shown(args.background.map(colour))),
        ("--seed", settings.seed.to_string()),
        ("the pictures", format!("{} with the checksum {}", views.len(), checksum(views))),
        ("the first Gaussians", format!("{} with the checksum {}", seeded.len(), checksum(seeded))),
        ("the program's settings", summed(Some(&format!("{settings:?} {motion:?}")))),
    ]);
    if let Ok(Value::Object(fields)) = serde_json::to_value(tuning) {
        let known = |(name, value)| (format!("--settings, {name}"), format!("{value}"));
        identity.extend(fields.into_iter().map(known));
    }
    identity
}

/// Cameras in the order of their times.
fn in_time(cameras: impl Iterator<Item = (f64, Camera)>) -> Vec<SceneCamera> {
    let mut cameras: Vec<SceneCamera> =
        cameras.map(|(time, camera)| SceneCamera { time, camera }).collect();
    cameras.sort_by(|a, b| a.time.total_cmp(&b.time));
    cameras
}

fn text(report: &Value, clock: &Clock) -> String {
    let number = |key: &str| report[key].as_f64();
    let decibels = |key| number(key).map_or("none".into(), |v| format!("{v:.2} dB"));
    format!(
        "scene        {}\nPSNR, input  {}\nPSNR, test   {} ({} images)\nGaussians    {}\n\
         step         {:.1} ms\ntime         {}\nmemory       {} at most on the device\n",
        report["output"].as_str().unwrap_or_default(),
        decibels("psnr_input"),
        decibels("psnr_test"),
        report["held_out"],
        thousands(report["gaussians"].as_u64().unwrap_or(0) as usize),
        number("milliseconds_per_step").unwrap_or(0.0),
        clock.line(),
        bytes(report["peak_bytes"].as_u64().unwrap_or(0)),
    )
}

#[cfg(test)]
mod tests {
    use super::super::checkpoints::tests::names_every_option;
    use super::*;

    #[test]
    fn a_checkpoint_names_every_option_that_matters() {
        names_every_option(&["train", "set", "-o", "x"], &["view", "host"], |command, _| {
            let super::super::Command::Train(args) = command else { panic!("no train") };
            let none = Gaussians::default();
            identity(args, &[], &none, &Tuning::default(), &TrainSettings::default(), None)
        });
    }
}
