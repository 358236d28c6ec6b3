//! `splat4d track`: estimates cameras, motion masks, depth and point tracks of a clip, for other programs.

use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};

use clap::Args;
use glam::DVec2;
use rayon::prelude::*;
use serde_json::{Value, json};
use splat4d::data::transforms::{self, TimedCamera};
use splat4d::data::{Point, exr, points, tracks, write_mask, write_png};
use splat4d::observe::{FeatureSource, MaskSource};
use splat4d::track::{Landmark, Sources, Track, track_observed};
use splat4d::train::Quality;
use splat4d::types::{Camera, Image, Pose, Tracks};
use splat4d::{Error, Result, io};

use super::clip::{ClipArgs, shots_json};
use super::clock::Clock;
use super::common::{Answer, Common, notes, path_text, say};
use super::interrupt;
use super::known::{KnownArgs, flow_source, intrinsics_json, lens_json, poses_json, write_cameras};
use super::networks::{TrackNetworks, estimate_depth, estimate_pointmaps};
use super::origins::{self, Networks};
use super::outputs::Outputs;
use super::track_model;
use super::track_page::Page;
use super::track_pictures::Watched;
use super::tracker::Tracker;

const AFTER_HELP: &str = "\
DIR gets, whole or not at all:
  images/0000.png …     the frames as they were tracked, without their lens's distortion; all else is of
                        these
  poses.txt             TUM, camera to world; the time is the frame's index
  intrinsics.json       pixels
  transforms.json       the frames with their cameras and times in [0, 1], for nerfstudio and its kin
  sparse/0/*.bin        a COLMAP model: cameras, images, and the points that were triangulated with where
                        each frame saw them; for 3DGS, gsplat, nerfstudio and COLMAP, as DIR itself
  points.ply            static points
  masks/0000.png …      white where something moves
  depth/0000.exr …      z, in the unit of --poses, else of the static points' median depth
  tracks.npz            tracks (points × frames × 2: x, y), visibles (points × frames), query_points
                        (points × 3: frame, y, x), size; pixels, the image's corner at 0
  report.html           a page: the camera's path, what moves, residual flow, how well each frame is known
  report.json           what --json prints

Points are followed through all frames, behind others and outside of the image too: what stands still by
cameras and depth, what moves by the surface that was found for it. --queries takes those of a file
like tracks.npz; else they lie on a grid in the first, the middle and the last frame.

Of a clip with cuts one shot is taken, the longest unless --shot says another; --every and
--max-frames count within it.

Examples:
  splat4d track video.mp4 -o tracked
  splat4d track clip/frames -o tracked --queries clip/truth/tracks.npz
  splat4d eval tracked/tracks.npz clip/truth/tracks.npz

JSON: frames, frame_names, shot (the one taken, or null), shots ([first, last] frame of each, in the whole
clip; empty where no cut was found), intrinsics {fx, fy, cx, cy, width, height, source (given, measured,
assumed)}, lens (by which the frames were undistorted: {k1, fx, fy, cx, cy, width, height}; null of a
pinhole), poses {tripod, turns, inlier_share, reprojection_rms, parallax_deg, focal_std, doubtful_frames,
tracks, motions (that the static world was chosen from, where that was in doubt: [{explained, hidden,
hides}]), static_motion (the one taken, or null)}, exposure (per frame, by what red, green and blue were
multiplied, 0.055 added to the encoded values; null where it does not change), sources (of cameras, flow,
depth, masks, pointmaps, features and tracks: {source (built_in, network, supplied, none), from (the network's
file or the option), how}), per_frame [{observations (of static points), inliers (that agree), rms (of those,
pixels), rotation_std_deg, position_std (unit of the poses; both from the first frame, null of a fixed camera,
of given poses and where nothing tells)}], dynamic_share (of the pixels), movers (objects), points, landmarks
(points triangulated), tracks, notes, device, seconds {load, flow, cameras, masks, depth, page}, output";

/// Contents of the output folder.
const CONTENTS: [&str; 11] = [
    "images",
    "masks",
    "depth",
    "sparse",
    "poses.txt",
    "intrinsics.json",
    "transforms.json",
    "points.ply",
    "tracks.npz",
    "report.html",
    "report.json",
];
/// Number of grid points along a frame's longer side.
const GRID: f64 = 48.0;

/// Estimate cameras, masks, depth and point tracks of a video
#[derive(Args)]
#[command(after_help = AFTER_HELP)]
pub struct TrackArgs {
    /// A video file, or a folder of its frames
    #[arg(value_name = "VIDEO|DIR")]
    clip: PathBuf,
    /// The output folder, which must be new or empty
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    #[command(flatten)]
    frames: ClipArgs,
    #[command(flatten)]
    known: KnownArgs,
    /// Track the points of this .npz: its query_points, or the first positions of its tracks
    #[arg(long, value_name = "FILE")]
    queries: Option<PathBuf>,
}

/// Runs the command.
pub fn run(args: &TrackArgs, common: &Common) -> Result<Answer> {
    io::check_new_folder(&args.output)?;
    let outputs = Outputs::default().folder(&args.output, &CONTENTS)?;
    outputs.spare(&args.known.inputs(&args.clip))?;
    args.known.check(&args.frames)?;
    let mut clock = Clock::start();
    std::fs::metadata(&args.clip).map_err(Error::io(&args.clip))?;
    let mut models = args.known.networks.open()?;
    let device = common.open_device()?;
    let preset = Quality::Standard.preset(device.info().kind);
    let for_each = args.known.is_for_each_frame() || args.queries.is_some();
    let clip = args.frames.open(&args.clip, args.known.size(preset.longest_side), for_each)?;
    let mut options = args.known.options(&clip, common.seed)?;
    let flow = args.known.flow(&clip)?;
    let queries = args.queries.as_deref().map(|file| queries(file, &clip)).transpose()?;
    let times: Vec<f64> = clip.frames.iter().map(|frame| frame.time).collect();
    let names: Vec<String> = clip.frames.iter().map(|frame| frame.name.clone()).collect();
    let mut all_notes = clip.notes;
    let frames: Vec<Image> = clip.frames.into_iter().map(|frame| frame.image).collect();
    say(&format!("{} frames of {}×{}", frames.len(), clip.width, clip.height));
    clock.lap("load");

    let opened = Networks::of(models.as_ref());
    estimate_depth(&mut models, &frames, &mut options)?;
    let of_pointmaps = estimate_pointmaps(&mut models, &frames, &mut options)?;
    let mut tracker = Tracker::new(&mut clock, None);
    let networks = TrackNetworks::of(&mut models);
    let source = flow_source(&device, &frames, flow, networks.flow)?;
    let mut flow = Watched::new(source, frames.len());
    let sources = Sources {
        flow: &mut flow,
        masks: networks.masks.map(|network| network as &mut dyn MaskSource),
        features: networks.features.map(|network| network as &mut dyn FeatureSource),
    };
    let mut track = track_observed(&frames, &options, sources, &mut tracker)?;
    track.quality.notes.extend(of_pointmaps);
    tracker.finish();
    let found = &track.quality;
    notes(&found.notes);
    all_notes.extend_from_slice(&found.notes);
    let frames = track.undistorted(&frames);
    let queries = match queries {
        Some(asked) => undistorted(asked, &track),
        None => grid(frames.len(), (clip.width, clip.height)),
    };
    let followed = track.follow(&queries);
    let landmarks = track.landmarks();
    let poses: Vec<Pose> =
        track.view_from_world.iter().map(|pose| scaled(pose, track.unit)).collect();
    let origins = origins::of(args.known.given(), &opened, &found.told);
    let page = Page {
        clip: &args.clip.display().to_string(),
        names: &names,
        frames: &frames,
        track: &track,
        poses: &poses,
        supplied: options.poses.is_some(),
        landmarks: landmarks.len(),
        flow: &flow.kept,
        origins: &origins,
        notes: &all_notes,
    }
    .html()?;
    clock.lap("page");

    let mut json = json!({
        "frames": frames.len(),
        "frame_names": names,
        "shot": clip.shot,
        "shots": shots_json(&clip.shots),
        "intrinsics": intrinsics_json(&track),
        "lens": lens_json(track.lens.as_ref()),
        "poses": poses_json(found),
        "exposure": (!track.exposure.is_constant()).then_some(&track.exposure.gains),
        "sources": origins::to_json(&origins),
        "per_frame": found.per_frame,
        "dynamic_share": found.dynamic_share,
        "movers": track.movers.len(),
        "points": track.points.len(),
        "landmarks": landmarks.len(),
        "tracks": followed.points.len(),
        "notes": all_notes,
        "device": device.info().name,
        "seconds": clock.json(),
    });
    json["output"] = path_text(&args.output);
    io::write_folder(&args.output, &CONTENTS, |folder| {
        write(folder, &frames, &times, &poses, &track, &followed, &landmarks)?;
        let to = folder.join("report.html");
        io::write_atomically(to, |sink| sink.write_all(page.as_bytes()))?;
        io::write_json(folder.join("report.json"), &json)
    })?;
    Ok(Answer { text: text(&json, &clock), json })
}

/// The query points of a file, at the size of the frames.
fn queries(file: &Path, clip: &splat4d::data::Clip) -> Result<Vec<(usize, DVec2)>> {
    let asked = super::supplied::tracks(file, clip)?;
    let size = DVec2::new(clip.width.into(), clip.height.into());
    let inside = |at: DVec2| at.cmpge(DVec2::ZERO).all() && at.cmplt(size).all();
    match asked.points.iter().position(|point| !inside(point.query.1)) {
        Some(i) => {
            let (frame, at) = asked.points[i].query;
            let what = format!("point {i} is asked for at {at} of frame {frame}, outside of it");
            Err(Error::format(file, what))
        }
        None => Ok(asked.points.iter().map(|point| point.query).collect()),
    }
}

/// Maps points of the clip's frames to the undistorted frames.
fn undistorted(mut asked: Vec<(usize, DVec2)>, track: &Track) -> Vec<(usize, DVec2)> {
    if let Some(lens) = &track.lens {
        let k = &track.intrinsics;
        let size = DVec2::new(k.width.into(), k.height.into());
        for (_, pixel) in &mut asked {
            // A point outside of the undistorted frame is tracked from its border.
            *pixel =
                lens.undistort_pixel(k, *pixel).unwrap_or(*pixel).clamp(DVec2::ZERO, size - 1e-3);
        }
    }
    asked
}

/// Points on a grid in the first, the middle and the last frame.
fn grid(frames: usize, (width, height): (u32, u32)) -> Vec<(usize, DVec2)> {
    let spacing = (f64::from(width.max(height)) / GRID).max(1.0);
    let along = |size: u32| {
        let count = (f64::from(size) / spacing) as usize;
        (0..count.max(1)).map(move |i| ((i as f64 + 0.5) * spacing).min(f64::from(size) - 0.5))
    };
    let mut chosen = vec![0, frames / 2, frames - 1];
    chosen.dedup();
    let frame = |frame: usize| {
        along(height).flat_map(move |y| along(width).map(move |x| (frame, DVec2::new(x, y))))
    };
    chosen.into_iter().flat_map(frame).collect()
}

/// Writes all outputs except the report.
fn write(
    folder: &Path,
    frames: &[Image],
    times: &[f64],
    poses: &[Pose],
    track: &Track,
    followed: &Tracks,
    landmarks: &[Landmark],
) -> Result<()> {
    let series = |name: &str, one: &(dyn Fn(&Path, usize) -> Result<()> + Sync)| {
        let to = folder.join(name);
        fs::create_dir_all(&to).map_err(Error::io(&to))?;
        (0..frames.len()).into_par_iter().try_for_each(|i| {
            interrupt::check()?;
            one(&to.join(format!("{i:04}")), i)
        })
    };
    series("images", &|to, i| write_png(to.with_extension("png"), &frames[i]))?;
    series("masks", &|to, i| write_mask(to.with_extension("png"), &track.masks[i]))?;
    series("depth", &|to, i| {
        let mut depth = track.depth[i].clone();
        depth.pixels.iter_mut().for_each(|z| *z *= track.unit as f32);
        exr::write_depth(to.with_extension("exr"), &depth)
    })?;
    let camera = |(time, pose): (&f64, &Pose)| {
        let camera = Camera { intrinsics: track.intrinsics, view_from_world: *pose };
        TimedCamera { time: *time, camera }
    };
    let cameras: Vec<TimedCamera> = times.iter().zip(poses).map(camera).collect();
    write_cameras(folder, cameras.iter().map(|at| at.camera))?;
    let names: Vec<String> = (0..frames.len()).map(|i| format!("{i:04}.png")).collect();
    track_model::write(&folder.join("sparse/0"), &names, frames, poses, track, landmarks)?;
    let files: Vec<String> = names.iter().map(|name| format!("images/{name}")).collect();
    transforms::write(folder.join("transforms.json"), &cameras, &files, Some("points.ply"))?;
    let cloud: Vec<Point> = track
        .points
        .iter()
        .map(|p| Point {
            position: (track.unit * p.position).as_vec3().to_array(),
            colour: p.colour,
        })
        .collect();
    points::write_ply(folder.join("points.ply"), &cloud)?;
    tracks::write(folder.join("tracks.npz"), followed)
}

/// A pose in another unit, with `unit` of them per world unit.
fn scaled(view_from_world: &Pose, unit: f64) -> Pose {
    Pose { translation: unit * view_from_world.translation, ..*view_from_world }
}

fn text(report: &Value, clock: &Clock) -> String {
    format!(
        "output          {}\nfocal length    {:.1} px ({})\n\
         poses           {:.0} % of {} tracks agree within {:.2} px rms, parallax {:.1}°\n\
         moving pixels   {:.1} %, {} objects\npoints          {} static, {} followed\n\
         time            {}\n",
        report["output"].as_str().unwrap_or_default(),
        report["intrinsics"]["fx"].as_f64().unwrap_or(f64::NAN),
        report["intrinsics"]["source"].as_str().unwrap_or_default(),
        100.0 * report["poses"]["inlier_share"].as_f64().unwrap_or(f64::NAN),
        report["poses"]["tracks"],
        report["poses"]["reprojection_rms"].as_f64().unwrap_or(f64::NAN),
        report["poses"]["parallax_deg"].as_f64().unwrap_or(f64::NAN),
        100.0 * report["dynamic_share"].as_f64().unwrap_or(f64::NAN),
        report["movers"],
        report["points"],
        report["tracks"],
        clock.line(),
    )
}
