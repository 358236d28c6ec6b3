//! `splat4d ablate`: contribution of each component of a reconstruction on one clip.

use std::fmt::Write;
use std::path::{Path, PathBuf};

use clap::Args;
use clap::builder::PossibleValuesParser;
use serde_json::{Value, json};
use splat4d::data::{Clip, Resize, images};
use splat4d::gpu::Device;
use splat4d::report::{Ablation, AblationRow, Figure};
use splat4d::track::Options;
use splat4d::train::{Quality, SequenceSettings};
use splat4d::{Error, Result, bench};

use super::ablation::{Figures, Material, figures};
use super::clip::ClipArgs;
use super::common::{Answer, Common, foresee, path_text, say, training};
use super::components::{COMPONENTS, Component, Switch};
use super::eval::truth_folder;
use super::networks::NetworkArgs;
use super::origins::{self, Given, Networks};
use super::outputs::{Folder, Inputs, Outputs};
use super::values;

/// Number of training steps before the first run that counts.
const WARM_UP: u32 = 5;

const AFTER_HELP: &str = "\
Reconstructs the clip with everything, then with one component off at a time, poses unknown each time:
  motion            everything is static
  windows           what moves has one set of Gaussians for the whole clip, however its look changes
  control-revision  no control points are added or removed in training
  blending          each Gaussian follows one control point
  arap              nothing keeps the control points' motion as rigid as possible
  lifespans         what comes or goes is there in all frames
  aside             no offset views in training
  flanks            offset views show nothing of movers that their own frame does not
  movers-depth      the depth term leaves movers out
  depth             no depth term
  growth            no Gaussians are added or moved to where they are needed
  sh                each Gaussian has one colour from everywhere
  lifting           a mover has one depth per region of its mask and frame
  stereo            static depth is that of the flow between neighbouring frames
  track-refinement  tracks are chained flow
  exposure          all frames are taken to be equally exposed
  rounds            masks and cameras are found once, not in turns
The last five track the clip anew; flow is computed once, and left out of the times, as are depth and
pointmaps of --models. Its networks for masks and features are asked in every run.

Every run is measured on the clip's frames, whole and inside the movers: those of CLIP/truth/masks, else
of the full run's masks. Where CLIP has a `truth` folder, as `synth` writes it, the held-out cameras are
measured as by `eval`, by distance. With --seeds N every run is made N times, with the seeds from --seed
on, and the table has the median and, in brackets, the worst.

Examples:
  splat4d ablate clip --report out
  splat4d ablate clip --only arap,lifting,aside --steps 600 --seeds 3

JSON: version, clip, frames, size, steps, seeds, machine {device, driver, kind, software,
subgroup_size, threads}, seconds_flow, figures [{key, title, better (more, less)}], rows [{component
(the first is `full`), without, runs (by seed: figures by their keys), failed (why, or null), summary
(by figure: {median, worst, change}; change is the median difference from the full run of the same
seed)}], networks (checksums of the files of --models, or `none`), sources (of the full run, as `track` tells
them). Figures: input_psnr, input_ssim, input_movers_psnr, input_movers_ssim; per distance K
held_out_K_psnr, held_out_K_ssim, held_out_K_movers_psnr, held_out_K_static_psnr (filmed pixels);
gaussians, control_points, seconds_track, seconds_train, peak_bytes (of device memory in training).";

/// Measure the contribution of each component of a reconstruction by disabling it
#[derive(Args)]
#[command(after_help = AFTER_HELP)]
pub struct AblateArgs {
    /// A video file, or a folder of its frames; ground truth is read from a folder `truth` beside them
    #[arg(value_name = "CLIP")]
    clip: PathBuf,
    #[command(flatten)]
    frames: ClipArgs,
    #[command(flatten)]
    networks: NetworkArgs,
    /// Disable only these components, one at a time
    #[arg(long, value_name = "NAME,…", value_delimiter = ',',
          value_parser = PossibleValuesParser::new(COMPONENTS.map(|component| component.name)))]
    only: Vec<String>,
    /// Steps of the last and longest stage; earlier stages scale in proportion
    #[arg(long, value_name = "N", default_value_t = SequenceSettings::default().steps,
          value_parser = values::whole::<u32>(1..=values::MOST_STEPS))]
    steps: u32,
    /// Maximum number of Gaussians [default: 40,000, or one for every three pixels of a frame]
    #[arg(long, value_name = "N",
          value_parser = values::whole::<usize>(16..=values::MOST_GAUSSIANS))]
    max_gaussians: Option<usize>,
    /// Repeat every run with this many seeds
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = values::whole::<u64>(1..=100))]
    seeds: u64,
    /// Write ablation.csv and index.html to this folder
    #[arg(long, value_name = "DIR")]
    report: Option<PathBuf>,
}

/// Runs the command.
pub fn run(args: &AblateArgs, common: &Common) -> Result<Answer> {
    check_outputs(args)?;
    std::fs::metadata(&args.clip).map_err(Error::io(&args.clip))?;
    let truth = truth_folder(&args.clip)?;
    let mut models = args.networks.open()?;
    let networks = args.networks.identity()?;
    let device = common.open_device()?;
    let preset = Quality::Standard.preset(device.info().kind);
    let longest = Resize::Longest(preset.longest_side);
    let clip = args.frames.open(&args.clip, longest, truth.is_some())?;
    let size = (clip.width, clip.height);
    let usual = preset.settings(size, Some(args.steps));
    let max_gaussians = args.max_gaussians.unwrap_or(usual.max_gaussians);
    let settings = SequenceSettings { max_gaussians, ..usual };
    check_memory(&device, &settings, clip.frames.len(), size)?;
    let seeds: Vec<u64> = (0..args.seeds).map(|i| common.seed.wrapping_add(i)).collect();
    let scale = f64::from(clip.width) / f64::from(clip.original.0);
    let mut known = Options { focal: clip.focal.map(|focal| focal * scale), ..Options::default() };

    let mut material = Material::new(&device, clip, truth.as_deref());
    material.estimate(&mut models, &mut known)?;
    let mut sources = Value::Null;
    let chosen: Vec<&Component> = COMPONENTS
        .iter()
        .filter(|c| args.only.is_empty() || args.only.iter().any(|name| name == c.name))
        .collect();
    let mut rows = vec![empty("full", "all of it")];
    rows.extend(chosen.iter().map(|component| empty(component.name, component.without)));
    for (number, &seed) in seeds.iter().enumerate() {
        let of_seed = match seeds.len() {
            1 => String::new(),
            all => format!(", seed {} of {all}", number + 1),
        };
        let options = Options { seed, ..known.clone() };
        let settings = SequenceSettings { seed, ..settings.clone() };
        say(&format!("full run{of_seed}"));
        let full = material.track(&options, &mut models)?;
        material.keep_masks(&full.track);
        if number == 0 {
            let (opened, told) = (Networks::of(models.as_ref()), &full.track.quality.told);
            sources = origins::to_json(&origins::of(Given::default(), &opened, told));
            // A device compiles its pipelines on first use, which should not count for any run.
            material.train(&full, &settings.clone().of_steps(args.steps.min(WARM_UP)))?;
        }
        rows[0].runs.push(material.train(&full, &settings)?);
        for (i, component) in chosen.iter().enumerate() {
            let (name, place) = (component.name, format!("{} of {}", i + 1, chosen.len()));
            if rows[i + 1].failed.is_some() {
                continue;
            }
            say(&format!("without {name} ({place}{of_seed})"));
            let made = match component.switch {
                Switch::Train(off) => material.train(&full, &without(&settings, off)),
                Switch::Track(off) => {
                    let tracked = material.track(&without(&options, off), &mut models);
                    tracked.and_then(|tracked| material.train(&tracked, &settings))
                }
            };
            note(&mut rows[i + 1], made)?;
        }
    }
    let found = Ablation {
        version: env!("CARGO_PKG_VERSION").into(),
        clip: args.clip.display().to_string(),
        frames: material.frames.len(),
        size: [size.0, size.1],
        steps: args.steps,
        seeds,
        machine: bench::machine(&device),
        figures: figures(&material.distances),
        rows,
    };
    let mut json = found.json();
    json["seconds_flow"] = json!(material.seconds_flow);
    json["networks"] = json!(networks);
    json["sources"] = sources;
    if let Some(folder) = &args.report {
        found.write_report(folder)?;
        json["report"] = path_text(folder);
    }
    Ok(Answer { text: text(&found, &json), json })
}

/// Options with a component off.
fn without<T: Clone>(options: &T, off: fn(&mut T)) -> T {
    let mut options = options.clone();
    off(&mut options);
    options
}

fn empty(component: &str, without: &str) -> AblationRow {
    AblationRow {
        component: component.into(),
        without: without.into(),
        runs: Vec::new(),
        failed: None,
    }
}

/// Adds a run to its row. A clip that cannot be reconstructed without a component is a result; unrelated
/// errors end the command.
fn note(row: &mut AblationRow, made: Result<Figures>) -> Result<()> {
    match made {
        Ok(figures) => row.runs.push(figures),
        Err(error @ (Error::Input(_) | Error::Failed(_))) => {
            say(&format!("note: without {} this came to nothing: {error}", row.component));
            row.failed = Some(error.to_string());
            row.runs.clear();
        }
        Err(other) => return Err(other),
    }
    Ok(())
}

/// Checks that the report can be written and does not overwrite inputs.
fn check_outputs(args: &AblateArgs) -> Result<()> {
    let Some(folder) = &args.report else { return Ok(()) };
    let outputs = Outputs::default().folder(folder, &Ablation::REPORT_FILES)?;
    let pictures = ["", "frames", "images", "truth/masks"];
    let read = pictures.map(|name| -> Folder { (args.clip.join(name), &images::EXTENSIONS) });
    let frames =
        if args.clip.is_dir() { Clip::files(&args.clip).unwrap_or_default() } else { vec![] };
    outputs.spare(&Inputs::new(
        frames.into_iter().chain([args.clip.clone()]).chain(args.networks.files()),
        read,
    ))
}

fn check_memory(
    device: &Device,
    settings: &SequenceSettings,
    frames: usize,
    size: (u32, u32),
) -> Result<()> {
    let scale = settings.scale(frames, size);
    let most = || scale.most_gaussians(device);
    let turn = "lower --max-gaussians or --size";
    foresee(device, &training(&scale), scale.footprint(device), most, turn)?;
    Ok(())
}

/// A column of the table: heading, divisor of the values, digits.
type Column<'a> = (&'a Figure, String, f64, usize);

/// The column of a metric, if the table shows it.
fn column(figure: &Figure) -> Option<Column<'_>> {
    let mebi = f64::from(1 << 20);
    let (heading, unit, digits) = match figure.key.as_str() {
        "input_psnr" => ("input".to_owned(), 1.0, 2),
        "input_movers_psnr" => ("movers".to_owned(), 1.0, 2),
        "gaussians" => ("Gaussians".to_owned(), 1.0, 0),
        "seconds_track" => ("track s".to_owned(), 1.0, 1),
        "seconds_train" => ("train s".to_owned(), 1.0, 1),
        "peak_bytes" => ("MiB".to_owned(), mebi, 1),
        key => {
            let place = key.strip_prefix("held_out_")?.strip_suffix("_psnr")?;
            // The mean over all distances is not informative.
            let heading = place.replace('_', " ");
            (Some(heading).filter(|heading| !heading.starts_with("all"))?, 1.0, 2)
        }
    };
    Some((figure, heading, unit, digits))
}

fn text(found: &Ablation, json: &Value) -> String {
    let known = |figure: &&Figure| found.summary(&found.rows[0], figure).is_some();
    let columns: Vec<Column<'_>> = found.figures.iter().filter(known).filter_map(column).collect();
    let several = found.seeds.len() > 1;
    let width = if several { 16 } else { 10 };
    let mut text =
        String::from("PSNR in dB: of the input, of held-out cameras by their folder's name\n");
    let _ = write!(text, "{:18}", "without");
    for (_, heading, ..) in &columns {
        let _ = write!(text, "{heading:>width$}");
    }
    text.push('\n');
    for row in &found.rows {
        let name = if row.component == "full" { "– (full run)" } else { &row.component };
        let _ = write!(text, "{name:18}");
        if let Some(why) = &row.failed {
            let _ = writeln!(text, "  came to nothing: {why}");
            continue;
        }
        for (figure, _, unit, digits) in &columns {
            let shown = found.summary(row, figure).map_or("–".to_owned(), |summary| {
                let [median, worst] = [summary.median, summary.worst].map(|v| v / unit);
                match several {
                    true => format!("{median:.digits$} ({worst:.digits$})"),
                    false => format!("{median:.digits$}"),
                }
            });
            let _ = write!(text, "{shown:>width$}");
        }
        text.push('\n');
    }
    if let Some(seconds) = json["seconds_flow"].as_f64() {
        let _ = writeln!(text, "flow, once for all runs: {seconds:.1} s");
    }
    if let Some(folder) = json["report"].as_str() {
        let index = Path::new(folder).join(Ablation::REPORT_FILES[1]);
        let _ = writeln!(text, "{}", index.display());
    }
    text
}
