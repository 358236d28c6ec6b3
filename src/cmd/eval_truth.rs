//! Evaluates a scene against the ground truth of a clip.
//!
//! The scene's own cameras are aligned to the true ones by a similarity. It maps the held-out cameras into
//! the scene's frame, where they are rendered, and converts the scene's depth to metres. A static camera
//! does not determine the similarity's scale; depth does, or else the held-out images
//! ([`eval_scale`](super::eval_scale)). Depth, motion masks and the regions of the held-out images are
//! evaluated where the folder has them. The held-out cameras keep their true focal length. In addition,
//! marked as such, results are given with the scene's own focal length: a scene that was reconstructed with
//! too long a focal length is stretched in depth, and looks right only with that focal length.

use std::path::{Path, PathBuf};

use glam::DVec3;
use serde_json::{Map, Value, json};
use splat4d::data::transforms::{self, TimedCamera};
use splat4d::data::{Dataset, Frame, Resize, exr, read_mask};
use splat4d::eval::{Align, compare_trajectories, depth_relative_median, mask_iou, match_by_time};
use splat4d::geometry::sim3::{Shape, Sim3, align_cameras};
use splat4d::gpu::Device;
use splat4d::observe::onnx::LpipsNetwork;
use splat4d::renderer::Renderer;
use splat4d::scene::{Scene, SceneCamera};
use splat4d::types::{Camera, Image, Pose};
use splat4d::{Error, Result};

use super::eval::{picture_keys, trajectory_keys};
use super::eval_scale::{Sight, by_pictures};
use super::held_out::{self, Comparisons, Judge, Shot, eight_bits};
use super::interrupt;
use super::meter::Meter;
use super::quality::{Quality, motion_only};

/// A camera of the scene and the true one of the same frame.
struct Pair<'a> {
    ours: &'a SceneCamera,
    truth: TimedCamera,
    /// Frame number in the clip.
    frame: usize,
}

/// Output of side-by-side comparisons of the named held-out images, if requested; some folders are read.
pub type Shown<'a> = &'a dyn Fn(&[String], &[PathBuf]) -> Result<Option<Comparisons>>;

/// Additional evaluations.
pub struct Extras<'a> {
    /// Also evaluate held-out images from poses fitted to them.
    pub fit_poses: bool,
    /// Output of the side-by-side comparisons.
    pub shown: Shown<'a>,
    /// Network for LPIPS.
    pub lpips: Option<&'a mut LpipsNetwork>,
}

/// Evaluates everything for which there is ground truth.
pub fn measure(
    device: &Device,
    scene: &Scene,
    truth: &Path,
    extras: Extras<'_>,
) -> Result<Map<String, Value>> {
    let set = Dataset::open(truth.join("held_out/transforms.json"))?;
    let names: Vec<String> = set.frames.iter().map(|frame| frame.name.clone()).collect();
    let comparisons = (extras.shown)(&names, &read_folders(truth, &set))?;
    let cameras = transforms::read_cameras(&truth.join("transforms.json"))?;
    let pairs = pair(scene, &cameras)?;
    let poses = |of: &dyn Fn(&Pair) -> Camera| -> Vec<Pose> {
        pairs.iter().map(|pair| of(pair).view_from_world.inverse()).collect()
    };
    let (ours, theirs) = (poses(&|p| p.ours.camera), poses(&|p| p.truth.camera));
    let mut found = trajectory_keys(&compare_trajectories(&ours, &theirs, Align::Sim3)?);

    let looks = look(device, scene, &pairs, truth)?;
    let mut renderer = Renderer::new(device, scene)?;
    let held_out = HeldOut { set, folder: truth.join("held_out"), pairs: &pairs };
    let alignment = align_cameras(&ours, &theirs, true)?;
    let mut truth_from_scene = alignment.reference_from_estimate;
    let mut scale_by = Some("centres");
    if alignment.shape == Shape::Point {
        // The pose of a static camera does not determine the scale; its depth does.
        let middles = [middle(&ours), middle(&theirs)];
        let scaled = |scale: f64| scaled(truth_from_scene, scale, middles);
        let found = match scale_of_depth(&looks) {
            Some(scale) => Some((scale, "depth")),
            None => {
                let sights = held_out.sights(middles[1])?;
                by_pictures(&mut renderer, scene, &sights, &scaled)?.map(|s| (s, "pictures"))
            }
        };
        truth_from_scene = scaled(found.map_or(truth_from_scene.scale, |(scale, _)| scale));
        scale_by = found.map(|(_, by)| by);
    }
    let focal = |c: &Camera| c.intrinsics.fx / f64::from(c.intrinsics.width);
    let relative = pairs.iter().map(|p| focal(&p.ours.camera) / focal(&p.truth.camera));
    let focal_ratio = relative.sum::<f64>() / pairs.len() as f64;
    let depth = match &looks.depth {
        Some((ours, truth)) => depth_relative_median(ours, truth, truth_from_scene.scale)?,
        None => None,
    };
    let masks = looks.masks.as_ref();
    let iou = masks.map(|(ours, truth)| mask_iou(ours, truth)).transpose()?;
    found.extend([
        ("focal_error".to_string(), json!((focal_ratio - 1.0).abs())),
        ("depth_rel_median".to_string(), json!(depth)),
        ("mask_iou".to_string(), json!(iou)),
        ("scale".to_string(), json!(truth_from_scene.scale)),
        ("scale_by".to_string(), json!(scale_by)),
    ]);

    let mut judge = Judge {
        renderer: &mut renderer,
        background: scene.background,
        fit: extras.fit_poses,
        comparisons: comparisons.as_ref(),
        lpips: extras.lpips,
    };
    found.extend(held_out.judged(&mut judge, &truth_from_scene.inverse(), focal_ratio)?);
    comparisons.map_or(Ok(()), Comparisons::finish)?;
    Ok(found)
}

/// The folders of the images and masks that are read.
fn read_folders(truth: &Path, set: &Dataset) -> Vec<PathBuf> {
    let held_out = truth.join("held_out");
    let mut folders = vec![truth.join("masks")];
    for frame in &set.frames {
        let Some(folder) = frame.path.parent() else { continue };
        let below = folder.strip_prefix(&held_out).unwrap_or(folder);
        let kinds = ["masks", "covisible"].map(|kind| held_out.join(kind).join(below));
        folders.extend([folder.to_path_buf()].into_iter().chain(kinds));
    }
    folders.sort();
    folders.dedup();
    folders
}

/// Pairs the scene's cameras with the clip's frames: by the frame numbers in the scene's report, else in
/// order where there are equally many, else by time.
fn pair<'a>(scene: &'a Scene, truth: &[TimedCamera]) -> Result<Vec<Pair<'a>>> {
    let ours = &scene.cameras;
    let listed: Option<Vec<usize>> = scene.report["frame_names"].as_array().and_then(|names| {
        names.iter().map(|name| name.as_str()?.parse().ok().filter(|i| *i < truth.len())).collect()
    });
    let indices: Vec<(usize, usize)> = match listed {
        Some(frames) if frames.len() == ours.len() => frames.into_iter().enumerate().collect(),
        _ if ours.len() == truth.len() => (0..ours.len()).map(|i| (i, i)).collect(),
        _ => {
            let half_a_frame = 0.5 / truth.len().saturating_sub(1).max(1) as f64;
            let scene_times: Vec<f64> = ours.iter().map(|c| c.time).collect();
            let true_times: Vec<f64> = truth.iter().map(|c| c.time).collect();
            match_by_time(&scene_times, &true_times, half_a_frame)
        }
    };
    if indices.is_empty() {
        return Err(Error::Input(
            "the scene knows no input cameras that could be held against the truth's poses".into(),
        ));
    }
    Ok(indices
        .into_iter()
        .map(|(i, frame)| Pair { ours: &ours[i], truth: truth[frame], frame })
        .collect())
}

/// The scene's renders from its own cameras and the corresponding ground truth, with all frames stacked
/// vertically; `None` where there is no ground truth.
struct Looks {
    depth: Option<(Image, Image)>,
    masks: Option<(Image, Image)>,
}

fn look(device: &Device, scene: &Scene, pairs: &[Pair], truth: &Path) -> Result<Looks> {
    let mut renderer = Renderer::new(device, scene)?;
    let moving = if scene.gaussians.is_dynamic() { Some(motion_only(scene)) } else { None };
    let mut motion = moving.as_ref().map(|moving| Renderer::new(device, moving)).transpose()?;
    let [depth_folder, mask_folder] = ["depth", "masks"].map(|name| truth.join(name));
    let (has_depth, has_masks) = (depth_folder.is_dir(), mask_folder.is_dir());
    let mut meter = Meter::new("depth and masks", "frames", pairs.len() as u64, 0);
    let (mut depth, mut true_depth) = (Vec::new(), Vec::new());
    let (mut mask, mut true_mask) = (Vec::new(), Vec::new());
    for Pair { ours, truth: camera, frame } in pairs {
        interrupt::check()?;
        let k = &camera.camera.intrinsics;
        let intrinsics = ours.camera.intrinsics.fitted(k.width, k.height);
        let seen_by = Camera { intrinsics, ..ours.camera };
        if has_depth {
            depth.push(renderer.render(&seen_by, ours.time)?.mean_depth());
            true_depth.push(exr::read_depth(depth_folder.join(format!("{frame:04}.exr")))?);
        }
        if has_masks {
            mask.push(match &mut motion {
                Some(motion) => first_channel(&motion.render(&seen_by, ours.time)?.rgba),
                None => Image::new(k.width, k.height, 1),
            });
            true_mask.push(read_mask(mask_folder.join(format!("{frame:04}.png")))?);
        }
        meter.advance();
    }
    let both = |there: bool, ours: &[Image], truth: &[Image]| {
        if there { Ok(Some((stack(ours)?, stack(truth)?))) } else { Ok(None) }
    };
    Ok(Looks {
        depth: both(has_depth, &depth, &true_depth)?,
        masks: both(has_masks, &mask, &true_mask)?,
    })
}

fn first_channel(image: &Image) -> Image {
    let pixels = image.pixels.iter().step_by(image.channels as usize).copied().collect();
    Image { pixels, channels: 1, ..*image }
}

/// Stacks one-channel images of the same width vertically.
fn stack(images: &[Image]) -> Result<Image> {
    let width = images[0].width;
    if let Some(odd) = images.iter().find(|i| (i.width, i.channels) != (width, 1)) {
        return Err(Error::Input(format!(
            "the truth's images differ in size: one is {} wide, another {width}",
            odd.width
        )));
    }
    let height = images.iter().map(|image| image.height).sum();
    let pixels = images.iter().flat_map(|image| image.pixels.iter().copied()).collect();
    Ok(Image { width, height, channels: 1, pixels })
}

/// Scale that converts the scene's depths to the true ones: the median ratio over all pixels; `None` where
/// depth is unknown.
fn scale_of_depth(looks: &Looks) -> Option<f64> {
    let good = |d: f32| d.is_finite() && d > 0.0;
    let (depth, true_depth) = looks.depth.as_ref()?;
    let pixels = depth.pixels.iter().zip(&true_depth.pixels);
    let mut ratios: Vec<f64> = pixels
        .filter(|(ours, truth)| good(**ours) && good(**truth))
        .map(|(ours, truth)| f64::from(*truth) / f64::from(*ours))
        .collect();
    let middle = ratios.len() / 2;
    (!ratios.is_empty()).then(|| *ratios.select_nth_unstable_by(middle, f64::total_cmp).1)
}

/// The centre of a camera's path.
fn middle(poses: &[Pose]) -> DVec3 {
    poses.iter().map(|pose| pose.translation).sum::<DVec3>() / poses.len() as f64
}

/// An alignment with another scale; the centres of both paths, ours and the true one, stay aligned.
fn scaled(sim: Sim3, scale: f64, [ours, theirs]: [DVec3; 2]) -> Sim3 {
    Sim3 { scale, translation: theirs - scale * (sim.rotation * ours), ..sim }
}

/// The held-out images of a clip.
struct HeldOut<'a> {
    set: Dataset,
    folder: PathBuf,
    pairs: &'a [Pair<'a>],
}

impl HeldOut<'_> {
    /// The keys about them: with the true focal length, and with one longer by `focal_ratio`.
    fn judged(
        &self,
        judge: &mut Judge,
        scene_from_truth: &Sim3,
        focal_ratio: f64,
    ) -> Result<Map<String, Value>> {
        let mut meter = Meter::new("novel views", "images", self.set.frames.len() as u64, 0);
        let (mut judged, mut own_focal) = (Vec::new(), Vec::new());
        for (index, frame) in self.set.frames.iter().enumerate() {
            interrupt::check()?;
            meter.advance();
            // The scene may cover only part of the clip; times outside of it are skipped.
            let Some(time) = scene_time(self.pairs, frame.time) else { continue };
            let shot = self.shot(frame, time, scene_from_truth)?;
            judged.push(judge.judge(index, &shot)?);
            let mut camera = shot.camera;
            camera.intrinsics.fx *= focal_ratio;
            camera.intrinsics.fy *= focal_ratio;
            let picture = judge.renderer.render(&camera, time)?.over(judge.background);
            own_focal.push(Quality::of(&shot.name, &eight_bits(picture), &shot.truth, None)?);
        }
        let mut found = held_out::keys(&judged);
        let own_focal = picture_keys(&own_focal);
        found.extend(
            ["psnr", "ssim", "ms_ssim"]
                .map(|key| (format!("{key}_own_focal"), own_focal[key].clone())),
        );
        Ok(found)
    }

    /// An even selection of the images, as [`by_pictures`] compares them.
    fn sights(&self, true_middle: DVec3) -> Result<Vec<Sight>> {
        let known: Vec<(&Frame, f64)> = self
            .set
            .frames
            .iter()
            .filter_map(|frame| Some((frame, scene_time(self.pairs, frame.time)?)))
            .collect();
        let count = known.len().min(Sight::MOST);
        let chosen = (0..count).map(|k| known[k * known.len() / count]);
        let sight = |(frame, time): (&Frame, f64)| {
            interrupt::check()?;
            let view = frame.load(self.set.background, Sight::SIZE)?;
            let centre = view.camera.view_from_world.inverse().translation;
            Ok(Sight { aside: (centre - true_middle).length(), time, view })
        };
        chosen.map(sight).collect()
    }

    fn shot(&self, frame: &Frame, time: f64, scene_from_truth: &Sim3) -> Result<Shot> {
        let view = frame.load(self.set.background, Resize::Keep)?;
        // The path "K/0000.png" in the folder belongs to camera K.
        let below = frame.path.strip_prefix(&self.folder).unwrap_or(&frame.path);
        let distance = below.parent().map_or(String::new(), |p| p.display().to_string());
        let mask = |kind: &str| -> Result<Option<Image>> {
            let file = self.folder.join(kind).join(below).with_extension("png");
            if !file.is_file() {
                return Ok(None);
            }
            let mask = read_mask(&file)?;
            let (width, height) = (view.image.width, view.image.height);
            if (mask.width, mask.height) != (width, height) {
                let what = format!(
                    "is {}×{}, its image {width}×{height}; give masks of the images' size",
                    mask.width, mask.height
                );
                return Err(Error::format(file, what));
            }
            Ok(Some(mask))
        };
        let world_from_view = scene_from_truth.apply_pose(&view.camera.view_from_world.inverse());
        Ok(Shot {
            name: view.name,
            distance,
            camera: Camera { view_from_world: world_from_view.inverse(), ..view.camera },
            time,
            movers: mask("masks")?,
            covisible: mask("covisible")?,
            truth: view.image,
        })
    }
}

/// The scene's time at a time of the clip, interpolated between the paired frames; `None` outside.
fn scene_time(pairs: &[Pair], time: f64) -> Option<f64> {
    const SLACK: f64 = 1e-6;
    let mut known: Vec<(f64, f64)> = pairs.iter().map(|p| (p.truth.time, p.ours.time)).collect();
    known.sort_by(|a, b| a.0.total_cmp(&b.0));
    let (first, last) = (known.first()?, known.last()?);
    if time < first.0 - SLACK || time > last.0 + SLACK {
        return None;
    }
    let after = known.partition_point(|k| k.0 < time).clamp(1, known.len().max(2) - 1);
    let a = known[after - 1];
    let b = known.get(after).copied().unwrap_or(a);
    let share = if b.0 > a.0 { ((time - a.0) / (b.0 - a.0)).clamp(0.0, 1.0) } else { 0.0 };
    Some(a.1 + share * (b.1 - a.1))
}
