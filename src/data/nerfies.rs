//! The dataset layout of Nerfies, HyperNeRF and DyCheck's iPhone captures.
//!
//! | file | what |
//! |---|---|
//! | `scene.json` | `scale`, `center` (world), `near`, `far` (scaled): X′ = (X − center) · scale |
//! | `dataset.json` | `ids`, `train_ids`, `val_ids` |
//! | `metadata.json` | per id `time_id`, or in older datasets `warp_id`: the number of its moment |
//! | `camera/ID.json` | the camera at the size of `rgb/1x` |
//! | `rgb/Nx/ID.png` | the image at 1/N of that size |
//! | `points.npy` | N×3, world, without colours |
//! | `splits/train.json`, `val.json` | DyCheck: `frame_names`, `time_ids`; they override `dataset.json` |
//! | `covisible/Nx/val/ID.png` | DyCheck: the pixels that the training images saw as well |
//! | `depth/Nx/ID.npy` | DyCheck: z in world units, 0 where not measured |
//! | `extra.json` | DyCheck: `factor`, the N that is scored |
//!
//! `orientation` is the rotation from the world to the camera with OpenCV's axes, row by row; `position` is
//! the camera's centre: x = R (X − position). Pixel centres are at +0.5; distortion is OpenCV's with k1, k2,
//! k3 and p1, p2; fy = `focal_length` · `pixel_aspect_ratio`. Poses, points and depth are returned in the
//! scene's scaled frame.
//!
//! Source: the readme and `camera.py` of google/nerfies; docs/DATASETS.md of KAIR-BAIR/dycheck.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use glam::{DMat3, DVec3};
use serde_json::Value;

use super::{
    Alpha, Dataset, Distortion, Frame, Lens, Point, depth, fit_to_image, images, missing_note, npy,
    points,
};
use crate::error::excerpt;
use crate::io;
use crate::types::{Camera, Image, Intrinsics, Pose, range};
use crate::{Error, Result};

/// The transform from a dataset's world to its normalised scene.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Scene {
    /// World point that becomes the origin.
    pub center: DVec3,
    /// Scene units per world unit.
    pub scale: f64,
    /// Near bound of the scene's depth, in scene units.
    pub near: f64,
    /// Far bound of the scene's depth, in scene units.
    pub far: f64,
}

impl Scene {
    /// Transforms a world point to the scene.
    pub fn scene_from_world(&self, point: DVec3) -> DVec3 {
        (point - self.center) * self.scale
    }
}

/// Whether a folder contains such a dataset.
pub(super) fn is_root(folder: &Path) -> bool {
    ["scene.json", "dataset.json"].iter().all(|name| folder.join(name).is_file())
        && folder.join("camera").is_dir()
}

/// The dataset that an image folder (`rgb/2x`) belongs to.
pub(super) fn root_of(pictures: &Path) -> Option<PathBuf> {
    factor_of(pictures)?;
    let rgb = pictures.parent().filter(|rgb| rgb.file_name().is_some_and(|name| name == "rgb"))?;
    rgb.parent().filter(|root| is_root(root)).map(Path::to_path_buf)
}

/// The N of a folder named `Nx`.
fn factor_of(folder: &Path) -> Option<u32> {
    let digits = folder.file_name()?.to_str()?.strip_suffix('x')?;
    digits.parse().ok().filter(|factor| *factor > 0)
}

/// Reads a dataset. Its images are those of `pictures`, a folder `rgb/Nx`, or else those that published
/// results use: N of `extra.json`, else 2, else the finest that exists. Images that are listed but missing
/// are skipped and counted in a note.
///
/// Training and test images are those of `splits/`, else of `dataset.json`. Where no test images are
/// listed, the dataset is one of HyperNeRF's for interpolation: every fourth image is a training image, the
/// one midway between two of these is a test image, the others are left out.
///
/// Transparent pixels (DyCheck's, where the depth camera measured nothing) are invalid.
///
/// # Errors
/// [`Error::Io`]; [`Error::Format`] with the file and the entry.
pub fn read(root: &Path, pictures: Option<&Path>) -> Result<Dataset> {
    let scene_file = root.join("scene.json");
    let scene = read_scene(&scene_file)?;
    let mut set = Dataset { sources: vec![scene_file], ..Dataset::default() };
    let listed = Listed::read(root, &mut set)?;
    let folder = match pictures {
        Some(folder) => folder.to_path_buf(),
        None => folder_of_pictures(root, &mut set)?,
    };
    let factor = folder.file_name().unwrap_or_default();
    let (mut missing, mut times) = (Vec::new(), Vec::new());
    for (id, time, held_out) in &listed.frames {
        let Some(path) = picture(&folder, id) else {
            missing.push(id.clone());
            continue;
        };
        let (lens, pose) = read_camera(&root.join(format!("camera/{id}.json")), &scene)?;
        let mut camera = Camera { intrinsics: lens.intrinsics, view_from_world: pose };
        fit_to_image(&mut camera, &path)?;
        let covisible = root.join("covisible").join(factor).join("val").join(format!("{id}.png"));
        let frame = Frame::of_image(id.clone(), path, 0.0, camera);
        set.frames.push(Frame {
            distortion: lens.distortion,
            alpha: Alpha::Valid,
            covisible: Some(covisible).filter(|mask| *held_out && mask.is_file()),
            ..frame
        });
        times.push((*time, *held_out));
    }
    if !times.iter().any(|(_, held_out)| !held_out) {
        let what = "holds none of the images to train on that are listed";
        return Err(Error::format(folder, what));
    }
    set.notes.extend(missing_note(&missing, listed.frames.len()));
    let held: Vec<usize> = (0..times.len()).filter(|&i| times[i].1).collect();
    set.test = Some(held).filter(|held| !held.is_empty());
    if listed.timed {
        let all = || times.iter().map(|(time, _)| *time);
        let (first, last) = all().fold((u32::MAX, 0), |(a, b), t| (a.min(t), b.max(t)));
        let length = f64::from((last - first).max(1));
        for (frame, (time, _)) in set.frames.iter_mut().zip(&times) {
            frame.time = f64::from(time - first) / length;
        }
        set.timed = true;
    }
    let cloud = root.join("points.npy");
    if cloud.is_file() {
        let (points, left_out) = read_points(&cloud, &scene)?;
        set.notes.extend(points::left_out_note(left_out, points.len()));
        set.points = points;
        set.sources.push(cloud);
    }
    Ok(set)
}

/// The listed images, training before test.
struct Listed {
    /// Id, number of its moment (0 where `timed` is false), whether it is held out.
    frames: Vec<(String, u32, bool)>,
    timed: bool,
}

impl Listed {
    fn read(root: &Path, set: &mut Dataset) -> Result<Listed> {
        let metadata = root.join("metadata.json");
        let known = match metadata.is_file() {
            true => Some(Json::read(&metadata)?),
            false => None,
        };
        let moment = |id: &str| -> Result<Option<u32>> {
            let Some(json) = &known else { return Ok(None) };
            let entry = json.value.get(id).ok_or_else(|| {
                json.bad(format!("has no entry for {}, which is listed", excerpt(id)))
            })?;
            let number = entry.get("time_id").or_else(|| entry.get("warp_id"));
            let number = number.and_then(Value::as_u64).and_then(|n| u32::try_from(n).ok());
            number.map(Some).ok_or_else(|| {
                json.bad(format!(
                    "{}: `time_id` or `warp_id`, a whole number, is missing",
                    excerpt(id)
                ))
            })
        };
        set.sources.extend(known.iter().map(|json| json.path.clone()));
        let mut frames = Vec::new();
        let mut timed = known.is_some();
        let splits = ["train", "val"].map(|name| root.join(format!("splits/{name}.json")));
        if splits[0].is_file() {
            let mut moments = Vec::new();
            for (split, held_out) in
                splits.iter().filter(|split| split.is_file()).zip([false, true])
            {
                let json = Json::read(split)?;
                let ids = json.ids("frame_names")?;
                let numbers = json.numbers("time_ids", ids.len())?;
                moments.extend(numbers.into_iter().flatten());
                frames.extend(ids.into_iter().map(|id| (id, 0, held_out)));
                set.sources.push(split.clone());
            }
            let complete = moments.len() == frames.len();
            timed |= complete;
            for (i, frame) in frames.iter_mut().enumerate() {
                frame.1 = match complete {
                    true => moments[i],
                    false => moment(&frame.0)?.unwrap_or(0),
                };
            }
        } else {
            let json = Json::read(&root.join("dataset.json"))?;
            let held = json.ids("val_ids")?;
            let mut list = |ids: Vec<String>, held_out: bool| {
                for id in ids {
                    let number = moment(&id)?.unwrap_or(0);
                    frames.push((id, number, held_out));
                }
                Ok::<(), Error>(())
            };
            if held.is_empty() {
                let (train, test) = interpolation(&json, &mut set.notes)?;
                list(train, false)?;
                list(test, true)?;
            } else {
                list(json.ids("train_ids")?, false)?;
                list(held, true)?;
            }
            set.sources.push(json.path);
        }
        let listed = frames.len();
        let mut seen = BTreeSet::new();
        frames.retain(|frame| seen.insert(frame.0.clone()));
        if frames.len() < listed {
            let twice = listed - frames.len();
            set.notes.push(format!("{twice} of {listed} images are listed twice and count once"));
        }
        Ok(Listed { frames, timed })
    }
}

/// HyperNeRF's split for datasets without listed test images.
fn interpolation(json: &Json, notes: &mut Vec<String>) -> Result<(Vec<String>, Vec<String>)> {
    let ids = json.ids("ids")?;
    let count = ids.len();
    let (mut train, mut test) = (Vec::new(), Vec::new());
    for (i, id) in ids.into_iter().enumerate() {
        match i % 4 {
            0 => train.push(id),
            2 if i + 2 < count => test.push(id),
            _ => {}
        }
    }
    notes.push(format!(
        "`val_ids` is empty: HyperNeRF's split for interpolation is used, {} of {count} images to \
         train on (every fourth), {} midway between them for the test",
        train.len(),
        test.len()
    ));
    Ok((train, test))
}

/// The image folder that published results use.
fn folder_of_pictures(root: &Path, set: &mut Dataset) -> Result<PathBuf> {
    let rgb = root.join("rgb");
    let mut factors = Vec::new();
    for entry in std::fs::read_dir(&rgb).map_err(Error::io(&rgb))? {
        let path = entry.map_err(Error::io(&rgb))?.path();
        factors.extend(factor_of(&path).filter(|_| path.is_dir()));
    }
    factors.sort_unstable();
    let extra = root.join("extra.json");
    let mut wanted = 2;
    if extra.is_file() {
        let json = Json::read(&extra)?;
        let factor = json.value.get("factor").and_then(Value::as_u64);
        let there = factor.and_then(|factor| u32::try_from(factor).ok());
        wanted = there.filter(|factor| factors.contains(factor)).ok_or_else(|| {
            json.bad(format!(
                "`factor` = {} is none of the sizes in rgb/ ({}); name one as the dataset",
                factor.map_or("null".into(), |factor| factor.to_string()),
                names(&factors)
            ))
        })?;
        set.sources.push(extra);
    }
    let Some(&finest) = factors.first() else {
        return Err(Error::format(rgb, "holds no folder of images (1x, 2x, 4x, …)"));
    };
    let chosen = if factors.contains(&wanted) { wanted } else { finest };
    if factors.len() > 1 {
        set.notes.push(format!(
            "images of rgb/{chosen}x are taken; there are {}: name the folder of others as the dataset",
            names(&factors)
        ));
    }
    Ok(rgb.join(format!("{chosen}x")))
}

fn names(factors: &[u32]) -> String {
    let names: Vec<String> = factors.iter().map(|factor| format!("{factor}x")).collect();
    names.join(", ")
}

fn picture(folder: &Path, id: &str) -> Option<PathBuf> {
    let with = |extension: &&str| folder.join(format!("{id}.{extension}"));
    images::EXTENSIONS.iter().map(with).find(|path| path.is_file())
}

/// Reads `scene.json`.
///
/// # Errors
/// [`Error::Io`]; [`Error::Format`] with the field.
pub fn read_scene(path: &Path) -> Result<Scene> {
    let json = Json::read(path)?;
    let center = DVec3::from_array(json.vector("center")?);
    range::place(center).map_err(|what| json.bad(format!("`center` {what}")))?;
    let scale = json.number("scale")?;
    if !range::MATRIX_SCALE.contains(&scale) {
        let (least, most) = (range::MATRIX_SCALE.start(), range::MATRIX_SCALE.end());
        return Err(json.bad(format!("`scale` = {scale:?} is not between {least:e} and {most:e}")));
    }
    Ok(Scene { center, scale, near: json.number("near")?, far: json.number("far")? })
}

/// Reads a camera: its lens at the size of `rgb/1x`, and `view_from_scene`.
///
/// # Errors
/// [`Error::Io`]; [`Error::Format`] with the field: it is missing or invalid, pixels are skewed, or the
/// orientation is not a rotation.
pub fn read_camera(path: &Path, scene: &Scene) -> Result<(Lens, Pose)> {
    let json = Json::read(path)?;
    let rows = json.value.get("orientation").and_then(Value::as_array);
    let rows: Option<Vec<[f64; 3]>> = rows.and_then(|rows| rows.iter().map(triple).collect());
    let Some(&[x, y, z]) = rows.as_deref() else {
        return Err(json.bad("`orientation` is not a 3×3 matrix of numbers"));
    };
    let view_from_world = DMat3::from_cols(x.into(), y.into(), z.into()).transpose();
    let (rotation, scale) = range::rotation_and_scale(view_from_world)
        .map_err(|what| json.bad(format!("`orientation` {what}")))?;
    if (scale - 1.0).abs() > range::ROTATION_TOLERANCE {
        return Err(json.bad(format!("`orientation` is no rotation: it scales by {scale:?}")));
    }
    let centre = scene.scene_from_world(DVec3::from_array(json.vector("position")?));
    range::place(centre).map_err(|what| json.bad(format!("`position` {what}")))?;
    let [cx, cy] = json.vector("principal_point")?;
    let [w, h] = json.vector("image_size")?;
    let size =
        images::sides(w as usize, h as usize).filter(|_| [w, h].iter().all(|s| s.fract() == 0.0));
    let Some((width, height)) = size else {
        return Err(json.bad(format!("`image_size` = [{w:?}, {h:?}] makes no sense")));
    };
    let fx = json.number("focal_length")?;
    let fy = fx * json.number_or("pixel_aspect_ratio", 1.0)?;
    let skew = json.number_or("skew", 0.0)?;
    if skew.abs() > 1e-6 * fx.abs() {
        let what =
            format!("`skew` = {skew:?}: skewed pixels are not supported; undistort the images");
        return Err(json.bad(what));
    }
    let intrinsics = Intrinsics { fx, fy, cx, cy, width, height };
    let [k1, k2, k3] = json.vector_or_zero("radial_distortion")?;
    let tangential = match json.value.get("tangential") {
        Some(_) => json.vector_or_zero("tangential")?,
        None => json.vector_or_zero("tangential_distortion")?,
    };
    let distortion = Distortion { radial: [k1, k2, k3, 0.0], tangential };
    intrinsics
        .check()
        .and_then(|()| distortion.check(&intrinsics))
        .map_err(|what| json.bad(what))?;
    let pose = Pose::new(rotation, -(rotation * centre));
    Ok((Lens { intrinsics, distortion }, pose))
}

/// Reads a DyCheck depth map (`depth/Nx/ID.npy`): z in scene units, 0 where unknown.
///
/// # Errors
/// Those of [`depth::read`].
pub fn read_depth(path: &Path, scene: &Scene) -> Result<Image> {
    let mut depth = depth::read(path, 1.0)?;
    depth.pixels.iter_mut().for_each(|z| *z = (f64::from(*z) * scene.scale) as f32);
    Ok(depth)
}

/// Reads `points.npy`, which has no colours: grey points in the scene, and the number of points left out.
fn read_points(path: &Path, scene: &Scene) -> Result<(Vec<Point>, usize)> {
    let array = npy::read(path)?;
    let [count, 3] = array.shape[..] else {
        let what = format!("holds an array of shape {:?}, and not of points × 3", array.shape);
        return Err(Error::format(path, what));
    };
    let point = |p: &[f64]| Point {
        position: scene.scene_from_world(DVec3::from_slice(p)).as_vec3().to_array(),
        colour: [0.5; 3],
    };
    let points: Vec<Point> =
        array.values.chunks_exact(3).map(point).filter(Point::is_usable).collect();
    let left_out = count - points.len();
    Ok((points, left_out))
}

fn triple(value: &Value) -> Option<[f64; 3]> {
    let numbers: Vec<f64> = value.as_array()?.iter().map(Value::as_f64).collect::<Option<_>>()?;
    numbers.try_into().ok()
}

/// A parsed JSON file with typed access to its fields.
struct Json {
    path: PathBuf,
    value: Value,
}

impl Json {
    fn read(path: &Path) -> Result<Json> {
        let value = io::read_json(path)?;
        match value.is_object() {
            true => Ok(Json { path: path.to_path_buf(), value }),
            false => Err(Error::format(path, "is not a JSON object")),
        }
    }

    fn bad(&self, what: impl Into<String>) -> Error {
        Error::format(&self.path, what)
    }

    fn number(&self, key: &str) -> Result<f64> {
        let number = self.value.get(key).and_then(Value::as_f64).filter(|v| v.is_finite());
        number.ok_or_else(|| self.bad(format!("`{key}`, a number, is missing")))
    }

    fn number_or(&self, key: &str, otherwise: f64) -> Result<f64> {
        if self.value.get(key).is_some() { self.number(key) } else { Ok(otherwise) }
    }

    fn vector<const N: usize>(&self, key: &str) -> Result<[f64; N]> {
        let list = self.value.get(key).and_then(Value::as_array);
        let numbers =
            list.and_then(|list| list.iter().map(Value::as_f64).collect::<Option<Vec<_>>>());
        let numbers = numbers.and_then(|numbers| <[f64; N]>::try_from(numbers).ok());
        numbers.ok_or_else(|| self.bad(format!("`{key}` is not a list of {N} numbers")))
    }

    fn vector_or_zero<const N: usize>(&self, key: &str) -> Result<[f64; N]> {
        if self.value.get(key).is_some() { self.vector(key) } else { Ok([0.0; N]) }
    }

    /// A list of ids, which are strings or numbers.
    fn ids(&self, key: &str) -> Result<Vec<String>> {
        let bad = || self.bad(format!("`{key}` is not a list of images' names"));
        let id = |value: &Value| match value {
            Value::String(id) => Ok(id.clone()),
            Value::Number(id) => Ok(id.to_string()),
            _ => Err(bad()),
        };
        self.value.get(key).and_then(Value::as_array).ok_or_else(bad)?.iter().map(id).collect()
    }

    /// A list of `count` integers; `None` where it is absent.
    fn numbers(&self, key: &str, count: usize) -> Result<Option<Vec<u32>>> {
        let Some(list) = self.value.get(key) else { return Ok(None) };
        let number = |value: &Value| value.as_u64().and_then(|n| u32::try_from(n).ok());
        let list =
            list.as_array().and_then(|list| list.iter().map(number).collect::<Option<Vec<_>>>());
        let list = list.filter(|list| list.len() == count);
        list.map(Some)
            .ok_or_else(|| self.bad(format!("`{key}` is not a list of {count} whole numbers")))
    }
}
