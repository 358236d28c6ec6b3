//! `splat4d render`.

use std::ffi::OsString;
use std::path::{Path, PathBuf};

use clap::Args;
use clap::builder::{OsStringValueParser, TypedValueParser};
use serde_json::json;
use splat4d::data::transforms::{self, TimedCamera};
use splat4d::data::{exr, write_png};
use splat4d::gpu::Device;
use splat4d::renderer::{RenderScale, Rendered, Renderer};
use splat4d::scene::{Opened, Scene};
use splat4d::types::{Intrinsics, Tuning};
use splat4d::{Error, Result, io::check_memory};

use super::common::{Answer, Common, foresee, most_pairs, path_text, say, thousands};
use super::encode;
use super::meter::Meter;
use super::outputs::{Inputs, Outputs};
use super::path::{self, Orbit};
use super::values::{self, MOST_PICTURES, Times};
use super::{interrupt, tuning};

/// Host memory of a picture and all that is made of it, a pixel.
const BYTES_A_PIXEL: u64 = 64;
/// Length of an orbit.
const ORBIT_FRAMES: usize = 60;

const AFTER_HELP: &str = "\
Paths:
  input            the cameras of the input, at their times (the default where there are any)
  orbit            views that the input did not have: a gentle ellipse around the input's camera,
                   or once around a scene without cameras; time runs from 0 to 1
  transforms.json  any nerfstudio file with camera sizes (w, h); its `time` per frame is honoured

--times replaces the path's times: as many as the path has cameras go to one camera each; a path
of one camera stands still while time runs; else the whole path is rendered at each time in turn.

DIR/0000.png … hold 8-bit RGB over the background. --exr adds 0000.exr …: RGBA, 32-bit float,
linear as blended, colour premultiplied, no background. --depth adds 0000_depth.exr …: the mean
depth along z as channel Z, 0 where nothing is.

Examples:
  splat4d render scene.safetensors -o views --path orbit
  splat4d render scene.safetensors -o orbit.mp4 --path orbit --frames 120
  splat4d render scene.safetensors -o views --path cameras.json --times 0.5 --exr

JSON: frames, width, height (of the first frame), gaussians, dropped, device, predicted_bytes (of
device memory, before it began), peak_bytes, milliseconds_per_frame, output";

/// Render a scene's file or a 3DGS PLY to pictures
#[derive(Args)]
#[command(after_help = AFTER_HELP)]
pub struct RenderArgs {
    /// A scene's file or a 3DGS PLY
    #[arg(value_name = "SCENE|PLY")]
    scene: PathBuf,
    /// The folder for the pictures, or a video to write through ffmpeg
    #[arg(short, long, value_name = "DIR|FILE.mp4")]
    output: PathBuf,
    /// Pictures a second of a video
    #[arg(long, value_name = "RATE", default_value_t = 24.0,
          value_parser = values::number(0.01..=1000.0))]
    rate: f64,
    /// The cameras
    #[arg(long, value_name = "input|orbit|FILE", value_parser = OsStringValueParser::new().map(ViewPath::from))]
    path: Option<ViewPath>,
    /// Times in [0, 1], as 0,0.5,1; or a whole number above 1 for so many, spread evenly
    #[arg(long, value_name = "TIMES", value_parser = values::times)]
    times: Option<Times>,
    /// Length of an orbit [default: 60, or the number of times]
    #[arg(long, value_name = "N", value_parser = values::whole::<usize>(1..=values::MOST_PICTURES))]
    frames: Option<usize>,
    /// Size of the pictures; all that the camera shows stays in them
    #[arg(long, value_name = "WxH", value_parser = values::size)]
    size: Option<(u32, u32)>,
    /// Focal length in pixels of the rendered size, instead of the camera's
    #[arg(long, value_name = "PIXELS",
          value_parser = values::number(1.0..=values::MOST_FOCAL))]
    focal: Option<f64>,
    /// What lies behind everything, instead of the scene's own: R,G,B in [0, 1], black or white
    #[arg(long, value_name = "R,G,B", value_parser = values::colour)]
    background: Option<[f32; 3]>,
    /// Write float images too
    #[arg(long)]
    exr: bool,
    /// Write depth maps too
    #[arg(long)]
    depth: bool,
    /// Leave out Gaussians that hold NaN, infinite or out-of-range values
    #[arg(long)]
    drop_bad: bool,
    /// Settings that trade accuracy for speed, as `bench --error-budget` writes them
    #[arg(long, value_name = "FILE")]
    settings: Option<PathBuf>,
}

#[derive(Clone, Debug, PartialEq)]
enum ViewPath {
    Input,
    Orbit,
    File(PathBuf),
}

impl From<OsString> for ViewPath {
    fn from(text: OsString) -> ViewPath {
        match text.to_str() {
            Some("input") => ViewPath::Input,
            Some("orbit") => ViewPath::Orbit,
            _ => ViewPath::File(text.into()),
        }
    }
}

/// Runs the command.
pub fn run(args: &RenderArgs, common: &Common) -> Result<Answer> {
    let video = encode::is_video(&args.output);
    if video {
        Outputs::default().file(&args.output)?;
        encode::check(&args.output)?;
        if args.exr || args.depth {
            let what = "--exr and --depth need a folder to write into, not a video";
            return Err(Error::Input(what.into()));
        }
    } else {
        Outputs::default().folder(&args.output, &[&file_name(0, ".png")])?;
    }
    let tuning = tuning::read(args.settings.as_deref())?;
    let Opened { scene, dropped } = Scene::open(&args.scene, args.drop_bad)?;
    if dropped > 0 {
        say(&format!(
            "note: left out {} Gaussians that are not finite or out of range",
            thousands(dropped)
        ));
    }
    let shots = Shots::of(args, &scene)?;
    spare_inputs(args, if video { 0 } else { shots.len() })?;
    let device = common.open_device()?;
    let (predicted_bytes, mut renderer) = foreseen(&device, &scene, &shots, &tuning)?;
    let background = args.background.unwrap_or(scene.background);
    // A video's pictures lie beside it until it is whole, so that it can be renamed into place.
    let pictures = if video { Some(beside(&args.output)?) } else { None };
    let folder = pictures.as_ref().map_or(args.output.as_path(), |pictures| pictures.path());
    let mut meter = Meter::new("rendering", "pictures", shots.len() as u64, 0);
    let mut seconds = 0.0;
    for i in 0..shots.len() {
        interrupt::check()?;
        let shot = shots.at(i);
        let begun = std::time::Instant::now();
        let rendered = renderer.render(&shot.camera, shot.time)?;
        seconds += begun.elapsed().as_secs_f64();
        write(args, folder, i, &rendered, background).map_err(|error| match error {
            // The pictures of a video are nothing that the user has named.
            Error::Io { source, .. } if video => Error::io(&args.output)(source),
            other => other,
        })?;
        meter.advance();
    }
    drop(meter);
    if video {
        encode::encode(folder, args.rate, &args.output)?;
    }
    let size = (shots.len() > 0).then(|| shots.at(0).camera.intrinsics);
    let json = json!({
        "frames": shots.len(),
        "width": size.map(|k| k.width),
        "height": size.map(|k| k.height),
        "gaussians": scene.gaussians.len(),
        "dropped": dropped,
        "device": device.info().name,
        "predicted_bytes": predicted_bytes,
        "peak_bytes": device.memory().1,
        "milliseconds_per_frame": 1e3 * seconds / shots.len().max(1) as f64,
        "output": path_text(&args.output),
    });
    let text = format!("{} pictures in {}\n", shots.len(), args.output.display());
    Ok(Answer { json, text })
}

/// What rendering takes of device memory at most, and a renderer with room for all of it; an error where
/// it does not fit.
fn foreseen(
    device: &Device,
    scene: &Scene,
    shots: &Shots,
    tuning: &Tuning,
) -> Result<(u64, Renderer)> {
    let k = shots.largest();
    let (width, height) = k.map_or((1, 1), |k| (k.width, k.height));
    check_memory(
        u64::from(width) * u64::from(height) * BYTES_A_PIXEL,
        &format!("a picture of {width}×{height}"),
    )?;
    let mut scale = RenderScale::new(scene, (width, height), tuning);
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
    // What it holds must not count as taken.
    drop(renderer);
    let predicted = foresee(&scale)?;
    let mut renderer = Renderer::tuned(device, scene, tuning)?;
    renderer.reserve(scale.intersections);
    Ok((predicted, renderer))
}

/// A temporary folder next to a file; the file's folder is made where it is missing.
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

/// That the video, or so many pictures, can be written without losing what is read.
fn spare_inputs(args: &RenderArgs, pictures: usize) -> Result<()> {
    let path = match &args.path {
        Some(ViewPath::File(file)) => Some(file),
        _ => None,
    };
    let read = [Some(&args.scene), path, args.settings.as_ref()];
    let inputs = Inputs::new(read.into_iter().flatten().cloned(), []);
    inputs.spared_by(&args.output)?;
    let mut endings = vec![".png"];
    endings.extend(args.exr.then_some(".exr"));
    endings.extend(args.depth.then_some("_depth.exr"));
    let is_written = |name: &str| {
        let index = |ending: &str| name.strip_suffix(ending)?.parse::<usize>().ok();
        endings.iter().any(|ending| {
            index(ending).is_some_and(|i| i < pictures && file_name(i, ending) == name)
        })
    };
    // What is there are few, where pictures may be many; a folder that is not there holds none.
    for entry in std::fs::read_dir(&args.output).into_iter().flatten().flatten() {
        if !entry.file_name().to_str().is_some_and(is_written) {
            continue;
        }
        let picture = entry.path();
        if picture.is_dir() {
            return Err(Error::format(picture, "is a folder, where a picture is to be written"));
        }
        inputs.spared_by(&picture)?;
    }
    Ok(())
}

fn write(
    args: &RenderArgs,
    folder: &Path,
    index: usize,
    rendered: &Rendered,
    background: [f32; 3],
) -> Result<()> {
    let file = |ending: &str| folder.join(file_name(index, ending));
    write_png(file(".png"), &rendered.over(background))?;
    if args.exr {
        exr::write_rgba(file(".exr"), &rendered.rgba)?;
    }
    if args.depth {
        exr::write_depth(file("_depth.exr"), &rendered.mean_depth())?;
    }
    Ok(())
}

/// What to render, in order. Only the cameras of a file are kept: there may be many shots.
struct Shots<'a> {
    cameras: Cameras<'a>,
    times: Option<Times>,
    size: Option<(u32, u32)>,
    focal: Option<f64>,
}

enum Cameras<'a> {
    Listed(Vec<TimedCamera>),
    Orbit(Orbit<'a>),
}

impl Cameras<'_> {
    fn len(&self) -> usize {
        match self {
            Cameras::Listed(cameras) => cameras.len(),
            Cameras::Orbit(orbit) => orbit.len(),
        }
    }
}

impl<'a> Shots<'a> {
    fn of(args: &RenderArgs, scene: &'a Scene) -> Result<Shots<'a>> {
        let orbit_frames = match (args.frames, &args.times) {
            (Some(frames), _) => frames,
            (None, Some(times)) if times.len() > 1 => times.len(),
            _ => ORBIT_FRAMES,
        };
        let default = if scene.cameras.is_empty() { ViewPath::Orbit } else { ViewPath::Input };
        let cameras = match args.path.as_ref().unwrap_or(&default) {
            ViewPath::Input => Cameras::Listed(path::input(scene)?),
            ViewPath::Orbit => Cameras::Orbit(Orbit::new(scene, orbit_frames)),
            ViewPath::File(file) => Cameras::Listed(transforms::read_cameras(file)?),
        };
        let shots =
            Shots { cameras, times: args.times.clone(), size: args.size, focal: args.focal };
        for i in 0..shots.cameras.len() {
            shots.at(i).camera.check().map_err(|what| {
                Error::Input(format!("camera {i} of the path cannot be rendered from: {what}"))
            })?;
        }
        match shots.len() as u64 {
            0..=MOST_PICTURES => Ok(shots),
            count => Err(Error::Input(format!(
                "{} cameras, each at {} times, are {} pictures; at most {} are rendered at once: \
                 give fewer --times or --frames",
                thousands(shots.cameras.len()),
                thousands(shots.times.as_ref().map_or(1, Times::len)),
                thousands(count as usize),
                thousands(MOST_PICTURES as usize)
            ))),
        }
    }

    fn len(&self) -> usize {
        let cameras = self.cameras.len();
        match self.times.as_ref().map(Times::len) {
            // As many times as cameras: one of each.
            Some(times) if times != cameras => cameras.saturating_mul(times),
            _ => cameras,
        }
    }

    /// One of them; see the command's help.
    fn at(&self, index: usize) -> TimedCamera {
        let camera = index % self.cameras.len();
        let mut shot = match &self.cameras {
            Cameras::Listed(cameras) => cameras[camera],
            Cameras::Orbit(orbit) => orbit.at(camera),
        };
        if let Some(times) = &self.times {
            let one_each = times.len() == self.cameras.len();
            shot.time = times.at(if one_each { index } else { index / self.cameras.len() });
        }
        let k = &mut shot.camera.intrinsics;
        if let Some((width, height)) = self.size {
            *k = path::resized(k, width, height);
        }
        if let Some(focal) = self.focal {
            (k.fx, k.fy) = (focal, focal);
        }
        shot
    }

    /// The intrinsics of the largest picture.
    fn largest(&self) -> Option<Intrinsics> {
        let sizes = (0..self.cameras.len()).map(|i| self.at(i).camera.intrinsics);
        sizes.max_by_key(|k| u64::from(k.width) * u64::from(k.height))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::types::Pose;

    #[test]
    fn times_replace_those_of_the_path() {
        let camera = |i: u32| TimedCamera {
            time: 0.9,
            camera: splat4d::types::Camera {
                intrinsics: Intrinsics::centred(10.0 + f64::from(i), 8, 8),
                view_from_world: Pose::IDENTITY,
            },
        };
        let path = [camera(0), camera(1)];
        let found = |times: &[f64], path: &[TimedCamera]| -> Vec<(u32, f64)> {
            let shots = Shots {
                cameras: Cameras::Listed(path.to_vec()),
                times: Some(Times::List(times.to_vec())),
                size: None,
                focal: None,
            };
            let shots = (0..shots.len()).map(|i| shots.at(i));
            shots.map(|s| (s.camera.intrinsics.fx as u32 - 10, s.time)).collect()
        };
        assert_eq!(found(&[0.0, 1.0], &path), [(0, 0.0), (1, 1.0)]);
        assert_eq!(found(&[0.5], &path), [(0, 0.5), (1, 0.5)]);
        assert_eq!(found(&[0.0, 0.5, 1.0], &path[1..]), [(1, 0.0), (1, 0.5), (1, 1.0)]);
        let each = [(0, 0.0), (1, 0.0), (0, 0.5), (1, 0.5), (0, 1.0), (1, 1.0)];
        assert_eq!(found(&[0.0, 0.5, 1.0], &path), each);
        assert_eq!(found(&[0.5], &[]), []);
    }
}
