//! `splat4d bench`: benchmarks operations and pipelines.

use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use clap::{Args, Subcommand, ValueEnum};
use serde_json::json;
use splat4d::bench::{self, Budget, ErrorMeasure, Pace, Profile, Shot};
use splat4d::camera_path::{CameraPath, PathShape};
use splat4d::gpu::Device;
use splat4d::renderer::RenderScale;
use splat4d::report::{
    Curve, CurvePoint, Machine, Measurements, Peaks, Place, Point, PowerLaw, Row, Verdict, compare,
    duration, rate, scientific,
};
use splat4d::scene::{Opened, Scene};
use splat4d::types::Tuning;
use splat4d::{Error, Result};

use super::common::{Answer, Common, bytes, foresee, say, thousands};
use super::outputs::{Inputs, Outputs};
use super::{interrupt, tuning, values};

/// Number of views that a sweep of a scene renders.
const SWEEP_VIEWS: usize = 2;
/// Number of views for a budget: the search uses all but one, which tests the result.
const BUDGET_VIEWS: usize = 3;

const AFTER_HELP: &str = "\
Every row is held against the oracle in f64 before it is timed; one that misses its bound has an
error and no speed. Times are the device's own timestamps, without uploads and downloads.

Exit code 1 when a row misses its bound, or the settings found miss the budget on that view.

Parts, for --filter: scan, sort, project, bin, raster, loss, deform, mlp, arap, adam, density,
roofline, render, pipeline, and the sweeps of speed against error: sweep/still, sweep/motion,
sweep/scene (with --scene).

With --profile rows are taken apart instead: the time of each kernel of an execution, its share, what
the host adds, and what of the device's peaks the row's counted bytes and operations reach. Without a
filter, of the pipelines.

With --scale nothing is measured but how time and memory grow: of a render and of training steps,
against Gaussians (10 k to 5 M; 480×270 on a software driver, else 1920×1080), pixels (0.1 to 8 MP),
control points and frames, each with a power law through its points and the kernels that grow faster
than linearly. What would not fit is foreseen and left out.

With --error-budget nothing but the settings is looked for: the fastest ones whose image error stays
within it on views of the scene; one view is kept out of the search to test them.

The commit in the report is SPLAT4D_COMMIT where it is set, else the one that the package was built
from, else what git says.

Examples:
  splat4d bench --report out
  splat4d bench --filter sort --quick
  splat4d bench --profile --filter train_step
  splat4d bench --scale --report out
  splat4d bench --scene scene.ply --error-budget 0.004 --settings fast.json
  splat4d render scene.ply -o views --settings fast.json
  splat4d bench cmp before/bench.json after/bench.json

JSON: format, version, commit, unix_seconds, machine {device, driver, kind, software, subgroup_size, threads},
peaks {bytes, operations} (per second), rows [{id, size, place, clock, accuracy {of_bound, error, output},
work {bytes, operations}, time (nanoseconds, or null)}], sweeps [{scene, gaussians, size, clock, points
[{knob, value, settings, time, ratio (to the best settings' time, in turns), error {max, rmse, psnr}}]}],
choice {scene, budget, measure, settings, time_ratio, error, met, views} or null, curves [{pipeline, axis,
held, clock, accuracy, points [{size, time, foreseen, taken (bytes of device memory), left_out (why, or null),
kernels [[name, nanoseconds]]}]}] (with --scale), missed (rows without speed), seconds. With --profile:
machine, peaks, profiles [{id, size, executions, device, wall (nanoseconds), host_share, work {bytes,
operations}, subgroup_size, kernels [{kernel, workgroup, dispatches, time, share}]}]. Of cmp: rows [{name,
ratio, interval, verdict}], faster, slower, noise, incomparable";

/// Measure every operation and pipeline, and the accuracy cost of each speed-up
#[derive(Args)]
#[command(after_help = AFTER_HELP, args_conflicts_with_subcommands = true)]
pub struct BenchArgs {
    #[command(subcommand)]
    command: Option<BenchCommand>,
    /// Only rows and sweeps whose name contains this text
    #[arg(long, value_name = "TEXT")]
    filter: Option<String>,
    /// Small sizes and few samples: a rough indication, not a measurement
    #[arg(long)]
    quick: bool,
    /// Also sweep speed against error on this scene: a scene file or a PLY
    #[arg(long, value_name = "FILE")]
    scene: Option<PathBuf>,
    /// Size of the rendered images
    #[arg(long, value_name = "WxH", value_parser = values::size, default_value = "480x270")]
    size: (u32, u32),
    /// Write index.html, bench.json and bench.csv to this folder
    #[arg(long, value_name = "DIR")]
    report: Option<PathBuf>,
    /// Print the time of each row by kernel
    #[arg(long, conflicts_with_all = ["scene", "report", "error_budget"])]
    profile: bool,
    /// Measure time and memory against number of Gaussians, pixels, control points and frames
    #[arg(long, conflicts_with_all = ["scene", "error_budget", "profile", "filter"])]
    scale: bool,
    /// Approximate time limit of --scale; measurements that would take longer are left out, with a note
    #[arg(long, value_name = "SECONDS", default_value_t = 480.0,
          requires = "scale", value_parser = values::number(0.001..=values::MOST_SECONDS))]
    seconds: f64,
    /// Choose the fastest settings whose image error is at most this; colours are in [0, 1]
    #[arg(long, value_name = "ERROR", requires = "scene",
          value_parser = values::number(1e-30..=1.0))]
    error_budget: Option<f64>,
    /// Error measure of the budget
    #[arg(long, value_name = "MEASURE", default_value = "rmse", requires = "error_budget")]
    error_measure: Measure,
    /// Write the chosen settings to this file; `render` and `train` read them with --settings
    #[arg(long, value_name = "FILE", requires = "error_budget")]
    settings: Option<PathBuf>,
}

#[derive(Subcommand)]
enum BenchCommand {
    /// Compare two results row by row; gives no verdict where the noise is too large
    Cmp {
        /// A bench.json
        a: PathBuf,
        /// The bench.json to compare with it
        b: PathBuf,
    },
}

#[derive(Clone, Copy, ValueEnum)]
enum Measure {
    /// Root mean square over pixels and channels
    Rmse,
    /// Largest difference of any channel
    Max,
}

/// Runs the command. The exit code indicates whether every row kept its error bound and the budget was met.
pub fn run(args: &BenchArgs, common: &Common) -> Result<(Answer, ExitCode)> {
    if let Some(BenchCommand::Cmp { a, b }) = &args.command {
        return Ok((cmp(a, b)?, ExitCode::SUCCESS));
    }
    let mut outputs = Outputs::default();
    if let Some(folder) = &args.report {
        outputs = outputs.folder(folder, &Measurements::REPORT_FILES)?;
    }
    if let Some(file) = &args.settings {
        outputs = outputs.file(file)?;
    }
    outputs.spare(&Inputs::new(args.scene.clone(), []))?;
    let begun = std::time::Instant::now();
    let scene = args.scene.as_deref().map(open_scene).transpose()?;
    let device = common.open_device()?;
    if let Some((_, scene)) = &scene {
        let scale = RenderScale::new(scene, args.size, &Tuning::default());
        let most = || scale.most_gaussians(&device);
        foresee(&device, "rendering the scene", scale.footprint(&device), most, "lower --size")?;
    }
    let mut measured = Measurements::new(bench::machine(&device), bench::commit());
    if measured.machine.software {
        say("note: a software driver: its times say nothing of a GPU");
    }
    let pace = if args.quick { Pace::QUICK } else { Pace::FULL };
    if args.profile {
        return Ok((profiles(args, common, &device, pace, &measured.machine)?, ExitCode::SUCCESS));
    }
    match (args.error_budget, &scene) {
        (Some(error), Some((name, scene))) => {
            let measure = match args.error_measure {
                Measure::Rmse => ErrorMeasure::Rmse,
                Measure::Max => ErrorMeasure::Max,
            };
            let shots = shots(scene, args.size, BUDGET_VIEWS);
            let budget = Budget { error, measure };
            let (settings, choice) =
                bench::choose(&device, name, scene, &shots, budget, pace, &mut |turn| {
                    interrupt::check()?;
                    say(&format!("turned {turn}"));
                    Ok(())
                })?;
            if let Some(file) = &args.settings {
                tuning::write(file, &settings)?;
            }
            measured.choice = Some(choice);
        }
        _ if args.scale => {
            let time = Duration::from_secs_f64(args.seconds);
            let mut each = |curve: &Curve, point: &CurvePoint| {
                interrupt::check()?;
                say(&curve_point_text(curve, point));
                Ok(())
            };
            measured.curves = bench::curves(&device, common.seed, args.quick, time, &mut each)?;
        }
        _ => measure(args, common, &device, scene.as_ref(), pace, &mut measured)?,
    }
    measured.unix_seconds =
        SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_secs());
    if let Some(folder) = &args.report {
        measured.write_report(folder)?;
    }
    let missed = measured.rows.iter().filter(|row| row.time().is_none()).count();
    let mut json = serde_json::to_value(&measured)
        .map_err(|e| Error::Failed(format!("the results cannot be written as JSON: {e}")))?;
    json["missed"] = json!(missed);
    json["seconds"] = json!(begun.elapsed().as_secs_f64());
    let kept = missed == 0
        && measured.curves.iter().all(|curve| curve.accuracy.passed())
        && measured.choice.as_ref().is_none_or(|choice| choice.met);
    let code = if kept { ExitCode::SUCCESS } else { ExitCode::FAILURE };
    Ok((Answer { json, text: text(&measured, missed) }, code))
}

fn open_scene(path: &Path) -> Result<(String, Scene)> {
    let Opened { scene, .. } = Scene::open(path, false)?;
    let name = path.file_name().map_or_else(String::new, |n| n.to_string_lossy().into_owned());
    Ok((name, scene))
}

/// Measures rows first, then sweeps, as selected by the filter.
fn measure(
    args: &BenchArgs,
    common: &Common,
    device: &Device,
    scene: Option<&(String, Scene)>,
    pace: Pace,
    measured: &mut Measurements,
) -> Result<()> {
    let filter = args.filter.as_deref();
    let entries = bench::entries(args.quick);
    let sweeps = ["sweep/still", "sweep/motion", "sweep/scene"];
    let wanted = |name: &str| filter.is_none_or(|filter| name.contains(filter));
    if !entries.iter().any(|entry| entry.matches(filter)) && !sweeps.iter().any(|s| wanted(s)) {
        let filter = filter.unwrap_or_default();
        return Err(Error::Input(format!(
            "no row's name holds `{filter}`; --help lists the parts"
        )));
    }
    let machine = measured.machine.clone();
    measured.rows = bench::run(device, &entries, filter, pace, common.seed, |row| {
        interrupt::check()?;
        say(&row_text(row, machine.software));
        Ok(())
    })?;
    measured.peaks = bench::peaks(&measured.rows);
    let mut each = |point: &Point| {
        interrupt::check()?;
        say(&point_text(point));
        Ok(())
    };
    if wanted(sweeps[0]) {
        let (gaussians, [w, h]) =
            if args.quick { (5000, [240, 136]) } else { (30_000, [480, 270]) };
        let (still, shots) = bench::still_scene(common.seed, gaussians, w, h);
        let name = "still, synthetic";
        measured.sweeps.push(bench::sweep(device, name, &still, &shots, pace, &mut each)?);
    }
    if wanted(sweeps[1]) {
        let sweep = bench::sweep_motion(device, common.seed, args.quick, pace, &mut each)?;
        measured.sweeps.push(sweep);
    }
    if let Some((name, scene)) = scene
        && wanted(sweeps[2])
    {
        let shots = shots(scene, args.size, SWEEP_VIEWS);
        measured.sweeps.push(bench::sweep(device, name, scene, &shots, pace, &mut each)?);
    }
    Ok(())
}

/// Profiles the rows that the filter selects; without a filter, the pipelines.
fn profiles(
    args: &BenchArgs,
    common: &Common,
    device: &Device,
    pace: Pace,
    machine: &Machine,
) -> Result<Answer> {
    let filter = args.filter.as_deref().unwrap_or("pipeline/");
    let (mut profiles, mut text) = (Vec::new(), String::new());
    let all = bench::entries(true);
    let most = bench::run(device, &all, Some("roofline/"), pace, common.seed, |_| Ok(()))?;
    let peaks = bench::peaks(&most);
    for entry in bench::entries(args.quick).iter().filter(|entry| entry.matches(Some(filter))) {
        interrupt::check()?;
        if let Some(profile) = bench::profile(device, entry, pace, common.seed)? {
            text += &profile_text(&profile, &peaks);
            profiles.push(profile);
        }
    }
    if profiles.is_empty() {
        return Err(Error::Input(format!(
            "no row's name holds `{filter}` and runs on the device; --help lists the parts"
        )));
    }
    let json = json!({ "machine": machine, "peaks": peaks, "profiles": profiles });
    Ok(Answer { json, text })
}

fn profile_text(profile: &Profile, peaks: &Peaks) -> String {
    let Profile { id, size, executions, device, wall, kernels, .. } = profile;
    let mut text = format!(
        "{id}, {size}: {} on the device, {} in all, {:.1} % of it the host's (medians of \
         {executions}); subgroups of {}\n",
        duration(*device),
        duration(*wall),
        100.0 * profile.host_share,
        profile.subgroup_size
    );
    let shares = profile.shares(peaks).into_iter().zip(["bytes", "operations"]);
    for (share, what) in shares.filter_map(|(share, what)| Some((share?, what))) {
        let _ = writeln!(text, "  {what}: {:.1} % of what the device does at most", 100.0 * share);
    }
    for kernel in kernels {
        let [x, y, z] = kernel.workgroup;
        let _ = writeln!(
            text,
            "  {:<24} {:>9}  {:>5.1} %  {:>4} dispatches, workgroups of {}",
            kernel.kernel,
            duration(kernel.time),
            100.0 * kernel.share,
            kernel.dispatches,
            x * y * z
        );
    }
    text
}

/// Views spread over the scene's own cameras, or around a scene without cameras.
fn shots(scene: &Scene, (width, height): (u32, u32), count: usize) -> Vec<Shot> {
    let cameras = &scene.cameras;
    let cameras: Vec<_> = if cameras.len() >= count {
        (0..count).map(|i| cameras[(2 * i + 1) * cameras.len() / (2 * count)]).collect()
    } else {
        let orbit = CameraPath::new(scene, PathShape::Orbit, count);
        (0..count).map(|i| orbit.at(i)).collect()
    };
    cameras
        .into_iter()
        .map(|mut shot| {
            let k = &mut shot.camera.intrinsics;
            *k = k.fitted(width, height);
            Shot { camera: shot.camera, time: shot.time }
        })
        .collect()
}

fn row_text(row: &Row, software: bool) -> String {
    let tag = match row.place {
        Place::Processor => " [processor]",
        Place::Device if software => " [software]",
        Place::Device => "",
    };
    let name = format!("{}{tag}, {}", row.id, row.size);
    let Some(time) = row.time() else {
        return format!(
            "{name:<56} no speed: {} of the bound in {}, error {}",
            scientific(row.accuracy.of_bound),
            row.accuracy.output,
            scientific(row.accuracy.error)
        );
    };
    let [low, high] = time.quartiles();
    let rates = [(row.bandwidth(), "B"), (row.throughput(), "op")];
    let rates: Vec<String> =
        rates.iter().filter_map(|(value, unit)| Some(rate((*value)?, unit))).collect();
    format!(
        "{name:<56} {:>9}  ({} to {})  {}",
        duration(time.median()),
        duration(low),
        duration(high),
        rates.join(", ")
    )
}

fn point_text(point: &Point) -> String {
    let name = format!("{} {}", point.knob, point.value);
    format!(
        "{:<26} {:>9} a frame, {:.3} of the best's, largest error {}, RMSE {}, PSNR {:.1} dB",
        name.trim(),
        duration(point.time.median()),
        point.ratio.median(),
        scientific(point.error.max),
        scientific(point.error.rmse),
        point.error.psnr
    )
}

fn curve_point_text(curve: &Curve, point: &CurvePoint) -> String {
    let what = format!("{}, {} {}", curve.pipeline, thousands(point.size as usize), curve.axis);
    let memory = |bytes_of: Option<u64>| bytes_of.map_or("unknown".into(), bytes);
    match (&point.time, &point.left_out) {
        (Some(time), _) => format!(
            "{what:<46} {:>9}  {:>10} ({} foreseen)",
            duration(time.median()),
            memory(point.taken),
            memory(point.foreseen)
        ),
        (None, why) => format!("{what:<46} {}", why.as_deref().unwrap_or("not measured")),
    }
}

/// Exponent above which a kernel is reported as growing faster than linearly; smaller excesses are noise.
const STEEP: f64 = 1.1;

fn curve_text(curve: &Curve) -> String {
    let law = |law: Option<PowerLaw>| match law {
        Some(PowerLaw { exponent, range: [from, to], off, .. }) => format!(
            "~ size^{exponent:.2} from {} to {} (off by {off:.2} times at most)",
            thousands(from as usize),
            thousands(to as usize)
        ),
        None => "not enough points".into(),
    };
    let mut text = format!("\n{} against {}: {}\n", curve.pipeline, curve.axis, curve.held);
    let _ = writeln!(text, "  time   {}", law(curve.time_law()));
    let _ = writeln!(text, "  memory {}", law(curve.memory_law()));
    if let Some(last) = curve.last_law() {
        let _ = writeln!(text, "  time, the two largest sizes ~ size^{:.2}", last.exponent);
        for (kernel, exponent, share) in curve.steeper_than(STEEP) {
            let percent = 100.0 * share;
            let _ = writeln!(text, "    {kernel} ~ size^{exponent:.2}, {percent:.1} % of it");
        }
    }
    for point in &curve.points {
        let _ = writeln!(text, "  {}", curve_point_text(curve, point));
    }
    text
}

fn text(measured: &Measurements, missed: usize) -> String {
    let mut text = String::new();
    let machine = &measured.machine;
    let _ = writeln!(text, "{} ({})", machine.device, machine.driver);
    let peaks = [
        ("copies at most", measured.peaks.bytes.map(|r| rate(r, "B"))),
        ("calculates at most", measured.peaks.operations.map(|r| rate(r, "flop"))),
    ];
    for (what, value) in peaks {
        let _ = value.map(|value| writeln!(text, "{what} {value}"));
    }
    for row in &measured.rows {
        let share = row.share(&measured.peaks).map(|s| format!(", {:.1} %", 100.0 * s));
        let line = row_text(row, machine.software);
        let _ = writeln!(text, "{line}{}", share.unwrap_or_default());
    }
    for sweep in &measured.sweeps {
        let [width, height] = sweep.size;
        let count = thousands(sweep.gaussians);
        let _ = writeln!(text, "\n{}: {count} Gaussians, {width}×{height}", sweep.scene);
        for point in &sweep.points {
            let _ = writeln!(text, "  {}", point_text(point));
        }
    }
    measured.curves.iter().for_each(|curve| text += &curve_text(curve));
    if let Some(choice) = &measured.choice {
        let met = if choice.met { "met" } else { "missed" };
        let _ = writeln!(
            text,
            "{}\nOn a view that the search did not use, the budget of {} ({}) is {met}: largest \
             error {}, RMSE {}, PSNR {:.1} dB, in {:.3} of the time of the best settings.",
            choice.settings,
            choice.budget,
            choice.measure,
            scientific(choice.error.max),
            scientific(choice.error.rmse),
            choice.error.psnr,
            choice.time_ratio
        );
    }
    if missed > 0 {
        let _ = writeln!(text, "\n{missed} rows missed their bound and have no speed");
    }
    text
}

fn cmp(a: &Path, b: &Path) -> Result<Answer> {
    let (first, second) = (Measurements::open(a)?, Measurements::open(b)?);
    let all = compare(&first, &second);
    let count = |verdict: Verdict| all.iter().filter(|c| c.verdict == verdict).count();
    let mut text = String::new();
    for (name, run) in [("A", &first), ("B", &second)] {
        let commit = run.commit.as_deref().unwrap_or("commit not known");
        let _ = writeln!(text, "{name}: {} ({}), {commit}", run.machine.device, run.machine.driver);
    }
    for row in &all {
        let what = match (row.verdict, row.ratio, row.interval) {
            (Verdict::Faster, Some(r), Some([l, h])) => format!("{r:.3} ({l:.3} to {h:.3}) faster"),
            (Verdict::Slower, Some(r), Some([l, h])) => format!("{r:.3} ({l:.3} to {h:.3}) slower"),
            (Verdict::Noise, Some(r), Some([l, h])) => {
                format!("{r:.3} ({l:.3} to {h:.3}) too noisy for a verdict")
            }
            (Verdict::Noise, ..) => "too noisy for a verdict".into(),
            _ => "on one side only".into(),
        };
        let _ = writeln!(text, "{:<64} {what}", row.name);
    }
    let json = json!({
        "rows": all,
        "faster": count(Verdict::Faster),
        "slower": count(Verdict::Slower),
        "noise": count(Verdict::Noise),
        "incomparable": count(Verdict::Incomparable),
    });
    Ok(Answer { json, text })
}
