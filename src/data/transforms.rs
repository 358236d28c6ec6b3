//! `transforms.json` of nerfstudio and instant-ngp, and D-NeRF's split into `transforms_train.json` and
//! `transforms_test.json`.
//!
//! `transform_matrix` is `world_from_view` with OpenGL's camera axes (y up, z backward). Intrinsics are
//! given for the file or for a frame; the frame's take precedence. A frame's `time` is in [0, 1].

use std::path::{Path, PathBuf};

use glam::{DMat3, DMat4, DVec3};
use rayon::prelude::*;
use serde_json::{Map, Value, json};

use super::{Dataset, Distortion, Frame, fit_to_image, images, missing_note, points};
use crate::error::excerpt;
use crate::io;
use crate::types::{Camera, Intrinsics, Pose, range};
use crate::{Error, Result};

/// A camera of a path or a trajectory, with its time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TimedCamera {
    /// Time in [0, 1].
    pub time: f64,
    /// The camera.
    pub camera: Camera,
}

/// A frame as the file lists it.
struct Entry {
    file: String,
    time: Option<f64>,
    view_from_world: Pose,
    /// The frame's own fields, which override the file's.
    fields: Map<String, Value>,
}

/// A parsed file.
struct Listing {
    path: PathBuf,
    top: Map<String, Value>,
    entries: Vec<Entry>,
}

/// Reads a dataset of one file. Listed images that are missing are skipped and counted in a note.
pub fn read(path: &Path) -> Result<Dataset> {
    let listing = Listing::read(path)?;
    let mut set = Dataset::default();
    if let Some(cloud) = listing.top.get("ply_file_path").and_then(Value::as_str) {
        let cloud = listing.folder().join(cloud);
        match cloud.is_file() {
            true => {
                let (points, left_out) = points::read_ply(&cloud)?;
                set.notes.extend(points::left_out_note(left_out, points.len()));
                set.points = points;
                set.sources.push(cloud);
            }
            false => set.notes.push(format!("no point cloud: {} does not exist", cloud.display())),
        }
    }
    let times: Vec<_> = listing.entries.iter().map(|e| e.time).collect();
    let span = span(path, &times, &mut set.notes)?;
    set.timed = span.is_some();
    listing.frames(span, &mut set)?;
    set.sources.push(path.to_path_buf());
    if set.frames.is_empty() {
        return Err(Error::format(path, "none of the images that it lists exists"));
    }
    Ok(set)
}

/// Reads a dataset that is split into `transforms_train.json` and `transforms_test.json` in a folder. Test
/// frames that are also training frames are left out of the test split, with a note; `transforms_val.json`
/// is not read.
pub fn read_split(folder: &Path) -> Result<Dataset> {
    let train = Listing::read(&folder.join("transforms_train.json"))?;
    let test = folder.join("transforms_test.json");
    let mut test = if test.is_file() { Some(Listing::read(&test)?) } else { None };
    let mut set = Dataset::default();
    if let Some(test) = &mut test {
        let key = |e: &Entry| (e.file.clone(), e.time.map(f64::to_bits));
        let known: std::collections::HashSet<_> = train.entries.iter().map(key).collect();
        let listed = test.entries.len();
        test.entries.retain(|e| !known.contains(&key(e)));
        if test.entries.len() < listed {
            let shared = listed - test.entries.len();
            set.notes.push(format!(
                "{shared} of {listed} test images are training images and do not count as test"
            ));
        }
    }
    let all = train.entries.iter().chain(test.iter().flat_map(|t| &t.entries));
    let times: Vec<_> = all.map(|e| e.time).collect();
    let span = span(&train.path, &times, &mut set.notes)?;
    set.timed = span.is_some();
    train.frames(span, &mut set)?;
    set.sources.extend(["transforms_train.json", "transforms_test.json"].map(|f| folder.join(f)));
    set.sources.retain(|path| path.is_file());
    let first = set.frames.len();
    if first == 0 {
        return Err(Error::format(&train.path, "none of the images that it lists exists"));
    }
    if let Some(test) = test.filter(|t| !t.entries.is_empty()) {
        test.frames(span, &mut set)?;
        set.test = Some((first..set.frames.len()).collect());
    }
    Ok(set)
}

/// Reads only the cameras, as a path to render along; images need not exist, but each camera needs its size
/// (`w`, `h`), in the file's or the frame's fields. Where times are absent, they run from 0 to 1.
pub fn read_cameras(path: &Path) -> Result<Vec<TimedCamera>> {
    let listing = Listing::read(path)?;
    if listing.entries.is_empty() {
        return Err(Error::format(path, "its list `frames` is empty: there is no camera in it"));
    }
    let times: Vec<_> = listing.entries.iter().map(|e| e.time).collect();
    let span = span(path, &times, &mut Vec::new())?;
    let last = listing.entries.len().saturating_sub(1).max(1) as f64;
    let camera = |(i, entry): (usize, &Entry)| {
        let (intrinsics, _) = listing.lens(entry, None)?;
        let camera = Camera { intrinsics, view_from_world: entry.view_from_world };
        Ok(TimedCamera { time: normalised(span, entry.time).unwrap_or(i as f64 / last), camera })
    };
    listing.entries.iter().enumerate().map(camera).collect()
}

/// The `file_path` of each camera that [`read_cameras`] gives; `frame N` where there is none.
pub fn file_names(path: &Path) -> Result<Vec<String>> {
    Ok(Listing::read(path)?.entries.into_iter().map(|entry| entry.file).collect())
}

/// The distortion of each camera that [`read_cameras`] gives as a pinhole.
pub fn distortions(path: &Path) -> Result<Vec<Distortion>> {
    let listing = Listing::read(path)?;
    listing.entries.iter().map(|entry| Ok(listing.lens(entry, None)?.1)).collect()
}

/// Writes cameras in nerfstudio's format, each with its `time`; `files` names an image for each camera,
/// relative to the file; `cloud` names a PLY file of initial points, if there is one.
pub fn write(
    path: impl AsRef<Path>,
    cameras: &[TimedCamera],
    files: &[String],
    cloud: Option<&str>,
) -> Result<()> {
    if files.len() != cameras.len() {
        return Err(Error::Shape {
            op: "transforms::write",
            arg: "files",
            expected: cameras.len().to_string(),
            actual: files.len(),
        });
    }
    let frame = |(TimedCamera { time, camera }, file): (&TimedCamera, &String)| {
        let k = &camera.intrinsics;
        json!({
            "file_path": file,
            "time": time,
            "transform_matrix": matrix(&camera.view_from_world),
            "fl_x": k.fx, "fl_y": k.fy, "cx": k.cx, "cy": k.cy, "w": k.width, "h": k.height,
        })
    };
    let frames: Vec<Value> = cameras.iter().zip(files).map(frame).collect();
    let mut top = json!({ "camera_model": "PINHOLE", "frames": frames });
    if let Some(first) = cameras.first() {
        // Readers that support only one camera for all frames find it in the file's fields.
        let k = &first.camera.intrinsics;
        for (key, value) in [("fl_x", k.fx), ("fl_y", k.fy), ("cx", k.cx), ("cy", k.cy)] {
            top[key] = json!(value);
        }
        (top["w"], top["h"]) = (json!(k.width), json!(k.height));
        top["camera_angle_x"] = json!(2.0 * (f64::from(k.width) / 2.0 / k.fx).atan());
    }
    if let Some(cloud) = cloud {
        top["ply_file_path"] = json!(cloud);
    }
    io::write_json(path, &top)
}

/// Converts OpenCV's camera axes to OpenGL's and back: y and z change sign.
const GL_FLIP: DVec3 = DVec3::new(1.0, -1.0, -1.0);

/// The rows of `world_from_view` with OpenGL's axes.
fn matrix(view_from_world: &Pose) -> [[f64; 4]; 4] {
    let world_from_view = view_from_world.inverse();
    let rotation = world_from_view.rotation_matrix() * DMat3::from_diagonal(GL_FLIP);
    let mut whole = DMat4::from_mat3(rotation);
    whole.w_axis = world_from_view.translation.extend(1.0);
    whole.transpose().to_cols_array_2d()
}

/// How the given times are mapped to [0, 1]: first time and duration; `None` where no frame has a time.
fn span(path: &Path, times: &[Option<f64>], notes: &mut Vec<String>) -> Result<Option<(f64, f64)>> {
    let given: Vec<f64> = times.iter().flatten().copied().collect();
    if given.is_empty() {
        return Ok(None);
    }
    if given.len() < times.len() {
        let without = times.iter().position(Option::is_none).unwrap_or(0);
        return Err(Error::format(path, format!("frame {without} has no `time`, others have one")));
    }
    let low = given.iter().copied().fold(f64::INFINITY, f64::min);
    let high = given.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    if low >= 0.0 && high <= 1.0 {
        return Ok(Some((0.0, 1.0)));
    }
    notes.push(format!("times from {low} to {high} are mapped to [0, 1]"));
    Ok(Some((low, if high > low { high - low } else { 1.0 })))
}

fn normalised(span: Option<(f64, f64)>, time: Option<f64>) -> Option<f64> {
    span.zip(time).map(|((first, length), time)| (time - first) / length)
}

impl Listing {
    fn read(path: &Path) -> Result<Listing> {
        let bad = |what: String| Error::format(path, what);
        let Value::Object(mut top) = io::read_json(path)? else {
            return Err(bad("is not a transforms.json: not an object".into()));
        };
        let Some(Value::Array(frames)) = top.remove("frames") else {
            return Err(bad("is not a transforms.json: it has no list `frames`".into()));
        };
        let mut entries = Vec::with_capacity(frames.len());
        for (i, frame) in frames.into_iter().enumerate() {
            let Value::Object(fields) = frame else {
                return Err(bad(format!("frame {i} is not an object")));
            };
            let file = match fields.get("file_path").and_then(Value::as_str) {
                Some(file) => file.replace('\\', "/"),
                None => format!("frame {i}"),
            };
            let here = |what: String| bad(format!("frame {i} ({}): {what}", excerpt(&file)));
            let time = match fields.get("time") {
                None | Some(Value::Null) => None,
                Some(time) => {
                    let time =
                        time.as_f64().ok_or_else(|| here("`time` is not a number".into()))?;
                    range::timestamp(time).map_err(here)?;
                    Some(time)
                }
            };
            let view_from_world = pose(fields.get("transform_matrix"))
                .map_err(|what| here(format!("transform_matrix {what}")))?;
            entries.push(Entry { file, time, view_from_world, fields });
        }
        Ok(Listing { path: path.to_path_buf(), top, entries })
    }

    fn folder(&self) -> &Path {
        self.path.parent().unwrap_or(Path::new("."))
    }

    /// Adds the frames whose images exist, and a note about the others.
    fn frames(&self, span: Option<(f64, f64)>, set: &mut Dataset) -> Result<()> {
        let frames = self
            .entries
            .par_iter()
            .map(|entry| {
                let Some(path) = self.image(&entry.file) else { return Ok(Err(&entry.file)) };
                let size = images::dimensions(&path, images::Orientation::Stored)?;
                let (intrinsics, distortion) = self.lens(entry, Some(size))?;
                let mut camera = Camera { intrinsics, view_from_world: entry.view_from_world };
                fit_to_image(&mut camera, &path)?;
                let time = normalised(span, entry.time).unwrap_or(0.0);
                let frame = Frame::of_image(entry.file.clone(), path, time, camera);
                Ok(Ok(Frame { distortion, ..frame }))
            })
            .collect::<Result<Vec<std::result::Result<Frame, &String>>>>()?;
        let mut missing = Vec::new();
        for frame in frames {
            match frame {
                Ok(frame) => set.frames.push(frame),
                Err(name) => missing.push(name.clone()),
            }
        }
        set.notes.extend(missing_note(&missing, self.entries.len()));
        Ok(())
    }

    /// The image file of a `file_path`, whose extension may be omitted.
    fn image(&self, file: &str) -> Option<PathBuf> {
        let exact = self.folder().join(file);
        if exact.is_file() {
            return Some(exact);
        }
        let with = |extension: &&str| self.folder().join(format!("{file}.{extension}"));
        images::EXTENSIONS.iter().map(with).find(|path| path.is_file())
    }

    /// Intrinsics and distortion of a frame; `size` is the image's, for files without a size.
    fn lens(&self, entry: &Entry, size: Option<(u32, u32)>) -> Result<(Intrinsics, Distortion)> {
        let bad = |what: String| {
            Error::format(&self.path, format!("the camera of {}: {what}", excerpt(&entry.file)))
        };
        let field = |key: &str| entry.fields.get(key).or_else(|| self.top.get(key));
        let number = |key: &str| match field(key) {
            None | Some(Value::Null) => Ok(None),
            Some(value) => match value.as_f64().filter(|v| v.is_finite()) {
                Some(value) => Ok(Some(value)),
                None => Err(bad(format!("`{key}` is not a number"))),
            },
        };
        let model = field("camera_model").and_then(Value::as_str).unwrap_or("OPENCV");
        let fisheye = field("is_fisheye").and_then(Value::as_bool).unwrap_or(false);
        if fisheye || !["OPENCV", "PINHOLE", "SIMPLE_PINHOLE"].contains(&model) {
            let model = if fisheye { "fisheye" } else { model };
            let model = excerpt(model);
            return Err(bad(format!("model {model} is not supported; undistort the images first")));
        }
        let side = |key: &str, own: Option<u32>| match (number(key)?, own) {
            (Some(value), _) if value >= 1.0 && value <= f64::from(u32::MAX) => Ok(value as u32),
            (Some(value), _) => Err(bad(format!("`{key}` = {value:?} makes no sense"))),
            (None, Some(own)) => Ok(own),
            (None, None) => Err(bad(format!("`{key}` is missing"))),
        };
        let width = side("w", size.map(|s| s.0))?;
        let height = side("h", size.map(|s| s.1))?;
        let (w, h) = (f64::from(width), f64::from(height));
        let of_angle = |key: &str, side: f64| match number(key)? {
            Some(angle) if angle > 0.0 && angle < std::f64::consts::PI => {
                Ok(Some(side / 2.0 / (angle / 2.0).tan()))
            }
            Some(angle) => Err(bad(format!("`{key}` = {angle:?} is not between 0 and π radians"))),
            None => Ok(None),
        };
        // Angles beside focal lengths are ignored, because some exporters leave them at 0.
        let given = number("fl_x")?;
        let x = given.map_or_else(|| of_angle("camera_angle_x", w), |fx| Ok(Some(fx)))?;
        let y = number("fl_y")?.or(given);
        let y = y.map_or_else(|| of_angle("camera_angle_y", h), |fy| Ok(Some(fy)))?;
        let (fx, fy) = match (x.or(y), y.or(x)) {
            (Some(fx), Some(fy)) if fx > 0.0 && fy > 0.0 => (fx, fy),
            (None, None) => return Err(bad("no `fl_x` and no `camera_angle_x`".into())),
            (fx, fy) => return Err(bad(format!("focal lengths {fx:?}, {fy:?} make no sense"))),
        };
        let (cx, cy) = (number("cx")?.unwrap_or(w / 2.0), number("cy")?.unwrap_or(h / 2.0));
        let mut distortion = Distortion::default();
        if model == "OPENCV" {
            for (slot, key) in distortion.radial.iter_mut().zip(["k1", "k2", "k3", "k4"]) {
                *slot = number(key)?.unwrap_or(0.0);
            }
            for (slot, key) in distortion.tangential.iter_mut().zip(["p1", "p2"]) {
                *slot = number(key)?.unwrap_or(0.0);
            }
        }
        let intrinsics = Intrinsics { fx, fy, cx, cy, width, height };
        intrinsics.check().and_then(|()| distortion.check(&intrinsics)).map_err(bad)?;
        Ok((intrinsics, distortion))
    }
}

/// `view_from_world` (OpenCV) of a 3×4 or 4×4 `world_from_view` (OpenGL). A uniform scale of the rotation,
/// which some exporters leave in, is removed.
fn pose(value: Option<&Value>) -> std::result::Result<Pose, String> {
    let value = value.ok_or("is missing")?;
    let number = |row: usize, column: usize| {
        value.get(row).and_then(|r| r.get(column)).and_then(Value::as_f64)
    };
    let mut columns = [DVec3::ZERO; 4];
    for (c, column) in columns.iter_mut().enumerate() {
        for r in 0..3 {
            column[r] = number(r, c).ok_or("is not a 3×4 or 4×4 matrix of numbers")?;
        }
    }
    let [x, y, z, centre] = columns;
    let (rotation, _) = range::rotation_and_scale(DMat3::from_cols(x, -y, -z))?;
    range::place(centre).map_err(|what| format!("is of a camera whose place {what}"))?;
    Ok(Pose::new(rotation, centre).inverse())
}
