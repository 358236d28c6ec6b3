//! `splat4d reconstruct`: reconstructs a 4D scene from a video.

use std::fmt::Write;
use std::path::PathBuf;

use clap::{Args, ValueEnum};
use serde_json::{Value, json};
use splat4d::data::View;
use splat4d::gpu::{Device, DeviceKind};
use splat4d::io::{Identity, check_memory, checksum};
use splat4d::observe::{EngineFlow, SuppliedFlow};
use splat4d::renderer::Renderer;
use splat4d::scene::Scene;
use splat4d::track::Options;
use splat4d::train::{
    Phase, Preset, Quality, Sequence, SequenceSettings, TrainingScale, first_gaussians,
    fit_sequence,
};
use splat4d::types::{Camera, FlowSettings, Image, Tuning};
use splat4d::{Error, Result};

use super::checkpoints::{self, CheckpointArgs, Checkpoints, shown, summed};
use super::clip::{ClipArgs, shots_json};
use super::clock::Clock;
use super::common::{
    Answer, Common, bytes, foresee, most_pairs, note_broken_gradients, notes, path_text, say,
    thousands,
};
use super::info::dynamic_share;
use super::known::{
    CAMERA_FILES, KnownArgs, focal_source, intrinsics_json, lens_json, observe, poses_json,
    write_cameras,
};
use super::live::{Foreseen, LiveArgs, name_of};
use super::networks::{estimate_depth, estimate_pointmaps};
use super::origins::{self, Networks};
use super::outputs::{Inputs, Outputs};
use super::reconstruct_page::Page;
use super::run_page::{self, Run};
use super::tracker::Tracker;
use super::watcher::{Kept, Watcher};
use super::{model, quality, reconstruct_pictures, sheet, values};

/// Host memory per pixel and frame, bytes: of the frames themselves, and of the results of tracking, which
/// are flow and confidence in both directions, masks, depth and its confidence, and undistorted copies of
/// frames and flow.
const FRAME_BYTES: u64 = 12;
const TRACK_BYTES: u64 = 72;

const AFTER_HELP: &str = "\
The clip is a moving camera's: a video file (read through ffmpeg), a folder of frames in the order of
their names, or a dataset as `train` takes it (its training images, by time) or of one clip of
DAVIS. Of a clip with cuts one shot is taken, the longest unless --shot says another;
--every and --max-frames count within it. A camera that stands still is recognised; then its frames
give no depth by themselves, and new views stay close to the old ones.

Examples:
  splat4d reconstruct video.mp4 -o scene.safetensors
  splat4d reconstruct video.mp4 -o look.safetensors --quality draft
  splat4d reconstruct frames/ -o scene.safetensors --every 2 --size 320 --report report
  splat4d reconstruct video.mp4 -o scene.safetensors --view

With --view only this machine reaches the page; with --host the machines that reach that address do, too, and
the page's address then holds a random token. The page changes nothing of the scene that comes out.

JSON: psnr_input, ssim_input, gaussians, control_points, control_points_added and control_points_removed (in
training), windows (into which the clip was cut, so that what moves has Gaussians of its own in each; null
where nothing moves), broken_gradients (values that were not a number or infinite and were left out),
dynamic_share (of the pixels), dynamic_gaussians (share), intrinsics {fx, fy, cx, cy, width, height, source
(given, measured, assumed)}, lens (by which the frames were undistorted: {k1, fx, fy, cx, cy, width, height};
null of a pinhole), poses {tripod, turns, inlier_share, reprojection_rms, parallax_deg, focal_std,
doubtful_frames, tracks, motions (that the static world was chosen from, where that was in doubt: [{explained,
hidden, hides}]), static_motion (the one taken, or null)}, exposure (per frame, by what red, green and blue
were multiplied, 0.055 added to the encoded values; null where it does not change), frames, frame_names, shot
(the one taken, or null), shots ([first, last] frame of each, in the whole clip; empty where no cut was
found), quality, model [{what, chosen, because, saves}] (each choice, the measurement that decided and what it
saves), sources (of cameras, flow, depth, masks, pointmaps, features and tracks: {source (built_in, network,
supplied, none), from (the network's file or the option), how}), notes, device, predicted_bytes (of device
memory, before it began), all also kept in the scene; and, in report.json too, peak_bytes,
milliseconds_per_step, seconds {load, flow, cameras, masks, depth, static, joint, evaluate}; output.
report.json alone has training [{phase (static, joint), step, gaussians, l1, ssim, psnr (dB, or null)}],
measured on one frame each";

const QUALITY: &str = "longest side of the frames, steps, most Gaussians (or one for so many
pixels of a frame, where that is more), most control points, degree of the spherical harmonics.";

fn after_help() -> String {
    let mut table = format!(
        "{:26}{:>6}{:>7}{:>11}{:>10}{:>9}{:>4}\n",
        "", "size", "steps", "Gaussians", "or 1 per", "control", "SH"
    );
    let kinds = [
        ("software", DeviceKind::Software),
        ("integrated GPU", DeviceKind::Integrated),
        ("discrete GPU", DeviceKind::Discrete),
    ];
    for quality in Quality::ALL {
        for (device, kind) in kinds {
            let Preset { longest_side, steps, gaussians, pixels_per_gaussian, .. } =
                quality.preset(kind);
            let Preset { control_points, sh_degree, .. } = quality.preset(kind);
            let _ = writeln!(
                table,
                "{:26}{longest_side:>6}{steps:>7}{:>11}{:>10}\
                 {control_points:>9}{sh_degree:>4}",
                format!("{}, {device}", quality.name()),
                thousands(gaussians),
                format!("{pixels_per_gaussian} px"),
            );
        }
    }
    format!("What --quality stands for: {QUALITY}\n{table}\n{AFTER_HELP}")
}

/// [`Quality`] by name.
#[derive(Clone, Copy, Debug, ValueEnum)]
enum QualityName {
    /// A quick preview
    Draft,
    /// The default
    Standard,
    /// Larger frames, more of everything, and an hour's training on a software driver
    Best,
}

impl From<QualityName> for Quality {
    fn from(name: QualityName) -> Quality {
        match name {
            QualityName::Draft => Quality::Draft,
            QualityName::Standard => Quality::Standard,
            QualityName::Best => Quality::Best,
        }
    }
}

/// Reconstruct a 4D scene from a video whose camera poses are unknown
#[derive(Args)]
#[command(after_help = after_help())]
pub struct ReconstructArgs {
    /// A video file, or a folder of its frames
    #[arg(value_name = "VIDEO|DIR")]
    clip: PathBuf,
    /// The output scene file
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    #[command(flatten)]
    frames: ClipArgs,
    /// Trade-off between quality and time: sizes, steps and limits, each of which its own option overrides
    #[arg(long, value_enum, default_value = "standard")]
    quality: QualityName,
    /// Steps of the last and longest stage; earlier stages scale in proportion [default: by quality]
    #[arg(long, value_name = "N", value_parser = values::whole::<u32>(1..=values::MOST_STEPS))]
    steps: Option<u32>,
    /// Maximum number of Gaussians [default: by quality; standard 40,000, or one for every three pixels of
    /// a frame]
    #[arg(long, value_name = "N",
          value_parser = values::whole::<usize>(16..=values::MOST_GAUSSIANS))]
    max_gaussians: Option<usize>,
    /// Maximum number of control points [default: by quality; standard 256]
    #[arg(long, value_name = "N",
          value_parser = values::whole::<usize>(1..=values::MOST_CONTROL_POINTS))]
    control_points: Option<usize>,
    /// Maximum degree of the spherical harmonics [default: by quality; standard 1]
    #[arg(long, value_name = "0..3", value_parser = values::whole::<u32>(0..=3))]
    sh_degree: Option<u32>,
    #[command(flatten)]
    known: KnownArgs,
    /// Write report.html (a page with all results), report.json, sheet.png (input, render, motion mask,
    /// depth), poses.txt (TUM) and intrinsics.json to this folder
    #[arg(long, value_name = "DIR")]
    report: Option<PathBuf>,
    #[command(flatten)]
    live: LiveArgs,
    #[command(flatten)]
    checkpoints: CheckpointArgs,
}

impl ReconstructArgs {
    /// Checks that the options are compatible.
    pub fn check(&self) -> Result<()> {
        self.known.check(&self.frames)
    }

    /// Checks the output paths.
    pub fn outputs(&self) -> Result<Outputs> {
        let mut outputs = Outputs::default().file(&self.output)?;
        if let Some(folder) = &self.report {
            outputs = outputs.folder(folder, &sheet::FILES)?.folder(folder, &CAMERA_FILES)?;
            outputs = outputs.folder(folder, &[run_page::FILE])?;
        }
        self.checkpoints.check(&self.output)?;
        Ok(outputs)
    }

    /// All inputs.
    pub fn inputs(&self) -> Inputs {
        self.known.inputs(&self.clip)
    }
}

/// Runs the command.
pub fn run(args: &ReconstructArgs, common: &Common) -> Result<Answer> {
    args.outputs()?.spare(&args.inputs())?;
    args.check()?;
    let mut clock = Clock::start();
    // A missing file is reported before a missing driver.
    std::fs::metadata(&args.clip).map_err(Error::io(&args.clip))?;
    let mut models = args.known.networks.open()?;
    let device = common.open_device()?;
    let mut live = args.live.start(&device, &name_of(&args.clip), Tuning::default())?;
    if let Some(live) = &live {
        live.stage("reading the clip");
    }
    let quality = Quality::from(args.quality);
    let preset = quality.preset(device.info().kind);
    let usual = args.known.size(preset.longest_side);
    let clip = args.frames.open(&args.clip, usual, args.known.is_for_each_frame())?;
    let options = args.known.options(&clip, common.seed)?;
    let flow = args.known.flow(&clip)?;
    let times: Vec<f64> = clip.frames.iter().map(|frame| frame.time).collect();
    let names: Vec<String> = clip.frames.iter().map(|frame| frame.name.clone()).collect();
    let (width, height, original) = (clip.width, clip.height, clip.original);
    let (shot, shots) = (clip.shot, clip.shots);
    let mut all_notes = clip.notes;
    let frames: Vec<Image> = clip.frames.into_iter().map(|frame| frame.image).collect();
    if let Some(live) = &mut live {
        live.set_pictures(&frames);
    }
    check_host_memory(args, frames.len(), (width, height), original)?;
    clock.lap("load");

    let settings = settings(args, common, &preset, (width, height));
    let scale = settings.scale(frames.len(), (width, height));
    let mut predicted = foreseen(args, &device, &scale, (width, height))?;
    let networks = args.known.networks.identity()?;
    let identity = identity(args, &frames, &options, flow.as_ref(), &settings, &networks);
    let mut checkpoints = Checkpoints::new(&args.output, &args.checkpoints, identity);
    let track = match checkpoints.load("track")? {
        Some(track) => track,
        None => {
            let mut options = options;
            estimate_depth(&mut models, &frames, &mut options)?;
            let of_pointmaps = estimate_pointmaps(&mut models, &frames, &mut options)?;
            let mut tracker = Tracker::new(&mut clock, Some(&mut checkpoints)).shown(live.as_ref());
            let mut found = observe(&device, &frames, &options, flow, &mut models, &mut tracker)?;
            found.quality.notes.extend(of_pointmaps);
            tracker.finish();
            checkpoints.tracked(&found);
            found
        }
    };
    let found = &track.quality;
    notes(&found.notes);
    all_notes.extend_from_slice(&found.notes);
    say(&format!(
        "focal length {:.1} px ({}), {:.1} % of the pixels move",
        track.intrinsics.fx,
        focal_source(found.focal_source),
        100.0 * found.dynamic_share
    ));

    let sequence = Sequence { frames: &frames, times: &times, track: &track };
    // The initial Gaussians may be large: near ones cover many tiles.
    let intersections = first_pairs(&device, sequence, &settings)?;
    let scale = TrainingScale { intersections, ..scale };
    if scale.is_dense() {
        predicted = predicted.max(foreseen_training(args, &device, &scale)?);
    }
    let (resume, history) = checkpoints.load::<Kept>("training")?.unzip();
    let mut watcher = Watcher::new(&mut clock, &mut checkpoints, &phase_names)
        .measuring(args.report.is_some())
        .shown(live.as_ref())
        .after(history.unwrap_or_default());
    let mut scene = fit_sequence(&device, sequence, &settings, resume, &mut watcher)?;
    let watched = watcher.finish();
    let model = model::of_clip(&scene, &track, &settings);
    say(&model::lines(&model));
    if let Some(live) = &live {
        live.finished_scene(&scene);
        live.stage("evaluating");
    }

    let frames = track.prepared(&frames).into_owned();
    let views = views(frames, &names, &scene);
    let mut renderer = Renderer::new(&device, &scene)?;
    let measured = quality::measure(&mut renderer, &views, scene.background, "PSNR, input")?;
    clock.lap("evaluate");

    let origins = origins::of(args.known.given(), &Networks::of(models.as_ref()), &found.told);
    let trained = scene.report.take();
    note_broken_gradients(&trained, &mut all_notes);
    scene.report = json!({
        "psnr_input": quality::mean(measured.iter().map(|q| Some(q.psnr))),
        "ssim_input": quality::mean(measured.iter().map(|q| Some(q.ssim))),
        "gaussians": scene.gaussians.len(),
        "control_points": scene.control_points.len(),
        "control_points_added": trained["control_points_added"],
        "control_points_removed": trained["control_points_removed"],
        "windows": trained["windows"],
        "broken_gradients": trained["broken_gradients"],
        "dynamic_share": found.dynamic_share,
        "dynamic_gaussians": dynamic_share(&scene),
        "intrinsics": intrinsics_json(&track),
        "lens": lens_json(track.lens.as_ref()),
        "poses": poses_json(found),
        "exposure": (!track.exposure.is_constant()).then_some(&track.exposure.gains),
        "frames": names.len(),
        "frame_names": names,
        "shot": shot,
        "shots": shots_json(&shots),
        "quality": quality.name(),
        "model": model,
        "sources": origins::to_json(&origins),
        "notes": all_notes,
        "device": device.info().name,
        "predicted_bytes": predicted.alone,
    });
    scene.save(&args.output)?;
    checkpoints.remove();
    let mut json = watched.report(&scene, predicted, &device, &clock);
    if let Some(folder) = &args.report {
        let pictures = reconstruct_pictures::draw(&device, &scene, &views)?;
        let run = Run {
            scene: &scene,
            quality: &measured,
            pictures: &pictures,
            history: &watched.history,
            model: &model,
            clock: &clock,
            report: &json,
        };
        let page = Page {
            clip: &name_of(&args.clip),
            names: &names,
            track: &track,
            supplied: args.known.supplies_poses(),
            origins: &origins,
            run,
        };
        page.run.save(folder, &page.html()?, &device, &views)?;
        write_cameras(folder, scene.cameras.iter().map(|known| known.camera))?;
    }
    json["output"] = path_text(&args.output);
    if let Some(live) = live {
        live.finish();
    }
    Ok(Answer { text: text(&json, &clock), json })
}

/// Says how large the clip is, and checks that it can be tracked in the host's memory.
fn check_host_memory(
    args: &ReconstructArgs,
    frames: usize,
    (width, height): (u32, u32),
    original: (u32, u32),
) -> Result<()> {
    let host = frames as u64 * u64::from(width) * u64::from(height);
    say(&format!(
        "{frames} frames of {width}×{height} (from {}×{}), {} of memory",
        original.0,
        original.1,
        bytes(FRAME_BYTES * host)
    ));
    let what = format!("tracking {frames} frames of {width}×{height}");
    let shown = reconstruct_pictures::bytes(frames, (width, height));
    let of_page = if args.report.is_some() { shown } else { 0 };
    check_memory((TRACK_BYTES * host).max(FRAME_BYTES * host + of_page), &what)
}

/// Peak device memory of the stages; an error where one does not fit.
fn foreseen(
    args: &ReconstructArgs,
    device: &Device,
    scale: &TrainingScale,
    size: (u32, u32),
) -> Result<Foreseen> {
    let training = foreseen_training(args, device, scale)?;
    if args.known.supplies_flow() {
        return Ok(training);
    }
    let footprint = EngineFlow::footprint(device, size, &FlowSettings::default());
    let flow = foresee(device, "optical flow", footprint, || 0, "lower --size")?;
    Ok(training.max(flow.into()))
}

fn foreseen_training(
    args: &ReconstructArgs,
    device: &Device,
    scale: &TrainingScale,
) -> Result<Foreseen> {
    let turn = "lower --max-gaussians, --control-points or --size";
    args.live.foresee(device, scale, &Tuning::default(), turn)
}

/// The maximum number of (splat, tile) pairs of the initial Gaussians in a frame.
fn first_pairs(
    device: &Device,
    sequence: Sequence<'_>,
    settings: &SequenceSettings,
) -> Result<usize> {
    let seeds = first_gaussians(sequence, settings);
    if seeds.is_empty() {
        return Ok(0);
    }
    let mut renderer = Renderer::new(device, &Scene::of(seeds))?;
    let Sequence { times, track, .. } = sequence;
    most_pairs(&mut renderer, times.len(), |frame| {
        let view_from_world = track.view_from_world[frame];
        (Camera { intrinsics: track.intrinsics, view_from_world }, times[frame])
    })
}

fn settings(
    args: &ReconstructArgs,
    common: &Common,
    preset: &Preset,
    size: (u32, u32),
) -> SequenceSettings {
    let usual = preset.settings(size, args.steps);
    SequenceSettings {
        max_gaussians: args.max_gaussians.unwrap_or(usual.max_gaussians),
        control_points: args.control_points.unwrap_or(usual.control_points),
        sh_degree: args.sh_degree.unwrap_or(usual.sh_degree),
        seed: common.seed,
        ..usual
    }
}

/// Names of a phase, on the progress bar and in the report.
fn phase_names(phase: Phase) -> (&'static str, &'static str) {
    let name = match phase {
        Phase::Static => "static",
        Phase::Joint => "joint",
    };
    (name, name)
}

/// The clip, and everything that its reconstruction depends on.
fn identity(
    args: &ReconstructArgs,
    frames: &[Image],
    options: &Options,
    flow: Option<&SuppliedFlow>,
    settings: &SequenceSettings,
    networks: &str,
) -> Identity {
    let size = frames.first().map(|frame| format!("{}×{}", frame.width, frame.height));
    let estimated = options.estimated_depth.as_ref().map(|told| &told.maps);
    checkpoints::identity([
        ("--quality", Quality::from(args.quality).name().to_owned()),
        ("--steps", settings.steps.to_string()),
        ("--max-gaussians", settings.max_gaussians.to_string()),
        ("--control-points", settings.control_points.to_string()),
        ("--sh-degree", settings.sh_degree.to_string()),
        ("--seed", settings.seed.to_string()),
        ("--shot", shown(args.frames.shot)),
        ("--every", args.frames.every.to_string()),
        ("--max-frames", shown(args.frames.max_frames)),
        ("--size or --width", shown(size)),
        ("--focal", shown(args.known.focal)),
        ("--refine", format!("{:?}", args.known.refine)),
        ("--depth-scale", args.known.depth_scale.to_string()),
        ("--depth-kind", format!("{:?}", args.known.depth_kind)),
        ("--static", shown(args.known.static_motion)),
        ("--pinhole", args.known.pinhole.to_string()),
        ("--intrinsics", summed(options.intrinsics.as_ref())),
        ("--poses", summed(options.poses.as_ref())),
        ("--masks", summed(options.masks.as_ref())),
        ("--depth", summed(options.depth.as_ref().or(estimated))),
        ("--tracks", summed(options.tracks.as_ref())),
        ("--flow", summed(flow)),
        ("--models", networks.to_owned()),
        ("the frames", format!("{} with the checksum {}", frames.len(), checksum(frames))),
        // Inputs that no option specifies: the focal length in the images' EXIF data, and the settings of
        // this version.
        ("what is known beforehand", summed(Some(options))),
        ("the program's settings", summed(Some(&format!("{settings:?}")))),
    ])
}

/// The training frames with the scene's cameras.
fn views(frames: Vec<Image>, names: &[String], scene: &Scene) -> Vec<View> {
    frames
        .into_iter()
        .zip(names)
        .zip(&scene.cameras)
        .map(|((image, name), known)| View {
            name: name.clone(),
            time: known.time,
            camera: known.camera,
            image,
            valid: None,
        })
        .collect()
}

fn text(report: &Value, clock: &Clock) -> String {
    let number = |key: &str| report[key].as_f64().unwrap_or(f64::NAN);
    let pose = |key: &str| report["poses"][key].as_f64().unwrap_or(f64::NAN);
    let whole = |key: &str| report[key].as_u64().unwrap_or(0);
    format!(
        "scene           {}\nPSNR, input     {:.2} dB\nfocal length    {:.1} px ({})\n\
         poses           {:.0} % of {} tracks agree within {:.2} px rms, parallax {:.1}°\n\
         moving pixels   {:.1} %\nGaussians       {} ({:.1} % dynamic)\ncontrol points  {}\n\
         time            {}\nmemory          {} at most on the device\n",
        report["output"].as_str().unwrap_or_default(),
        number("psnr_input"),
        report["intrinsics"]["fx"].as_f64().unwrap_or(f64::NAN),
        report["intrinsics"]["source"].as_str().unwrap_or_default(),
        100.0 * pose("inlier_share"),
        report["poses"]["tracks"],
        pose("reprojection_rms"),
        pose("parallax_deg"),
        100.0 * number("dynamic_share"),
        thousands(whole("gaussians") as usize),
        100.0 * number("dynamic_gaussians"),
        whole("control_points"),
        clock.line(),
        bytes(whole("peak_bytes")),
    )
}

#[cfg(test)]
mod tests {
    use super::super::checkpoints::tests::names_every_option;
    use super::*;

    fn preset() -> Preset {
        Quality::default().preset(DeviceKind::Software)
    }

    #[test]
    fn a_checkpoint_names_every_option_that_matters() {
        names_every_option(
            &["reconstruct", "clip", "-o", "x"],
            // From the second on: how networks are run, and the live view.
            &["skip-bad", "onnxruntime", "ep", "onnx-threads", "view", "host"],
            |command, common| {
                let super::super::Command::Reconstruct(args) = command else {
                    panic!("no reconstruct")
                };
                identity(
                    args,
                    &[],
                    &Options::default(),
                    None,
                    &settings(args, common, &preset(), (32, 18)),
                    "none",
                )
            },
        );
    }

    #[test]
    fn a_checkpoint_belongs_to_what_a_flow_holds() {
        use clap::Parser;
        let cli = super::super::Cli::try_parse_from([
            "splat4d",
            "reconstruct",
            "clip",
            "-o",
            "x",
            "--flow",
            "flow",
        ])
        .unwrap();
        let super::super::Command::Reconstruct(args) = &cli.command else { panic!() };
        let of = |value: f32| {
            let mut field = Image::new(4, 3, 2);
            field.pixels[5] = value;
            let flow = SuppliedFlow::new(vec![field.clone()], vec![field]).unwrap();
            let settings = settings(args, &cli.common, &preset(), (32, 18));
            identity(args, &[], &Options::default(), Some(&flow), &settings, "none")
        };
        assert_eq!(of(0.5), of(0.5));
        assert_ne!(of(0.5)["--flow"], of(0.25)["--flow"]);
    }
}
