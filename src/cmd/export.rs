//! `splat4d export`.

use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};
use serde_json::json;
use splat4d::io::{write_atomically, write_folder};
use splat4d::renderer::Renderer;
use splat4d::scene::{Format, Opened, Scene, spz};
use splat4d::types::Gaussians;
use splat4d::{Error, Result};

use super::common::{Answer, Common, bytes, notes, path_text, say, thousands};
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

What a format cannot hold is an error that says so. --time asks for one moment, so that motion is
left out; --drop names what else may be left out: `motion`, `bands` (the harmonics above the
constant, which make colours change with the direction).

--sequence writes one file for each time: frame0000.ply … in a new folder FILE, or in FILE.zip.
SuperSplat plays such a folder, brush such a zip. --as names the format of the files.

Examples:
  splat4d export scene.safetensors -o moment.ply --time 0.5
  splat4d export scene.safetensors -o scene.spz
  splat4d export scene.safetensors -o frames --sequence --frames 60 --as compressed.ply
  splat4d export scene.safetensors -o moment.splat --time 0 --drop bands

JSON: format, gaussians (written, of the last file), dropped (not finite or out of range), far (out
of the format's reach), sh_degree, frames, times ([first, last]), left_out (of motion, bands), bytes
(of the scene's file), written_bytes, seconds, output";

/// Write a scene in a format that other programs open
#[derive(Args)]
#[command(after_help = AFTER_HELP)]
pub struct ExportArgs {
    /// A scene's file, or Gaussians as PLY, SPZ or .splat
    #[arg(value_name = "SCENE|PLY")]
    scene: PathBuf,
    /// The file to write; its name tells the format. With --sequence, a folder or FILE.zip
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// The moment, in [0, 1], where one is to be written
    #[arg(long, value_name = "TIME", value_parser = values::number(0.0..=1.0),
          conflicts_with = "sequence")]
    time: Option<f64>,
    /// Write a file for each time
    #[arg(long)]
    sequence: bool,
    /// Number of files of a sequence, spread evenly over time [default: the times of the input]
    #[arg(long, value_name = "N", requires = "sequence",
          value_parser = values::whole::<usize>(1..=values::MOST_PICTURES))]
    frames: Option<usize>,
    /// Format of the files of a sequence
    #[arg(long = "as", value_name = "FORMAT", requires = "sequence", default_value = "ply")]
    format: Member,
    /// What may be left out where the format does not hold it
    #[arg(long, value_name = "WHAT", value_delimiter = ',')]
    drop: Vec<Droppable>,
    /// Version of SPZ
    #[arg(long, value_name = "VERSION", default_value = "4")]
    spz_version: SpzVersion,
    /// Leave out Gaussians that hold NaN, infinite or out-of-range values
    #[arg(long)]
    drop_bad: bool,
}

/// Formats of a sequence's files.
#[derive(Clone, Copy, Debug, ValueEnum)]
enum Member {
    #[value(name = "ply")]
    Ply,
    #[value(name = "compressed.ply")]
    CompressedPly,
    #[value(name = "splat")]
    Splat,
    #[value(name = "spz")]
    Spz,
}

#[derive(Clone, Copy, Debug, PartialEq, ValueEnum)]
enum Droppable {
    Motion,
    Bands,
}

impl Droppable {
    fn name(self) -> &'static str {
        match self {
            Droppable::Motion => "motion",
            Droppable::Bands => "bands",
        }
    }
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum SpzVersion {
    #[value(name = "3")]
    V3,
    #[value(name = "4")]
    V4,
}

/// What was written.
struct Written {
    gaussians: usize,
    far: usize,
    bytes: u64,
}

/// Runs the command.
pub fn run(args: &ExportArgs, common: &Common) -> Result<Answer> {
    let begun = std::time::Instant::now();
    let format = format(args)?;
    let zip = is_zip(&args.output);
    if args.sequence && !zip {
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
    let left_out = left_out(args, format, &scene)?;
    notes(
        &left_out
            .iter()
            .map(|what| format!("{} left out: {} holds none", what.name(), format.extension()))
            .collect::<Vec<_>>(),
    );
    scene.gaussians = std::mem::take(&mut scene.gaussians).at_degree(format.most_sh_degree());
    let times = times(args, &scene)?;
    let moves = scene.moves();
    let mut renderer = match moves {
        true => Some(Renderer::new(&common.open_device()?, &scene)?),
        false => None,
    };
    let mut posed = |time: f64| match &mut renderer {
        Some(renderer) => renderer.posed(time),
        None => Ok(Gaussians { motion_logits: Vec::new(), ..scene.gaussians.clone() }),
    };
    let written = if args.sequence {
        sequence(args, format, zip, &times, &mut posed)?
    } else if moves
        && holds_motion(format)
        && args.time.is_none()
        && !args.drop.contains(&Droppable::Motion)
    {
        let gaussians = spz::write_moving(&args.output, &scene, &posed(times[0])?)?;
        Written { gaussians, far: 0, bytes: size(&args.output)? }
    } else {
        let gaussians = posed(times[0])?;
        let count = format.write(&args.output, &gaussians)?;
        Written { gaussians: count, far: gaussians.len() - count, bytes: size(&args.output)? }
    };
    if written.far > 0 {
        let far = thousands(written.far);
        say(&format!(
            "note: left out {far} Gaussians that lie too far out for {}",
            format.extension()
        ));
    }
    let json = json!({
        "format": format.extension().trim_start_matches('.'),
        "gaussians": written.gaussians,
        "dropped": dropped,
        "far": written.far,
        "sh_degree": scene.gaussians.sh_degree,
        "frames": times.len(),
        "times": [times[0], times[times.len() - 1]],
        "left_out": left_out.iter().map(|what| what.name()).collect::<Vec<_>>(),
        "bytes": size(&args.scene)?,
        "written_bytes": written.bytes,
        "seconds": begun.elapsed().as_secs_f64(),
        "output": path_text(&args.output),
    });
    let text = format!(
        "{} Gaussians at {} in {}, {} (the scene's file has {})\n",
        thousands(written.gaussians),
        if times.len() == 1 { "one time".into() } else { format!("{} times", times.len()) },
        args.output.display(),
        bytes(written.bytes),
        bytes(size(&args.scene)?),
    );
    Ok(Answer { json, text })
}

fn size(path: &Path) -> Result<u64> {
    Ok(fs::metadata(path).map_err(Error::io(path))?.len())
}

fn is_zip(path: &Path) -> bool {
    path.extension().is_some_and(|end| end.eq_ignore_ascii_case("zip"))
}

/// The format of the file, or of the sequence's files.
fn format(args: &ExportArgs) -> Result<Format> {
    let version = match args.spz_version {
        SpzVersion::V3 => spz::Version::V3,
        SpzVersion::V4 => spz::Version::V4,
    };
    if args.sequence {
        if Format::of(&args.output).is_some() {
            let what = "names one file; --sequence writes many: name a folder or a .zip, and their \
                        format with --as";
            return Err(Error::format(&args.output, what));
        }
        return Ok(match args.format {
            Member::Ply => Format::Ply,
            Member::CompressedPly => Format::CompressedPly,
            Member::Splat => Format::Splat,
            Member::Spz => Format::Spz(version),
        });
    }
    match Format::of(&args.output) {
        Some(Format::Spz(_)) => Ok(Format::Spz(version)),
        Some(format) => Ok(format),
        None if is_zip(&args.output) => {
            Err(Error::format(&args.output, "a .zip holds a sequence: give --sequence"))
        }
        None => Err(Error::format(
            &args.output,
            "has no ending of a format that is written: .ply, .compressed.ply, .splat, .spz",
        )),
    }
}

fn holds_motion(format: Format) -> bool {
    format == Format::Spz(spz::Version::V4)
}

/// What the format does not hold and the scene has; an error where that was not asked for.
fn left_out(args: &ExportArgs, format: Format, scene: &Scene) -> Result<Vec<Droppable>> {
    let (mut left_out, mut refused) = (Vec::new(), Vec::new());
    let still = args.time.is_some() || args.drop.contains(&Droppable::Motion);
    if scene.moves() && !args.sequence && (still || !holds_motion(format)) {
        left_out.push(Droppable::Motion);
        if !still {
            refused.push(
                "the scene's motion: give --time for one moment, --sequence for a file for each time, or \
                 name an .spz, which holds it",
            );
        }
    }
    if scene.gaussians.used_sh_degree() > format.most_sh_degree() {
        left_out.push(Droppable::Bands);
        if !args.drop.contains(&Droppable::Bands) {
            refused.push(
                "colours that change with the direction (harmonics above the constant): --drop bands \
                 leaves them out",
            );
        }
    }
    match &refused[..] {
        [] => Ok(left_out),
        _ => Err(Error::Input(format!(
            "{} does not hold {}",
            format.extension(),
            refused.join("; nor ")
        ))),
    }
}

/// The times to write.
fn times(args: &ExportArgs, scene: &Scene) -> Result<Vec<f64>> {
    if !args.sequence {
        return Ok(vec![args.time.unwrap_or(0.0)]);
    }
    if let Some(frames) = args.frames {
        return Ok((0..frames).map(|i| i as f64 / (frames - 1).max(1) as f64).collect());
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

/// Writes a file for each time into a folder or an archive.
fn sequence(
    args: &ExportArgs,
    format: Format,
    zip: bool,
    times: &[f64],
    posed: &mut dyn FnMut(f64) -> Result<Gaussians>,
) -> Result<Written> {
    let mut meter = Meter::new("exporting", "files", times.len() as u64, 0);
    let digits = (times.len() - 1).to_string().len().max(4);
    let names: Vec<String> =
        (0..times.len()).map(|i| format!("frame{i:0digits$}{}", format.extension())).collect();
    let mut written = Written { gaussians: 0, far: 0, bytes: 0 };
    let mut next = |time: f64| -> Result<Vec<u8>> {
        interrupt::check()?;
        let gaussians = posed(time)?;
        let (bytes, count) = format.encode(&gaussians)?;
        written.gaussians = count;
        written.far = written.far.max(gaussians.len() - count);
        written.bytes += bytes.len() as u64;
        meter.advance();
        Ok(bytes)
    };
    if zip {
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
