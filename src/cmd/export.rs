//! `splat4d export`: writes a scene in other formats.

use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};

use clap::Args;
use serde_json::{Value, json};
use splat4d::camera_path::initial_view;
use splat4d::io::{write_atomically, write_folder};
use splat4d::renderer::Renderer;
use splat4d::scene::html::Opening;
use splat4d::scene::splatv::{self, Fit};
use splat4d::scene::{Format, Opened, Scene, spz};
use splat4d::types::Gaussians;
use splat4d::{Error, Result};

use super::common::{Answer, Common, bytes, notes, path_text, say, thousands};
use super::compact::Paths;
use super::export_target::{Droppable, Member, SpzVersion, Target, is_zip, left_out, target};
use super::interrupt;
use super::meter::Meter;
use super::outputs::{Inputs, Outputs};
use super::values::{self, MOST_PICTURES};

const AFTER_HELP: &str = "\
Formats, by the name of FILE:
  .ply             3DGS PLY
  .compressed.ply  16 bytes a Gaussian, and one for each further coefficient; SuperSplat's
  .splat           32 bytes a Gaussian, one colour each (antimatter15)
  .spz             about a tenth of a PLY; version 4 holds the motion in an extension that other
                   readers skip: they see the moment --time
  .glb             glTF with KHR_gaussian_splatting; with --spz its Gaussians are an SPZ of version 2,
                   in the extension KHR_gaussian_splatting_compression_spz_2, which is a draft
  .splatv          what splaTV's players show: motion as a cubic of time for each Gaussian, one
                   colour each; how well the cubics fit is said
  .html            one page that plays the scene in a browser, with nothing from elsewhere: the compact
                   scene, and the player; the same is said of it as of --compact. For programs, the
                   page has `splat4d.shot(camera, time, width, height)`; see its source
  .safetensors     the scene's own; with --compact in few bits, as a rule a fifth of it or less, and the
                   PSNR against the scene as it was is said, over the scene's cameras

What a format cannot hold is an error that says so. --time asks for one moment, so that motion is
left out; --drop names what else may be left out: `motion`, `bands` (the harmonics above the
constant, which make colours change with the direction).

--sequence writes one file for each time: frame0000.ply … in a new folder FILE, or in FILE.zip.
SuperSplat plays such a folder, brush such a zip. --as names the format of the files.

Examples:
  splat4d export scene.safetensors -o moment.ply --time 0.5
  splat4d export scene.safetensors -o scene.spz
  splat4d export scene.safetensors -o moment.glb --time 0.5 --spz
  splat4d export scene.safetensors -o scene.html
  splat4d export scene.safetensors -o small.safetensors --compact
  splat4d export scene.safetensors -o frames --sequence --frames 60 --as compressed.ply
  splat4d export scene.safetensors -o moment.splat --time 0 --drop bands

JSON: format, gaussians (written, of the last file), dropped (not finite or out of range), far (out
of the format's reach), sh_degree, frames, times ([first, last]), left_out (of motion, bands), bytes
(of the scene's file), written_bytes, seconds, output; fit (of .splatv: moving, position_rmse,
position_worst, position_spread, rotation_mean in degrees; else null); compact (of --compact
and .html: plain_bytes, scene_bytes (of the compact scene), share (of plain_bytes), baked (whether paths
took the network's place), psnr (against the scene, mean over views, null without cameras), psnr_worst,
psnr_lost (of the report's psnr_input, by that; else null), views; else null)";

/// Write a scene in a format that other programs read
#[derive(Args)]
#[command(after_help = AFTER_HELP)]
pub struct ExportArgs {
    /// A scene file, or Gaussians as PLY, SPZ, SOG or .splat
    #[arg(value_name = "SCENE|PLY")]
    pub scene: PathBuf,
    /// The output file; its extension selects the format. With --sequence, a folder or FILE.zip
    #[arg(short, long, value_name = "FILE")]
    pub output: PathBuf,
    /// The time of a single moment to write, in [0, 1]
    #[arg(long, value_name = "TIME", value_parser = values::number(0.0..=1.0),
          conflicts_with = "sequence")]
    pub time: Option<f64>,
    /// Write a file per time
    #[arg(long)]
    pub sequence: bool,
    /// Number of files of a sequence, evenly spaced in time [default: the times of the input]
    #[arg(long, value_name = "N", requires = "sequence",
          value_parser = values::whole::<usize>(1..=values::MOST_PICTURES))]
    pub frames: Option<usize>,
    /// Format of a sequence's files
    #[arg(long = "as", value_name = "FORMAT", requires = "sequence", default_value = "ply")]
    pub format: Member,
    /// Features to omit if the format does not support them
    #[arg(long, value_name = "WHAT", value_delimiter = ',')]
    pub drop: Vec<Droppable>,
    /// Version of SPZ
    #[arg(long, value_name = "VERSION", default_value = "4")]
    pub spz_version: SpzVersion,
    /// Compress the Gaussians of a .glb by SPZ
    #[arg(long, conflicts_with = "sequence")]
    pub spz: bool,
    /// Use the compact form of the scene format, with reduced precision
    #[arg(long, conflicts_with = "sequence")]
    pub compact: bool,
    /// Skip Gaussians with NaN, infinite or out-of-range values
    #[arg(long)]
    pub drop_bad: bool,
}

/// Result of writing.
#[derive(Default)]
struct Written {
    gaussians: usize,
    far: usize,
    bytes: u64,
    fit: Option<Fit>,
    compact: Option<Value>,
}

/// Runs the command.
pub fn run(args: &ExportArgs, common: &Common) -> Result<Answer> {
    let begun = std::time::Instant::now();
    let target = target(args)?;
    if args.sequence && !is_zip(&args.output) {
        Outputs::default().folder(&args.output, &["frame0000.ply"])?;
        splat4d::io::check_new_folder(&args.output)?;
    } else {
        Outputs::default().file(&args.output)?;
    }
    Inputs::new([args.scene.clone()], []).spared_by(&args.output)?;
    let Opened { mut scene, dropped } = Scene::open(&args.scene, args.drop_bad)?;
    if dropped > 0 {
        let count = thousands(dropped);
        say(&format!("note: left out {count} Gaussians that are not finite or out of range"));
    }
    let left_out = left_out(args, target, &scene)?;
    let of = |what: &Droppable| format!("{} left out: {}", what.name(), what.why(target));
    notes(&left_out.iter().map(of).collect::<Vec<String>>());
    scene.gaussians = std::mem::take(&mut scene.gaussians).at_degree(target.most_sh_degree());
    let times = times(args, target, &scene)?;
    let mut poser = Poser::new(common, &scene)?;
    if left_out.contains(&Droppable::Motion) {
        // From here on, the scene is static.
        scene.gaussians = poser.at(times[0])?;
        scene = Scene { control_points: Default::default(), network: None, ..scene };
        poser = Poser::new(common, &scene)?;
    }
    let written = write(args, common, target, &scene, &times, &mut poser)?;
    if written.far > 0 {
        let far = thousands(written.far);
        say(&format!("note: left out {far} Gaussians, too far out for {}", target.extension()));
    }
    let read = size(&args.scene)?;
    let json = json!({
        "format": target.extension().trim_start_matches('.'),
        "gaussians": written.gaussians,
        "dropped": dropped,
        "far": written.far,
        "sh_degree": scene.gaussians.sh_degree,
        "frames": times.len(),
        "times": [times[0], times[times.len() - 1]],
        "left_out": left_out.iter().map(|what| what.name()).collect::<Vec<_>>(),
        "bytes": read,
        "written_bytes": written.bytes,
        "seconds": begun.elapsed().as_secs_f64(),
        "output": path_text(&args.output),
        "fit": written.fit.map(|fit| json!({
            "moving": fit.moving,
            "position_rmse": fit.position_rmse,
            "position_worst": fit.position_worst,
            "position_spread": fit.position_spread,
            "rotation_mean": fit.rotation_mean,
        })),
        "compact": written.compact,
    });
    let mut text = format!(
        "{} Gaussians in {}, {} ({} read)\n",
        thousands(written.gaussians),
        args.output.display(),
        bytes(written.bytes),
        bytes(read),
    );
    if let Some(fit) = written.fit.filter(|fit| fit.moving > 0) {
        text += &format!(
            "cubics of {} that move: off by {:.2e} in the mean square, by {:.2e} at worst, where they \
             move by {:.2e}; rotations by {:.1}°\n",
            thousands(fit.moving),
            fit.position_rmse,
            fit.position_worst,
            fit.position_spread,
            fit.rotation_mean,
        );
    }
    if let Some(compact) = &written.compact {
        text += &super::compact::told(compact);
    }
    Ok(Answer { json, text })
}

/// The scene's Gaussians at a time; a device is used only for a dynamic scene.
enum Poser {
    Still(Gaussians),
    Moving(Box<Renderer>),
}

impl Poser {
    fn new(common: &Common, scene: &Scene) -> Result<Poser> {
        if scene.moves() {
            return Ok(Poser::Moving(Renderer::new(&common.open_device()?, scene)?.into()));
        }
        Ok(Poser::Still(Gaussians { motion_logits: Vec::new(), ..scene.gaussians.clone() }))
    }

    fn at(&mut self, time: f64) -> Result<Gaussians> {
        match self {
            Poser::Still(gaussians) => Ok(gaussians.clone()),
            Poser::Moving(renderer) => renderer.posed(time),
        }
    }
}

fn write(
    args: &ExportArgs,
    common: &Common,
    target: Target,
    scene: &Scene,
    times: &[f64],
    poser: &mut Poser,
) -> Result<Written> {
    let output = &args.output;
    let whole = |gaussians: usize| -> Result<Written> {
        Ok(Written { gaussians, bytes: size(output)?, ..Written::default() })
    };
    match target {
        Target::Still(format) if args.sequence => sequence(args, format, times, poser),
        Target::Still(_) if target.holds_motion() && scene.moves() => {
            let baked = super::compact::baked(scene, common, Paths::WhereSmaller)?;
            let moving = baked.as_ref().unwrap_or(scene);
            whole(spz::write_moving(output, moving, &poser.at(times[0])?)?)
        }
        Target::Still(format) => {
            let gaussians = poser.at(times[0])?;
            let count = format.write(output, &gaussians)?;
            Ok(Written { far: gaussians.len() - count, ..whole(count)? })
        }
        Target::SplatV => {
            let fit = splatv::write(output, scene, times, |time| {
                interrupt::check()?;
                poser.at(time)
            })?;
            Ok(Written { fit: Some(fit), ..whole(scene.gaussians.len())? })
        }
        Target::Page => {
            let compact = super::compact::write_page(output, scene, common, &opening(args, scene))?;
            Ok(Written { compact: Some(compact), ..whole(scene.gaussians.len())? })
        }
        Target::Scene if args.compact => {
            let compact = super::compact::write(output, scene, common)?;
            Ok(Written { compact: Some(compact), ..whole(scene.gaussians.len())? })
        }
        Target::Scene => {
            scene.save(output)?;
            whole(scene.gaussians.len())
        }
    }
}

/// Initial view of a page: the input's first camera, at its time.
fn opening(args: &ExportArgs, scene: &Scene) -> Opening {
    let (start, distance) = initial_view(scene);
    let title = args.scene.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let time = scene.cameras.first().map_or(0.0, |camera| camera.time);
    Opening { title, start, distance, time }
}

fn size(path: &Path) -> Result<u64> {
    Ok(fs::metadata(path).map_err(Error::io(path))?.len())
}

/// Number of times at which motion is fitted.
const FITTED: usize = 48;

/// The times to write, or to fit motion at.
fn times(args: &ExportArgs, target: Target, scene: &Scene) -> Result<Vec<f64>> {
    let evenly = |count: usize| -> Vec<f64> {
        (0..count).map(|i| i as f64 / (count - 1).max(1) as f64).collect()
    };
    if let Some(time) = args.time {
        return Ok(vec![time]);
    }
    if !args.sequence {
        let fitted = target == Target::SplatV && !args.drop.contains(&Droppable::Motion);
        return Ok(if fitted { evenly(FITTED) } else { vec![0.0] });
    }
    if let Some(frames) = args.frames {
        return Ok(evenly(frames));
    }
    let mut times: Vec<f64> = scene.cameras.iter().map(|camera| camera.time).collect();
    times.sort_by(f64::total_cmp);
    times.dedup();
    match times.len() as u64 {
        0 => Err(Error::Input("the scene knows no times of its input: give --frames".into())),
        1..=MOST_PICTURES => Ok(times),
        count => Err(Error::Input(format!("{count} times are too many: give --frames"))),
    }
}

/// Writes a file for each time to a folder or an archive.
fn sequence(
    args: &ExportArgs,
    format: Format,
    times: &[f64],
    poser: &mut Poser,
) -> Result<Written> {
    let mut meter = Meter::new("exporting", "files", times.len() as u64, 0);
    let digits = (times.len() - 1).to_string().len().max(4);
    let names: Vec<String> =
        (0..times.len()).map(|i| format!("frame{i:0digits$}{}", format.extension())).collect();
    let mut written = Written::default();
    let mut next = |time: f64| -> Result<Vec<u8>> {
        interrupt::check()?;
        let gaussians = poser.at(time)?;
        let (bytes, count) = format.encode(&gaussians)?;
        written.gaussians = count;
        written.far = written.far.max(gaussians.len() - count);
        written.bytes += bytes.len() as u64;
        meter.advance();
        Ok(bytes)
    };
    if is_zip(&args.output) {
        let mut failed = None;
        let done = write_atomically(&args.output, |sink| {
            let mut archive = splat4d::io::Archive::new(sink);
            for (name, time) in names.iter().zip(times) {
                match next(*time) {
                    Ok(bytes) => archive.file(name, &bytes)?,
                    Err(error) => {
                        failed = Some(error);
                        return Err(std::io::Error::other("a frame failed"));
                    }
                }
            }
            archive.finish()
        });
        match failed {
            Some(error) => return Err(error),
            None => done?,
        }
        written.bytes = size(&args.output)?;
    } else {
        let list: Vec<&str> = names.iter().map(String::as_str).collect();
        write_folder(&args.output, &list, |folder| {
            for (name, time) in names.iter().zip(times) {
                let bytes = next(*time)?;
                write_atomically(folder.join(name), |sink| sink.write_all(&bytes))?;
            }
            Ok(())
        })?;
    }
    Ok(written)
}
