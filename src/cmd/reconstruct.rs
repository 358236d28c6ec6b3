//! `splat4d reconstruct`: the main job.

use std::path::{Path, PathBuf};
use std::time::Instant;

use clap::Args;
use serde_json::{Map, Value, json};
use splat4d::data::{self, Clip, ClipOptions, Resize, View, exr, flo, images, trajectory};
use splat4d::observe::{EngineFlow, FlowSource, SuppliedFlow};
use splat4d::renderer::Renderer;
use splat4d::scene::Scene;
use splat4d::track::{self, FocalSource, Stage, Track, track};
use splat4d::train::{Phase, Sequence, SequenceSettings, fit_sequence};
use splat4d::types::{Camera, FlowSettings, Image, Intrinsics, Pose};
use splat4d::{Error, Result};

use super::common::{
    Answer, Common, bytes, check_output_file, check_output_folder, notes, say, thousands,
};
use super::info::dynamic_share;
use super::meter::Meter;
use super::quality::{self, Quality};
use super::{interrupt, sheet, values};

const AFTER_HELP: &str = "\
INPUT is a video file (read through ffmpeg) or a folder of images in the order of their names.
Poses and focal length are found from the pictures; give what is known.

Example:
  splat4d reconstruct holiday.mp4 -o holiday.safetensors --every 2 --width 320 --report out

JSON (also kept in the scene): psnr_input, gaussians, control_points, dynamic_share,
intrinsics {fx, fy, cx, cy, width, height, source}, poses {tripod, inlier_share, reprojection_rms,
parallax_deg, focal_std, doubtful_frames}, frames, device, peak_bytes, seconds {load, track, train,
evaluate}, notes, output";

/// Turn one video of a moving scene, camera poses unknown, into a 4D scene
#[derive(Args)]
#[command(after_help = AFTER_HELP)]
pub struct ReconstructArgs {
    /// A video file or a folder of images
    #[arg(value_name = "VIDEO|DIR")]
    input: PathBuf,
    /// The scene's file to write
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// Take every so-manieth frame
    #[arg(long, value_name = "N", default_value_t = 1)]
    every: usize,
    /// Take at most so many frames
    #[arg(long, value_name = "N")]
    max_frames: Option<usize>,
    /// Shrink frames so that their longer side has at most so many pixels
    #[arg(long, value_name = "LONGEST", default_value_t = 480,
          value_parser = clap::value_parser!(u32).range(16..))]
    size: u32,
    /// Shrink frames to this width instead
    #[arg(long, value_name = "PIXELS", value_parser = clap::value_parser!(u32).range(16..))]
    width: Option<u32>,
    /// Steps of the second stage, one frame each
    #[arg(long, value_name = "N", default_value_t = SequenceSettings::default().steps,
          value_parser = clap::value_parser!(u32).range(1..))]
    steps: u32,
    /// Most Gaussians
    #[arg(long, value_name = "N", default_value_t = SequenceSettings::default().max_gaussians)]
    max_gaussians: usize,
    /// Most control points
    #[arg(long, value_name = "N", default_value_t = SequenceSettings::default().control_points)]
    control_points: usize,
    /// Focal length in pixels of the frames as taken, where it is known
    #[arg(long, value_name = "PIXELS", value_parser = values::positive)]
    focal: Option<f64>,
    /// intrinsics.json with fx, fy, cx, cy, width, height
    #[arg(long, value_name = "FILE", conflicts_with = "focal")]
    intrinsics: Option<PathBuf>,
    /// Camera-to-world poses in TUM format, one per frame
    #[arg(long, value_name = "FILE")]
    poses: Option<PathBuf>,
    /// Folder of motion masks (PNG, white moves), one per frame
    #[arg(long, value_name = "DIR")]
    masks: Option<PathBuf>,
    /// Folder of depth maps (EXR), one per frame
    #[arg(long, value_name = "DIR")]
    depth: Option<PathBuf>,
    /// Folder with forward and backward optical flow: flow_forward/*.flo, flow_backward/*.flo
    #[arg(long, value_name = "DIR")]
    flow: Option<PathBuf>,
    /// Leave out images that cannot be read instead of failing
    #[arg(long)]
    skip_bad: bool,
    /// Write report.json and sheet.png (input, render, motion mask, depth) into this folder
    #[arg(long, value_name = "DIR")]
    report: Option<PathBuf>,
}

/// Runs the command.
pub fn run(args: &ReconstructArgs, common: &Common) -> Result<Answer> {
    check_output_file(&args.output)?;
    args.report.as_deref().map_or(Ok(()), check_output_folder)?;
    let mut seconds = Map::new();
    let mut begun = Instant::now();
    let mut lap = |stage: &str| {
        seconds.insert(stage.into(), json!(begun.elapsed().as_secs_f64()));
        begun = Instant::now();
    };
    let size = args.width.map_or(Resize::Longest(args.size), Resize::Width);
    let clip = Clip::open(
        &args.input,
        &ClipOptions {
            every: args.every.max(1),
            max_frames: args.max_frames,
            size,
            skip_bad: args.skip_bad,
        },
    )?;
    notes(&clip.notes);
    say(&format!("{} frames of {}×{}", clip.frames.len(), clip.width, clip.height));
    let frames: Vec<Image> = clip.frames.iter().map(|frame| frame.image.clone()).collect();
    let times: Vec<f64> = clip.frames.iter().map(|frame| frame.time).collect();
    let options = options(args, common, &clip)?;
    let device = common.open_device()?;
    lap("load");

    let mut source: Box<dyn FlowSource> = match &args.flow {
        Some(folder) => Box::new(supplied_flow(folder, frames.len())?),
        None => Box::new(EngineFlow::new(&device, &frames, &FlowSettings::default())?),
    };
    let tracked = watch_track(&frames, &options, source.as_mut())?;
    drop(source);
    notes(&tracked.quality.notes);
    say(&describe(&tracked));
    lap("track");

    let settings = SequenceSettings {
        steps: args.steps,
        max_gaussians: args.max_gaussians,
        control_points: args.control_points,
        seed: common.seed,
        ..SequenceSettings::default()
    };
    let sequence = Sequence { frames: &frames, times: &times, track: &tracked };
    let mut meter: Option<(Phase, Meter)> = None;
    let mut scene = fit_sequence(&device, sequence, &settings, &mut |phase, step, steps| {
        if meter.as_ref().is_none_or(|(current, _)| *current != phase) {
            meter = Some((phase, Meter::new(title(phase), "steps", steps.into(), 0)));
        }
        if let Some((_, meter)) = &mut meter {
            meter.set(step.into());
        }
        interrupt::check()
    })?;
    drop(meter);
    if scene.control_points.is_empty() {
        say("nothing moves: no control points, no deformation network");
    }
    lap("train");

    let views: Vec<View> = clip
        .frames
        .iter()
        .zip(&scene.cameras)
        .map(|(frame, at)| View {
            name: frame.name.clone(),
            time: frame.time,
            camera: at.camera,
            image: frame.image.clone(),
            valid: None,
        })
        .collect();
    let mut renderer = Renderer::new(&device, &scene)?;
    let mut found = Vec::new();
    for view in &views {
        let picture = renderer.render(&view.camera, view.time)?.over(scene.background);
        found.push(Quality::of(&view.name, &picture, &view.image, None)?);
    }
    lap("evaluate");
    scene.report = report(&scene, &tracked, &found, device.info().name.as_str());
    scene.report["peak_bytes"] = json!(device.memory().1);
    scene.report["seconds"] = Value::Object(seconds);
    scene.save(&args.output)?;
    if let Some(folder) = &args.report {
        sheet::write(folder, &device, &scene, &sheet::spread(&views))?;
    }
    let mut json = scene.report.clone();
    json["output"] = json!(args.output);
    Ok(Answer { text: text(&json), json })
}

fn title(phase: Phase) -> &'static str {
    match phase {
        Phase::Static => "static world",
        Phase::Trajectories => "trajectories",
        Phase::Control => "control points",
        Phase::Joint => "scene",
    }
}

/// What the user already has, in the frames' size.
fn options(args: &ReconstructArgs, common: &Common, clip: &Clip) -> Result<track::Options> {
    let count = clip.frames.len();
    let intrinsics = match &args.intrinsics {
        Some(path) => Some(data::intrinsics::read(path)?.resized(clip.width, clip.height)),
        None => None,
    };
    let poses = match &args.poses {
        Some(path) => Some(supplied_poses(path, count)?),
        None => None,
    };
    let masks = match &args.masks {
        Some(folder) => Some(one_per_frame(folder, count, |path| {
            let mask = images::read_mask(path)?;
            Ok(images::resize(&mask, clip.width, clip.height))
        })?),
        None => None,
    };
    let depth = match &args.depth {
        Some(folder) => Some(one_per_frame(folder, count, |path| {
            let depth = exr::read_depth(path)?;
            Ok(images::resize(&depth, clip.width, clip.height))
        })?),
        None => None,
    };
    Ok(track::Options {
        intrinsics,
        focal: args.focal.or(clip.focal),
        poses,
        masks,
        depth,
        seed: common.seed,
        ..track::Options::default()
    })
}

fn supplied_poses(path: &Path, count: usize) -> Result<Vec<Pose>> {
    let poses = trajectory::read(path, None)?;
    if poses.len() != count {
        return Err(Error::format(
            path,
            format!("holds {} poses for {count} frames; one per frame is needed", poses.len()),
        ));
    }
    Ok(poses.iter().map(|pose| pose.world_from_view.inverse()).collect())
}

/// The files of a folder in the order of their names, one for each frame.
fn one_per_frame(
    folder: &Path,
    count: usize,
    read: impl Fn(&Path) -> Result<Image>,
) -> Result<Vec<Image>> {
    let mut files: Vec<PathBuf> = std::fs::read_dir(folder)
        .map_err(Error::io(folder))?
        .filter_map(|entry| entry.ok().map(|entry| entry.path()))
        .filter(|path| path.is_file())
        .collect();
    files.sort_by(|a, b| images::natural(&a.to_string_lossy(), &b.to_string_lossy()));
    if files.len() != count {
        return Err(Error::format(
            folder,
            format!("holds {} files for {count} frames; one per frame is needed", files.len()),
        ));
    }
    files.iter().map(|path| read(path)).collect()
}

fn supplied_flow(folder: &Path, count: usize) -> Result<SuppliedFlow> {
    let read = |name: &str| one_per_frame(&folder.join(name), count - 1, |path| flo::read(path));
    SuppliedFlow::new(read("flow_forward")?, read("flow_backward")?)
}

fn watch_track(
    frames: &[Image],
    options: &track::Options,
    source: &mut dyn FlowSource,
) -> Result<Track> {
    let mut meter: Option<(Stage, Meter)> = None;
    track(frames, options, source, &mut |stage, share| {
        if meter.as_ref().is_none_or(|(current, _)| *current != stage) {
            let title = match stage {
                Stage::Flow => "optical flow",
                Stage::Cameras => "cameras",
                Stage::Masks => "motion masks",
                Stage::Depth => "depth",
            };
            meter = Some((stage, Meter::new(title, "%", 100, 0)));
        }
        if let Some((_, meter)) = &mut meter {
            meter.set((100.0 * share) as u64);
        }
        interrupt::check()
    })
}

/// One line on what was found.
fn describe(track: &Track) -> String {
    let q = &track.quality;
    let source = focal_source(q.focal_source);
    let cameras = match q.tripod {
        true => "the camera stands still".to_string(),
        false => format!(
            "{:.0} % of the static points agree within {:.2} px",
            100.0 * q.inlier_share,
            q.reprojection_rms
        ),
    };
    format!(
        "focal length {:.1} px ({source}); {cameras}; {:.1} % of the pixels move",
        track.intrinsics.fx,
        100.0 * q.dynamic_share
    )
}

fn focal_source(source: FocalSource) -> &'static str {
    match source {
        FocalSource::Given => "given",
        FocalSource::Measured => "measured",
        FocalSource::Assumed => "assumed",
    }
}

fn report(scene: &Scene, track: &Track, found: &[Quality], device: &str) -> Value {
    let q = &track.quality;
    let finite = |value: f64| value.is_finite().then_some(value);
    let Camera { intrinsics: k, .. } = scene.cameras[0].camera;
    let Intrinsics { fx, fy, cx, cy, width, height } = k;
    json!({
        "psnr_input": quality::mean(found, |q| Some(q.psnr)),
        "ssim_input": quality::mean(found, |q| Some(q.ssim)),
        "gaussians": scene.gaussians.len(),
        "control_points": scene.control_points.len(),
        "dynamic_share": q.dynamic_share,
        "dynamic_gaussians": dynamic_share(scene),
        "intrinsics": {
            "fx": fx, "fy": fy, "cx": cx, "cy": cy, "width": width, "height": height,
            "source": focal_source(q.focal_source),
        },
        "poses": {
            "tripod": q.tripod,
            "inlier_share": finite(q.inlier_share),
            "reprojection_rms": finite(q.reprojection_rms),
            "parallax_deg": finite(q.parallax_deg),
            "focal_std": finite(q.focal_std),
            "doubtful_frames": q.doubtful_frames,
        },
        "frames": found.len(),
        "device": device,
        "notes": q.notes,
    })
}

fn text(report: &Value) -> String {
    let number = |key: &str| report[key].as_f64().unwrap_or(0.0);
    let seconds: Vec<String> = report["seconds"]
        .as_object()
        .into_iter()
        .flatten()
        .map(|(stage, s)| format!("{stage} {:.1} s", s.as_f64().unwrap_or(0.0)))
        .collect();
    format!(
        "scene          {}\nPSNR, input    {:.2} dB\nfocal length   {:.1} px ({})\n\
         moving pixels  {:.1} %\nGaussians      {} ({:.1} % dynamic)\ncontrol points {}\n\
         time           {}\nmemory         {} at most on the device\n",
        report["output"].as_str().unwrap_or_default(),
        number("psnr_input"),
        report["intrinsics"]["fx"].as_f64().unwrap_or(0.0),
        report["intrinsics"]["source"].as_str().unwrap_or_default(),
        100.0 * number("dynamic_share"),
        thousands(number("gaussians") as usize),
        100.0 * number("dynamic_gaussians"),
        report["control_points"],
        seconds.join(", "),
        bytes(number("peak_bytes") as u64),
    )
}
