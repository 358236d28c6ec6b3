//! `splat4d render`: renders a scene to images or a video.

use std::path::{Path, PathBuf};

use clap::Args;
use serde_json::json;
use splat4d::gpu::Device;
use splat4d::renderer::{RenderScale, Renderer};
use splat4d::scene::{Opened, Scene};
use splat4d::types::Tuning;
use splat4d::{Error, Result, io::check_memory};

use super::common::{Answer, Common, foresee, most_pairs, path_text, say, thousands};
use super::layers::{self, Layer, Picture, Writer};
use super::meter::Meter;
use super::outputs::{Inputs, Outputs};
use super::shots::{ShotArgs, Shots};
use super::{encode, interrupt, render_bench, tuning, values};

/// Host memory per pixel of an image and its intermediate data, bytes: the blended image as downloaded, and
/// one layer at a time as floats, colours and bytes.
const BYTES_A_PIXEL: u64 = 96;

const AFTER_HELP: &str = "\
Paths:
  input            the cameras of the input, at their times (the default where there are any)
  orbit            views that the input did not have: a gentle ellipse around the input's camera,
                   or once around a scene without cameras; time runs from 0 to 1
  spiral           twice around, each turn wider, while the camera nears and draws back
  dolly            ahead, along the line of sight
  bullet           time stands, at --times or in the middle, and the camera goes round as in an orbit
  transforms.json  any nerfstudio file with camera sizes (w, h); its `time` per frame is honoured

--times replaces the path's times: as many as the path has cameras go to one camera each; a path
of one camera stands still while time runs; else, and always of bullet, the whole path is rendered at
each time in turn.

--what chooses what DIR/0000.png …, 8-bit RGB, show; several, separated by commas:
  colour   over the background                                       0000.png
  depth    near is bright, far is dark, nothing is black             0000_depth.png
  alpha    how opaque a pixel is                                     0000_alpha.png
  motion   how much of a pixel comes from what moves                 0000_motion.png
  flow     where each pixel goes until the next image of the path, as
           hue and saturation, grey where nothing is; none of the last  0000_flow.png
  normal   Gaussians' shortest axes, toward the camera, as colours   0000_normal.png
The first image decides how depth and flow are shaded in all. A video shows one of them.

--exr adds 32-bit floats: 0000.exr, RGBA, linear as blended, colour premultiplied, no background;
0000_depth.exr, the mean depth along z as channel Z, 0 where nothing is; 0000_alpha.exr and
0000_motion.exr as channel Y; 0000_normal.exr, x right, y down, z ahead as RGB, 0 where nothing is;
and 0000_flow.flo, pixels, 1e10 where nothing is. Flow takes what a pixel shows to lie at its mean
depth and to move as the Gaussians that it shows do in the mean.

--bench writes nothing: it measures frames a second on three views of the path, in turns with the most
accurate settings, and the error against what the oracle renders in f64.

Examples:
  splat4d render scene.safetensors -o views --path orbit
  splat4d render scene.safetensors -o orbit.mp4 --path orbit --frames 120
  splat4d render scene.safetensors -o frozen.mp4 --path bullet --times 0.3
  splat4d render scene.safetensors -o views --path cameras.json --times 0.5 --what colour,depth --exr
  splat4d render scene.safetensors --bench --settings fast.json --size 1280x720

JSON: frames, width, height (of the first frame), gaussians, dropped, device, predicted_bytes (of device
memory, before it began), peak_bytes, milliseconds_per_frame, output. With --bench: frames_per_second {median,
quartiles}, milliseconds {median, quartiles} (of a frame), ratio {median, quartiles} (to the time of the most
accurate settings), clock (Device or Host), error {max, rmse, psnr}, settings, views, rounds, software
(whether the device is), and width, height, gaussians, dropped, device, predicted_bytes, peak_bytes";

/// Render a scene file or a 3DGS PLY to images
#[derive(Args)]
#[command(after_help = AFTER_HELP)]
pub struct RenderArgs {
    /// A scene file or a 3DGS PLY
    #[arg(value_name = "SCENE|PLY")]
    scene: PathBuf,
    /// The output folder for images, or a video file to encode with ffmpeg
    #[arg(short, long, value_name = "DIR|FILE.mp4", required_unless_present = "bench")]
    output: Option<PathBuf>,
    /// Frame rate of a video, frames per second
    #[arg(long, value_name = "RATE", default_value_t = 24.0,
          value_parser = values::number(0.01..=1000.0))]
    rate: f64,
    #[command(flatten)]
    shots: ShotArgs,
    /// Background colour instead of the scene's own: R,G,B in [0, 1], black or white
    #[arg(long, value_name = "R,G,B", value_parser = values::colour)]
    background: Option<[f32; 3]>,
    /// Layers to write of each image
    #[arg(long, value_name = "LAYERS", value_delimiter = ',', default_value = "colour")]
    what: Vec<Layer>,
    /// Also write float images
    #[arg(long)]
    exr: bool,
    /// Measure frames per second and the error, instead of writing images
    #[arg(long, conflicts_with_all = ["output", "rate", "what", "exr", "background"])]
    bench: bool,
    /// Skip Gaussians with NaN, infinite or out-of-range values
    #[arg(long)]
    drop_bad: bool,
    /// Settings that trade accuracy for speed, as `bench --error-budget` writes them
    #[arg(long, value_name = "FILE")]
    settings: Option<PathBuf>,
}

/// Runs the command.
pub fn run(args: &RenderArgs, common: &Common) -> Result<Answer> {
    if let Some(output) = &args.output {
        try_output(args, output)?;
    }
    let tuning = tuning::read(args.settings.as_deref())?;
    let Opened { scene, dropped } = Scene::open(&args.scene, args.drop_bad)?;
    if dropped > 0 {
        say(&format!(
            "note: left out {} Gaussians that are not finite or out of range",
            thousands(dropped)
        ));
    }
    let shots = Shots::of(&args.shots, &scene)?;
    let mut json = match &args.output {
        Some(output) => pictures(args, common, (&scene, &tuning), &shots, output)?,
        None => {
            let device = common.open_device()?;
            let (predicted, renderer) = foreseen(&device, &scene, &shots, &tuning, false)?;
            drop(renderer);
            let measured = render_bench::measure(&device, &scene, &tuning, &shots)?;
            let mut json = measured.json;
            json["predicted_bytes"] = json!(predicted);
            json["peak_bytes"] = json!(device.memory().1);
            json["dropped"] = json!(dropped);
            return Ok(Answer { json, text: measured.text });
        }
    };
    json["dropped"] = json!(dropped);
    let text =
        format!("{} images in {}\n", shots.len(), json["output"].as_str().unwrap_or_default());
    Ok(Answer { json, text })
}

/// Checks that the images or the video can be written.
fn try_output(args: &RenderArgs, output: &Path) -> Result<()> {
    if !encode::is_video(output) {
        Outputs::default().folder(output, &[&file_name(0, ".png")])?;
        return Ok(());
    }
    Outputs::default().file(output)?;
    encode::check(output)?;
    match (args.exr, args.what.len()) {
        (true, _) => Err(Error::Input("--exr needs a folder to write into, not a video".into())),
        (_, 1) => Ok(()),
        _ => {
            let what = "a video shows one thing; give one for --what, or a folder to write into";
            Err(Error::Input(what.into()))
        }
    }
}

/// Renders and writes all images.
fn pictures(
    args: &RenderArgs,
    common: &Common,
    (scene, tuning): (&Scene, &Tuning),
    shots: &Shots,
    output: &Path,
) -> Result<serde_json::Value> {
    let video = encode::is_video(output);
    layers::check(&args.what, shots.len())?;
    spare_inputs(args, output, if video { 0 } else { shots.len() })?;
    let device = common.open_device()?;
    let repainted = args.what.iter().any(|layer| layer.is_repainted());
    let (predicted_bytes, mut renderer) = foreseen(&device, scene, shots, tuning, repainted)?;
    let background = args.background.unwrap_or(scene.background);
    // The images of a video are written beside it until it is complete, so that it can be renamed into place.
    let pictures = if video { Some(beside(output)?) } else { None };
    let folder = pictures.as_ref().map_or(output, |pictures| pictures.path());
    let mut writer = Writer::new(&args.what, args.exr, video, background);
    let mut meter = Meter::new("rendering", "images", shots.len() as u64, 0);
    let mut seconds = 0.0;
    for index in 0..shots.len() {
        interrupt::check()?;
        let shot = shots.at(index);
        let next = (index + 1 < shots.len()).then(|| shots.at(index + 1));
        let begun = std::time::Instant::now();
        let rendered = renderer.render(&shot.camera, shot.time)?;
        seconds += begun.elapsed().as_secs_f64();
        let picture = Picture { index, shot, next, rendered: &rendered };
        writer.write(folder, &mut renderer, &picture).map_err(|error| match error {
            // The user has not named the images of a video, so the error names the video.
            Error::Io { source, .. } if video => Error::io(output)(source),
            other => other,
        })?;
        meter.advance();
    }
    drop(meter);
    if video {
        encode::encode(folder, args.rate, output)?;
    }
    let size = (shots.len() > 0).then(|| shots.at(0).camera.intrinsics);
    Ok(json!({
        "frames": shots.len(),
        "width": size.map(|k| k.width),
        "height": size.map(|k| k.height),
        "gaussians": scene.gaussians.len(),
        "device": device.info().name,
        "predicted_bytes": predicted_bytes,
        "peak_bytes": device.memory().1,
        "milliseconds_per_frame": 1e3 * seconds / shots.len().max(1) as f64,
        "output": path_text(output),
    }))
}

/// Predicts the peak device memory of rendering, and makes a renderer with sufficient capacity; an error
/// where it does not fit.
fn foreseen(
    device: &Device,
    scene: &Scene,
    shots: &Shots,
    tuning: &Tuning,
    repainted: bool,
) -> Result<(u64, Renderer)> {
    let k = shots.largest();
    let (width, height) = k.map_or((1, 1), |k| (k.width, k.height));
    check_memory(
        u64::from(width) * u64::from(height) * BYTES_A_PIXEL,
        &format!("an image of {width}×{height}"),
    )?;
    let usual = RenderScale::new(scene, (width, height), tuning);
    let mut scale = RenderScale { repainted, ..usual };
    let foresee = |scale: &RenderScale| {
        let mut what = format!("rendering {} Gaussians", thousands(scale.gaussians));
        if scale.is_dense() {
            what += &format!(", up to {} (splat, tile) pairs,", thousands(scale.intersections));
        }
        let most = || scale.most_gaussians(device);
        foresee(
            device,
            &what,
            scale.footprint(device),
            most,
            "lower --size, or leave Gaussians out",
        )
    };
    let predicted = foresee(&scale)?;
    let mut renderer = Renderer::tuned(device, scene, tuning)?;
    scale.intersections = most_pairs(&mut renderer, shots.len(), |i| {
        let shot = shots.at(i);
        (shot.camera, shot.time)
    })?;
    if !scale.is_dense() {
        return Ok((predicted, renderer));
    }
    // Memory that this renderer holds must not count as used.
    drop(renderer);
    let predicted = foresee(&scale)?;
    let mut renderer = Renderer::tuned(device, scene, tuning)?;
    renderer.reserve(scale.intersections);
    Ok((predicted, renderer))
}

/// A temporary folder next to a file; the file's folder is created if it is missing.
fn beside(output: &Path) -> Result<tempfile::TempDir> {
    let parent = match output.parent() {
        Some(parent) if parent != Path::new("") => parent,
        _ => Path::new("."),
    };
    std::fs::create_dir_all(parent).map_err(Error::io(parent))?;
    tempfile::Builder::new().prefix(".splat4d-").tempdir_in(parent).map_err(Error::io(parent))
}

fn file_name(index: usize, ending: &str) -> String {
    format!("{index:04}{ending}")
}

/// Checks that the video, or the number of images, can be written without overwriting inputs.
fn spare_inputs(args: &RenderArgs, output: &Path, pictures: usize) -> Result<()> {
    let read = [Some(&args.scene), args.shots.file(), args.settings.as_ref()];
    let inputs = Inputs::new(read.into_iter().flatten().cloned(), []);
    inputs.spared_by(output)?;
    let endings = Writer::endings(&args.what, args.exr);
    let is_written = |name: &str| {
        let index = |ending: &str| name.strip_suffix(ending)?.parse::<usize>().ok();
        endings.iter().any(|ending| {
            index(ending).is_some_and(|i| i < pictures && file_name(i, ending) == name)
        })
    };
    // Iterates over existing files, which are few, and not over the images, which may be many; a missing
    // folder contains none.
    for entry in std::fs::read_dir(output).into_iter().flatten().flatten() {
        if !entry.file_name().to_str().is_some_and(is_written) {
            continue;
        }
        let picture = entry.path();
        if picture.is_dir() {
            return Err(Error::format(picture, "is a folder, where an image is to be written"));
        }
        inputs.spared_by(&picture)?;
    }
    Ok(())
}
