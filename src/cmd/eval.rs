//! `splat4d eval`: evaluates a scene on images or on a synthetic clip's ground truth, or a trajectory or
//! point tracks against a reference.

use std::collections::BTreeSet;
use std::fmt::Write;
use std::path::{Path, PathBuf};

use clap::Args;
use serde_json::{Map, Value, json};
use splat4d::data::trajectory::{self, Format, QuaternionOrder, Trajectory};
use splat4d::data::{Dataset, Resize, View, cam, images};
use splat4d::eval::{
    Align, Comparison, Relative, Statistics, Step, TrajectoryErrors, compare_matrices, masked_mean,
    masked_psnr, nearest_by_time, ssim_map,
};
use splat4d::observe::onnx::LpipsNetwork;
use splat4d::renderer::Renderer;
use splat4d::scene::{Opened, Scene};
use splat4d::types::Image;
use splat4d::{Error, Result};

use super::common::{Answer, Common, notes, say, thousands};
use super::eval_truth::Extras;
use super::held_out::{self, Comparisons};
use super::interrupt;
use super::meter::Meter;
use super::networks::LpipsArgs;
use super::outputs::Inputs;
use super::quality::{self, Quality};
use super::values;
use super::{eval_first, eval_tracks, eval_truth};

const AFTER_HELP: &str = "\
REFERENCE decides what is measured:
  a dataset (as for `train`)     the scene, rendered from the dataset's cameras, against its
                                 images: those of its test split, or of --eval-every, or all
  the truth folder of a clip     (from `synth`) the scene's cameras against the true ones, its depth
                                 and motion masks, and images of held-out cameras, after aligning
                                 by a similarity: rotation from the cameras' orientations, scale
                                 and translation from their centres
  a folder of v000_t003.png …    what the scene's first camera sees at the times of other frames
                                 (here of frame 3), from that camera's own pose, nothing aligned
  a trajectory                   a trajectory against it, after --align, as the evo package measures;
                                 files of TUM, KITTI or EuRoC, Sintel's .cam or a folder of them,
                                 told by what they hold. Poses pair by timestamp as evo pairs them,
                                 in order where a format has none (KITTI, .cam)
  an .npz of point tracks        tracks of the same points against it, as TAP-Vid measures them

Examples:
  splat4d eval fox.safetensors captures/fox --eval-every 8
  splat4d eval scene.safetensors clip/truth --json
  splat4d eval scene.safetensors clip/truth --fit-poses --pictures views
  splat4d eval scene.safetensors balloon/gt_cam000
  splat4d eval estimate.txt groundtruth.txt
  splat4d eval orb.txt KITTI_00_gt.txt --align se3 --rpe-delta 100 --rpe-unit metres
  splat4d eval tracked/poses.txt sintel/camdata_left/alley_1 --align sim3
  splat4d eval tracked/tracks.npz clip/truth/tracks.npz

JSON: psnr, ssim, ms_ssim, lpips (by --lpips FILE, else null: no network weights come along), lpips_net (its
features, as the file names them: figures of different nets do not compare), per_frame [{name, psnr, ssim,
ms_ssim, lpips}], psnr_covisible, ssim_covisible (of a dataset with masks of what the training
images saw as well, DyCheck's: over those pixels, SSIM as the mean of its map there), ate_rmse,
ate_relative (to the length of the camera's path), rpe_trans_rmse, rpe_rot_deg_rmse, scale, poses,
focal_error (relative), depth_rel_median, mask_iou;
scale_by: what told the scale between a scene and its truth: centres (of the cameras), or of a camera that
stood still depth (the truth's), or pictures (no depth is there: the scale, one number, from which the scene
looks most like held-out images; these figures are flattered by as much);
ape_trans, ape_rot_deg, rpe_trans, rpe_rot_deg: of a trajectory the errors of centres (in the reference's
unit) and rotations (degrees), absolute and relative, each {rmse, mean, median, std, min, max, sse};
rpe_pairs: the pairs of poses that the relative ones compare (--rpe-delta; they are null without any).
ate_rmse, rpe_trans_rmse and rpe_rot_deg_rmse are the same rmse (the latter two null where the reference
stands still);
tracks: {all, movers, static}, each {average_jaccard, position_accuracy, within (shares within 1, 2, 4, 8 and
16 pixels of 256×256), occlusion_accuracy, points}; the latter two by `masks` beside the reference, null
without;
psnr_own_focal, ssim_own_focal, ms_ssim_own_focal: the same images of a clip's held-out cameras, but
with their focal length multiplied by the scene's own error in it, which hides that error.
held_out: images that no input camera took, 8-bit as a file holds them, one row for each distance (a
folder of held-out cameras, or first_camera) and one for all: {distance, pictures, psnr, ssim, ms_ssim,
worst (PSNR), worst_picture, movers, outside_movers, covisible, static_covisible, not_filmed_share}. The
four regions are {psnr, ssim, worst, worst_picture, pictures}: what moves (held_out/masks/K), the rest,
the pixels whose static point some input frame saw (held_out/covisible/K), and those of them that do not
move. A region's PSNR is that of its pixels, its SSIM the mean of the map there; both are means over the
images in which it holds at least 0.1 % of the pixels, so that each image counts alike.
held_out_fitted: the same with each pose fitted to its image (--fit-poses): least squared error over
the static covisible pixels, or all where masks are missing. Poses fitted to test images flatter.
What does not apply is null; so is an infinite PSNR.";

/// Number of a dataset's images in memory at a time.
const AT_A_TIME: usize = 8;

/// All keys of the JSON, which are always present.
const KEYS: [&str; 29] = [
    "psnr",
    "ssim",
    "ms_ssim",
    "psnr_covisible",
    "ssim_covisible",
    "lpips",
    "lpips_net",
    "per_frame",
    "held_out",
    "held_out_fitted",
    "ate_rmse",
    "ate_relative",
    "rpe_trans_rmse",
    "rpe_rot_deg_rmse",
    "ape_trans",
    "ape_rot_deg",
    "rpe_trans",
    "rpe_rot_deg",
    "rpe_pairs",
    "scale",
    "scale_by",
    "poses",
    "focal_error",
    "depth_rel_median",
    "mask_iou",
    "tracks",
    "psnr_own_focal",
    "ssim_own_focal",
    "ms_ssim_own_focal",
];

/// Evaluate a scene on images or ground truth, or a trajectory or point tracks against a reference
#[derive(Args)]
#[command(after_help = AFTER_HELP)]
pub struct EvalArgs {
    /// A scene file, a 3DGS PLY, a trajectory (TUM, KITTI, EuRoC, .cam), or point tracks (.npz)
    #[arg(value_name = "SCENE|TRAJECTORY|TRACKS")]
    pub estimate: PathBuf,
    /// A dataset, a clip's truth folder, images of the first camera, a trajectory (TUM, KITTI, EuRoC,
    /// .cam), or point tracks (.npz)
    pub reference: PathBuf,
    /// REFERENCE contains views of the scene's first camera at the times of other frames; the last number
    /// in an image's name is the frame. Not needed for names of the form v000_t003.png
    #[arg(long)]
    pub first_camera: bool,
    /// Also evaluate held-out images from the pose fitted to each; takes about a hundred renders per image
    #[arg(long)]
    pub fit_poses: bool,
    /// Write ground truth, render and absolute error of each held-out image side by side, as PNG
    #[arg(long, value_name = "DIR")]
    pub pictures: Option<PathBuf>,
    /// Downscale the dataset's images so that their longer side has at most this many pixels
    #[arg(long, value_name = "LONGEST",
          value_parser = values::whole::<u32>(1..=values::MOST_PIXELS))]
    size: Option<u32>,
    /// Evaluate every N-th image of the dataset, as `train` holds them out; 0: all, or those of its own
    /// test split
    #[arg(long, value_name = "N", default_value_t = 0,
          value_parser = values::whole::<usize>(0..=values::MOST_PICTURES))]
    eval_every: usize,
    /// Degrees of freedom of the trajectory's alignment
    #[arg(long, value_enum, default_value = "sim3")]
    align: AlignBy,
    /// Determine the alignment from the first N poses only; 0: from all
    #[arg(long, value_name = "N", default_value_t = 0,
          value_parser = values::whole::<usize>(0..=values::MOST_PICTURES))]
    align_first: usize,
    /// Maximum difference of the time stamps of paired poses, seconds
    #[arg(long, value_name = "SECONDS", default_value_t = 0.01, alias = "max-difference",
          value_parser = values::number(0.0..=values::MOST_SECONDS))]
    max_time_diff: f64,
    /// Seconds to add to the estimate's time stamps before pairing
    #[arg(long, value_name = "SECONDS", default_value_t = 0.0, allow_negative_numbers = true,
          value_parser = values::number(-values::MOST_SECONDS..=values::MOST_SECONDS))]
    time_offset: f64,
    /// Distance between the two poses of a relative error, in --rpe-unit
    #[arg(long, value_name = "DISTANCE", default_value_t = 1.0,
          value_parser = values::number(1e-9..=1e9))]
    rpe_delta: f64,
    /// Unit of --rpe-delta: number of poses, path length, or rotation
    #[arg(long, value_enum, default_value = "frames")]
    rpe_unit: Unit,
    /// Compare all pairs of poses that are --rpe-delta apart, not only consecutive ones
    #[arg(long)]
    rpe_all_pairs: bool,
    /// With --rpe-all-pairs: tolerance of a pair's metres or degrees, as a share of --rpe-delta
    #[arg(long, value_name = "SHARE", default_value_t = 0.1, requires = "rpe_all_pairs",
          value_parser = values::number(0.0..=1.0))]
    rpe_tolerance: f64,
    /// Measure --rpe-delta's metres or degrees along the reference instead of the aligned estimate
    #[arg(long)]
    rpe_along_reference: bool,
    /// Skip Gaussians with NaN, infinite or out-of-range values
    #[arg(long)]
    drop_bad: bool,
    #[command(flatten)]
    pub lpips: LpipsArgs,
}

impl EvalArgs {
    /// Output of side-by-side comparisons of the named held-out images, if requested; `folders` are read.
    pub fn comparisons(
        &self,
        names: &[String],
        folders: &[PathBuf],
    ) -> Result<Option<Comparisons>> {
        let Some(folder) = &self.pictures else { return Ok(None) };
        let read = folders.iter().map(|read| (read.clone(), &images::EXTENSIONS[..]));
        let files = self.lpips.files().chain([self.estimate.clone()]);
        let inputs = Inputs::new(files, read);
        Comparisons::new(folder, names, &inputs).map(Some)
    }
}

#[derive(Clone, Copy, Debug, clap::ValueEnum)]
enum AlignBy {
    /// No alignment
    None,
    /// Rotation and translation, from the first pose only
    Origin,
    /// Scale only
    Scale,
    /// Rotation and translation
    Se3,
    /// Rotation, translation and scale
    Sim3,
}

#[derive(Clone, Copy, Debug, clap::ValueEnum)]
enum Unit {
    /// Poses
    Frames,
    /// Path length, in the reference's unit
    Metres,
    /// Rotation angle
    Degrees,
}

impl EvalArgs {
    /// The settings of a trajectory comparison.
    fn comparison(&self) -> Result<Comparison> {
        if matches!(self.rpe_unit, Unit::Frames) && self.rpe_delta.fract() != 0.0 {
            let delta = self.rpe_delta;
            let what = format!("--rpe-delta {delta}: frames are whole numbers; see --rpe-unit");
            return Err(Error::Input(what));
        }
        Ok(Comparison {
            align: match self.align {
                AlignBy::None => Align::None,
                AlignBy::Origin => Align::Origin,
                AlignBy::Scale => Align::Scale,
                AlignBy::Se3 => Align::Se3,
                AlignBy::Sim3 => Align::Sim3,
            },
            align_first: Some(self.align_first).filter(|first| *first > 0),
            relative: Relative {
                delta: self.rpe_delta,
                step: match self.rpe_unit {
                    Unit::Frames => Step::Frames,
                    Unit::Metres => Step::Metres,
                    Unit::Degrees => Step::Degrees,
                },
                tolerance: self.rpe_tolerance,
                all_pairs: self.rpe_all_pairs,
                along_reference: self.rpe_along_reference,
            },
        })
    }
}

/// Runs the command.
pub fn run(args: &EvalArgs, common: &Common) -> Result<Answer> {
    let reference = truth_folder(&args.reference)?;
    let mut lpips = args.lpips.open()?;
    let net = lpips.as_ref().map(|network| network.contract().net.clone());
    let found = match reference {
        Some(truth) => {
            let scene = open(args)?;
            let device = common.open_device()?;
            let shown = |names: &[String], folders: &[PathBuf]| args.comparisons(names, folders);
            let lpips = lpips.as_mut();
            let extras = Extras { fit_poses: args.fit_poses, shown: &shown, lpips };
            eval_truth::measure(&device, &scene, &truth, extras)?
        }
        None if eval_first::is_meant(args)? => {
            eval_first::measure(&open(args)?, args, lpips.as_mut(), common)?
        }
        None if args.reference.extension().is_some_and(|e| e == "npz" || e == "pkl") => {
            eval_tracks::measure(&args.estimate, &args.reference)?
        }
        None if is_trajectory(&args.reference)? => trajectories(args)?,
        None => pictures(args, lpips.as_mut(), common)?,
    };
    let mut whole: Map<String, Value> = KEYS.iter().map(|k| (k.to_string(), Value::Null)).collect();
    whole.extend(found);
    whole.insert("lpips_net".into(), json!(net));
    let json = Value::Object(whole);
    Ok(Answer { text: text(&json), json })
}

/// The folder with `transforms.json` and `held_out`: the reference itself, or its subfolder `truth`.
pub fn truth_folder(reference: &Path) -> Result<Option<PathBuf>> {
    std::fs::metadata(reference).map_err(Error::io(reference))?;
    let candidates = [reference.to_path_buf(), reference.join("truth")];
    let is_truth = |folder: &PathBuf| {
        ["transforms.json", "held_out/transforms.json"].iter().all(|f| folder.join(f).is_file())
    };
    Ok(candidates.into_iter().find(is_truth))
}

/// Whether the reference is not a dataset: a folder of `.cam` files, or a file that is not a
/// `transforms.json`.
fn is_trajectory(reference: &Path) -> Result<bool> {
    let found = std::fs::metadata(reference).map_err(Error::io(reference))?;
    if found.is_dir() {
        return Ok(!cam::list(reference)?.is_empty());
    }
    Ok(reference.extension().is_none_or(|e| e != "json"))
}

fn open(args: &EvalArgs) -> Result<Scene> {
    let Opened { scene, dropped } = Scene::open(&args.estimate, args.drop_bad)?;
    if dropped > 0 {
        say(&format!(
            "note: left out {} Gaussians that are not finite or out of range",
            thousands(dropped)
        ));
    }
    Ok(scene)
}

fn pictures(
    args: &EvalArgs,
    mut lpips: Option<&mut LpipsNetwork>,
    common: &Common,
) -> Result<Map<String, Value>> {
    let scene = open(args)?;
    let set = Dataset::open(&args.reference)?;
    notes(&set.notes);
    let (others, held) = set.split(args.eval_every);
    let chosen = if held.is_empty() { others } else { held };
    let size = args.size.map_or(Resize::Keep, Resize::Longest);
    let names: Vec<String> = chosen.iter().map(|&i| set.frames[i].name.clone()).collect();
    let folders = chosen.iter().filter_map(|&i| set.frames[i].path.parent());
    let folders: BTreeSet<PathBuf> = folders.map(Path::to_path_buf).collect();
    let comparisons = args.comparisons(&names, &Vec::from_iter(folders))?;
    let device = common.open_device()?;
    let mut renderer = Renderer::new(&device, &scene)?;
    let mut meter = Meter::new("measuring", "images", chosen.len() as u64, 0);
    let (mut per_frame, mut covisible) = (Vec::with_capacity(chosen.len()), Vec::new());
    // Frames of a video are decoded together.
    for indices in chosen.chunks(AT_A_TIME) {
        let views = set.load(indices, size)?;
        for (view, index) in views.iter().zip(indices) {
            interrupt::check()?;
            let picture = renderer.render(&view.camera, view.time)?.over(set.background);
            if let Some(comparisons) = &comparisons {
                comparisons.write(per_frame.len(), &view.image, &picture)?;
            }
            let quality = Quality::of(&view.name, &picture, &view.image, view.valid.as_ref())?;
            per_frame.push(quality.with_lpips(lpips.as_deref_mut(), &picture, &view.image)?);
            if let Some(mask) = set.frames[*index].load_covisible(size)? {
                covisible.push(seen_as_well(view, &picture, mask)?);
            }
            meter.advance();
        }
    }
    comparisons.map_or(Ok(()), Comparisons::finish)?;
    let mut keys = picture_keys(&per_frame);
    // A mean over only some of the images would follow another protocol.
    if covisible.len() == per_frame.len() {
        let mean = |figures: fn(&(f64, f64)) -> f64| {
            quality::mean(covisible.iter().map(|found| Some(figures(found))))
        };
        keys.insert("psnr_covisible".into(), json!(mean(|found| found.0)));
        keys.insert("ssim_covisible".into(), json!(mean(|found| found.1)));
    }
    Ok(keys)
}

/// PSNR and SSIM over the pixels that the training images also saw.
fn seen_as_well(view: &View, picture: &Image, mut mask: Image) -> Result<(f64, f64)> {
    if let Some(valid) = &view.valid {
        mask.pixels.iter_mut().zip(&valid.pixels).for_each(|(seen, valid)| *seen *= valid);
    }
    let similarity = ssim_map(picture, &view.image)?;
    Ok((masked_psnr(picture, &view.image, &mask)?, masked_mean(&similarity, &mask)?))
}

/// The keys about images.
pub fn picture_keys(per_frame: &[Quality]) -> Map<String, Value> {
    let rows: Vec<Value> = per_frame.iter().map(Quality::json).collect();
    Map::from_iter([
        ("psnr".into(), json!(quality::mean(per_frame.iter().map(|q| Some(q.psnr))))),
        ("ssim".into(), json!(quality::mean(per_frame.iter().map(|q| Some(q.ssim))))),
        ("ms_ssim".into(), json!(quality::mean(per_frame.iter().map(|q| q.ms_ssim)))),
        ("lpips".into(), json!(quality::mean(per_frame.iter().map(|q| q.lpips)))),
        ("per_frame".into(), json!(rows)),
    ])
}

fn trajectories(args: &EvalArgs) -> Result<Map<String, Value>> {
    let how = args.comparison()?;
    // The reference determines what is measured, so it is checked first.
    let reference = trajectory::open(&args.reference, None).map_err(|error| match error {
        Error::Format { path, what } => {
            let hint = "a reference is a dataset, a clip's truth folder or a trajectory (TUM, KITTI, \
                        EuRoC, .cam); a video or image has no known cameras to compare with";
            Error::Format { path, what: format!("{what}; {hint}") }
        }
        other => other,
    })?;
    let estimate = trajectory::open(&args.estimate, None)?;
    for (path, found) in [(&args.estimate, &estimate), (&args.reference, &reference)] {
        if found.format != Format::Euroc && found.order == Some(QuaternionOrder::Wxyz) {
            let path = path.display();
            say(&format!("note: the quaternions of {path} are read as (w, x, y, z)"));
        }
    }
    let pairs = pair(args, &estimate, &reference)?;
    let unpaired = estimate.times.len() - pairs.len().min(estimate.times.len());
    if unpaired > 0 {
        let all = estimate.times.len();
        say(&format!("note: {unpaired} of {all} poses have no counterpart"));
    }
    let ours: Vec<_> = pairs.iter().map(|pair| estimate.world_from_view[pair.0]).collect();
    let theirs: Vec<_> = pairs.iter().map(|pair| reference.world_from_view[pair.1]).collect();
    let errors = compare_matrices(&ours, &theirs, &how)?;
    if errors.rpe_pairs == 0 {
        say("note: no two poses lie --rpe-delta apart; there is no relative error");
    }
    Ok(trajectory_keys(&errors))
}

/// Pairs poses: in order where neither trajectory has time stamps, or only one and both have the same
/// length; else by time, with indices in a file as times.
fn pair(
    args: &EvalArgs,
    estimate: &Trajectory,
    reference: &Trajectory,
) -> Result<Vec<(usize, usize)>> {
    let (ours, theirs) = (estimate.times.len(), reference.times.len());
    let timed = [estimate, reference].map(Trajectory::is_timed);
    if timed == [false; 2] || timed != [true; 2] && ours == theirs {
        if ours != theirs {
            say(&format!(
                "note: neither trajectory has timestamps; of {ours} and {theirs} poses the first {} \
                 are paired in order",
                ours.min(theirs)
            ));
        }
        return Ok((0..ours.min(theirs)).map(|i| (i, i)).collect());
    }
    let pairs =
        nearest_by_time(&estimate.times, &reference.times, args.max_time_diff, args.time_offset);
    if pairs.is_empty() {
        let places = match timed {
            [true, true] => "",
            _ => {
                " (poses of a format without timestamps count from 0, and there are not as many of both)"
            }
        };
        return Err(Error::Input(format!(
            "no timestamp of {} lies within {} s of one of {}{places}; --max-time-diff widens that, \
             --time-offset shifts the estimate",
            args.estimate.display(),
            args.max_time_diff,
            args.reference.display()
        )));
    }
    Ok(pairs)
}

/// The keys about trajectories. For a static camera, relative errors are undefined: its path has no length
/// and no motion.
pub fn trajectory_keys(errors: &TrajectoryErrors) -> Map<String, Value> {
    let moving = |value: f64| (errors.path_length > 0.0 && errors.rpe_pairs > 0).then_some(value);
    let relative = |found: &Statistics| (errors.rpe_pairs > 0).then(|| statistics(found));
    Map::from_iter([
        ("ate_rmse".into(), json!(errors.ate.rmse)),
        ("ate_relative".into(), json!((errors.path_length > 0.0).then_some(errors.ate_relative))),
        ("rpe_trans_rmse".into(), json!(moving(errors.rpe_trans.rmse))),
        ("rpe_rot_deg_rmse".into(), json!(moving(errors.rpe_rot_deg.rmse))),
        ("ape_trans".into(), statistics(&errors.ate)),
        ("ape_rot_deg".into(), statistics(&errors.ate_rot_deg)),
        ("rpe_trans".into(), json!(relative(&errors.rpe_trans))),
        ("rpe_rot_deg".into(), json!(relative(&errors.rpe_rot_deg))),
        ("rpe_pairs".into(), json!(errors.rpe_pairs)),
        ("scale".into(), json!(errors.reference_from_estimate.scale)),
        ("poses".into(), json!(errors.poses)),
    ])
}

/// Names of the values that [`statistics`] gives for a list of errors.
const STATISTICS: [&str; 7] = ["rmse", "mean", "median", "std", "min", "max", "sse"];

fn statistics(of: &Statistics) -> Value {
    let values = [of.rmse, of.mean, of.median, of.std, of.min, of.max, of.sse];
    STATISTICS.iter().zip(values).map(|(name, value)| (name.to_string(), json!(value))).collect()
}

/// The statistics of a trajectory as a table; empty where there are none.
fn statistics_table(found: &Value) -> String {
    let mut table = String::new();
    for key in ["ape_trans", "ape_rot_deg", "rpe_trans", "rpe_rot_deg"] {
        let Some(row) = found[key].as_object() else { continue };
        if table.is_empty() {
            let names: String = STATISTICS.iter().map(|name| format!(" {name:>12}")).collect();
            let _ = writeln!(table, "{:18}{names}", "");
        }
        let value = |name: &&str| row[*name].as_f64().unwrap_or(f64::NAN);
        let values: String =
            STATISTICS.iter().map(|name| format!(" {:12.6}", value(name))).collect();
        let _ = writeln!(table, "{key:18}{values}");
    }
    table
}

fn text(found: &Value) -> String {
    let mut text = String::new();
    for key in KEYS {
        match &found[key] {
            Value::Number(whole) if whole.is_u64() => {
                let _ = writeln!(text, "{key:18} {whole}");
            }
            Value::Number(value) => {
                let _ = writeln!(text, "{key:18} {:.6}", value.as_f64().unwrap_or(f64::NAN));
            }
            Value::String(value) => {
                let _ = writeln!(text, "{key:18} {value}");
            }
            _ => {}
        }
    }
    text += &statistics_table(found);
    text += &eval_tracks::table(&found["tracks"]);
    let table = held_out::table(found);
    if !table.is_empty() {
        return text + &table;
    }
    for row in found["per_frame"].as_array().into_iter().flatten() {
        let name = row["name"].as_str().unwrap_or_default();
        // JSON has no infinity, which is the PSNR of equal images.
        let psnr = row["psnr"].as_f64().unwrap_or(f64::INFINITY);
        let ssim = row["ssim"].as_f64().unwrap_or(f64::NAN);
        let _ = writeln!(text, "  {name:24} {psnr:7.3} dB  SSIM {ssim:.4}");
    }
    text
}
