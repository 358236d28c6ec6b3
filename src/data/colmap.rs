//! COLMAP models: reads binary and text models, writes binary ones.
//!
//! Format: COLMAP's documentation, "Output Format". Poses are `view_from_world` with OpenCV axes and
//! quaternions (w, x, y, z); pixel centres lie at +0.5. Both are the crate's own conventions.

mod write;

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use glam::{DQuat, DVec3};

use super::{Dataset, Distortion, Frame, Lens, Point, fit_to_image, images, missing_note, points};
use crate::error::excerpt;
use crate::io::{self, Bytes};
use crate::types::{Camera, Intrinsics, Pose, range};
use crate::{Error, Result};

pub use write::{TrackedPoint, write_model};

/// A registered image.
#[derive(Clone, Debug, PartialEq)]
pub struct Registered {
    /// Path relative to the image folder.
    pub name: String,
    /// The key into [`Model::lenses`].
    pub camera: u32,
    /// World to camera.
    pub view_from_world: Pose,
}

/// A COLMAP model.
#[derive(Clone, Debug, Default)]
pub struct Model {
    /// Cameras by their id.
    pub lenses: HashMap<u32, Lens>,
    /// Images in file order.
    pub images: Vec<Registered>,
    /// Triangulated points, without those that are not finite or outside [`range::CAMERA_REACH`].
    pub points: Vec<Point>,
    /// Number of points left out.
    pub left_out: usize,
}

/// The folder below `root` that holds a model, if there is one.
pub fn find(root: &Path) -> Option<PathBuf> {
    ["sparse/0", "sparse", "colmap/sparse/0", "."]
        .iter()
        .map(|folder| root.join(folder))
        .find(|folder| folder.join("cameras.bin").is_file() || folder.join("cameras.txt").is_file())
}

/// Reads a dataset: the model in `model`, the images in `root/images`, `root/input` or `root`. Frames are
/// in the natural order of their names; missing images are skipped and counted in a note.
pub fn read(root: &Path, model: &Path) -> Result<Dataset> {
    let Model { lenses, mut images, points, left_out } = read_model(model)?;
    let notes = Vec::from_iter(points::left_out_note(left_out, points.len()));
    images.sort_by(|a, b| images::natural(&a.name, &b.name));
    let folders: Vec<PathBuf> = ["images", "input", ""].iter().map(|f| root.join(f)).collect();
    let parts = ["cameras", "images", "points3D"];
    let sources = ["bin", "txt"].iter().flat_map(|e| parts.map(|p| model.join(format!("{p}.{e}"))));
    let sources = sources.filter(|path| path.is_file()).collect();
    let mut set = Dataset { points, notes, sources, ..Dataset::default() };
    let (listed, mut missing) = (images.len(), Vec::new());
    for image in images {
        let lens = lenses.get(&image.camera).ok_or_else(|| {
            let what = format!(
                "image {} names camera {}, which is absent",
                excerpt(&image.name),
                image.camera
            );
            Error::format(model, what)
        })?;
        let found = folders.iter().map(|f| f.join(&image.name)).find(|path| path.is_file());
        let Some(path) = found else {
            missing.push(image.name);
            continue;
        };
        let mut camera =
            Camera { intrinsics: lens.intrinsics, view_from_world: image.view_from_world };
        fit_to_image(&mut camera, &path)?;
        let frame = Frame::of_image(image.name, path, 0.0, camera);
        set.frames.push(Frame { distortion: lens.distortion, ..frame });
    }
    if set.frames.is_empty() {
        return Err(Error::format(
            root,
            format!("none of the {listed} images that the COLMAP model lists exists in images/"),
        ));
    }
    set.notes.extend(missing_note(&missing, listed));
    Ok(set)
}

/// Reads the three files of a model; binary is preferred where both kinds exist. `points3D` may be absent.
pub fn read_model(folder: &Path) -> Result<Model> {
    let binary = folder.join("cameras.bin").is_file();
    let file = |stem: &str| folder.join(format!("{stem}.{}", if binary { "bin" } else { "txt" }));
    let (cameras, images, points) = (file("cameras"), file("images"), file("points3D"));
    let has_points = points.is_file();
    let (lenses, images, found) = if binary {
        (
            binary_cameras(&cameras, &io::read(&cameras)?)?,
            binary_images(&images, &io::read(&images)?)?,
            match has_points {
                true => binary_points(&points, &io::read(&points)?)?,
                false => Vec::new(),
            },
        )
    } else {
        (
            text_cameras(&cameras, &io::read_text(&cameras)?)?,
            text_images(&images, &io::read_text(&images)?)?,
            match has_points {
                true => text_points(&points, &io::read_text(&points)?)?,
                false => Vec::new(),
            },
        )
    };
    let listed = found.len();
    let points: Vec<Point> = found.into_iter().flatten().collect();
    Ok(Model { lenses, images, left_out: listed - points.len(), points })
}

/// COLMAP's camera models in the order of their ids, with their numbers of parameters.
const MODELS: [(&str, usize); 11] = [
    ("SIMPLE_PINHOLE", 3),
    ("PINHOLE", 4),
    ("SIMPLE_RADIAL", 4),
    ("RADIAL", 5),
    ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12),
    ("FOV", 5),
    ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5),
    ("THIN_PRISM_FISHEYE", 12),
];

/// Converts a camera model's parameters to a lens.
fn lens(path: &Path, id: u32, model: &str, size: (u64, u64), p: &[f64]) -> Result<Lens> {
    let bad = |what: String| Error::format(path, format!("camera {id}: {what}"));
    let side = |side: u64| match u32::try_from(side) {
        Ok(side) if side > 0 => Ok(side),
        _ => Err(bad(format!("a size of {}×{} makes no sense", size.0, size.1))),
    };
    let (width, height) = (side(size.0)?, side(size.1)?);
    let at = |fx, fy, cx, cy| Intrinsics { fx, fy, cx, cy, width, height };
    let bent = |k1, k2, p1, p2| Distortion { radial: [k1, k2, 0.0, 0.0], tangential: [p1, p2] };
    let (intrinsics, distortion) = match (model, p) {
        ("SIMPLE_PINHOLE", &[f, cx, cy]) => (at(f, f, cx, cy), Distortion::default()),
        ("PINHOLE", &[fx, fy, cx, cy]) => (at(fx, fy, cx, cy), Distortion::default()),
        ("SIMPLE_RADIAL", &[f, cx, cy, k]) => (at(f, f, cx, cy), bent(k, 0.0, 0.0, 0.0)),
        ("RADIAL", &[f, cx, cy, k1, k2]) => (at(f, f, cx, cy), bent(k1, k2, 0.0, 0.0)),
        ("OPENCV", &[fx, fy, cx, cy, k1, k2, p1, p2]) => (at(fx, fy, cx, cy), bent(k1, k2, p1, p2)),
        _ => {
            return Err(bad(format!(
                "model {} with {} parameters is not supported (SIMPLE_PINHOLE, PINHOLE, \
                 SIMPLE_RADIAL, RADIAL and OPENCV are); run `colmap image_undistorter` first",
                excerpt(model),
                p.len()
            )));
        }
    };
    intrinsics.check().and_then(|()| distortion.check(&intrinsics)).map_err(bad)?;
    Ok(Lens { intrinsics, distortion })
}

/// Converts a quaternion (w, x, y, z) and a translation to a pose.
fn pose(path: &Path, name: &str, q: [f64; 4], t: [f64; 3]) -> Result<Pose> {
    let rotation = DQuat::from_xyzw(q[1], q[2], q[3], q[0]);
    let bad = |what: String| Error::format(path, format!("image {}: {what}", excerpt(name)));
    range::quaternion(rotation).map_err(bad)?;
    let pose = Pose::new(rotation, DVec3::from_array(t));
    pose.check().map_err(bad)?;
    Ok(pose)
}

fn point(position: [f64; 3], colour: [u8; 3]) -> Option<Point> {
    let colour = colour.map(|v| f32::from(v) / 255.0);
    Some(Point { position: position.map(|v| v as f32), colour }).filter(Point::is_usable)
}

fn binary_cameras(path: &Path, bytes: &[u8]) -> Result<HashMap<u32, Lens>> {
    let mut from = Bytes::new(path, bytes);
    let count = from.count(24, "cameras")?;
    let mut lenses = HashMap::with_capacity(count);
    for _ in 0..count {
        let id = from.u32("a camera's id")?;
        let model = from.i32("a camera's model")?;
        let size = (from.u64("a camera's width")?, from.u64("a camera's height")?);
        let known = usize::try_from(model).ok().and_then(|m| MODELS.get(m));
        let &(model, parameters) = known.ok_or_else(|| {
            Error::format(path, format!("camera {id}: there is no camera model {model}"))
        })?;
        let parameters = (0..parameters)
            .map(|_| from.f64("a camera's parameters"))
            .collect::<Result<Vec<f64>>>()?;
        lenses.insert(id, lens(path, id, model, size, &parameters)?);
    }
    Ok(lenses)
}

fn binary_images(path: &Path, bytes: &[u8]) -> Result<Vec<Registered>> {
    let mut from = Bytes::new(path, bytes);
    let count = from.count(73, "images")?;
    let mut images = Vec::with_capacity(count);
    for _ in 0..count {
        from.u32("an image's id")?;
        let (mut q, mut t) = ([0.0; 4], [0.0; 3]);
        for value in q.iter_mut().chain(&mut t) {
            *value = from.f64("an image's pose")?;
        }
        let camera = from.u32("an image's camera")?;
        let name = from.text("an image's name")?;
        let observations = from.count(24, "observations")?;
        from.take(24 * observations, "an image's observations")?;
        let view_from_world = pose(path, &name, q, t)?;
        images.push(Registered { name, camera, view_from_world });
    }
    Ok(images)
}

/// The points; `None` for each one that is unusable.
fn binary_points(path: &Path, bytes: &[u8]) -> Result<Vec<Option<Point>>> {
    let mut from = Bytes::new(path, bytes);
    let count = from.count(51, "points")?;
    let mut points = Vec::with_capacity(count);
    for _ in 0..count {
        from.u64("a point's id")?;
        let mut position = [0.0; 3];
        for value in &mut position {
            *value = from.f64("a point's position")?;
        }
        let colour = from.array("a point's colour")?;
        from.f64("a point's error")?;
        let track = from.count(8, "track elements")?;
        from.take(8 * track, "a point's track")?;
        points.push(point(position, colour));
    }
    Ok(points)
}

/// The words of one line of a text file, read in order.
struct Line<'a> {
    path: &'a Path,
    number: usize,
    words: std::str::SplitAsciiWhitespace<'a>,
}

impl<'a> Line<'a> {
    fn next<T: FromStr>(&mut self, what: &str) -> Result<T> {
        self.words.next().and_then(|word| word.parse().ok()).ok_or_else(|| {
            Error::format(self.path, format!("line {}: {what} expected", self.number))
        })
    }
}

/// The lines that hold data, without comments; empty lines are included, and the caller interprets them.
fn lines<'a>(path: &'a Path, text: &'a str) -> impl Iterator<Item = (&'a str, Line<'a>)> {
    text.lines().enumerate().filter(|(_, line)| !line.trim_start().starts_with('#')).map(
        move |(i, line)| (line, Line { path, number: i + 1, words: line.split_ascii_whitespace() }),
    )
}

fn text_cameras(path: &Path, text: &str) -> Result<HashMap<u32, Lens>> {
    let mut lenses = HashMap::new();
    for (line, mut words) in lines(path, text) {
        if line.trim().is_empty() {
            continue;
        }
        let id = words.next("a camera's id")?;
        let model: String = words.next("a camera's model")?;
        let size = (words.next("a width")?, words.next("a height")?);
        let mut parameters = Vec::new();
        while words.words.clone().next().is_some() {
            parameters.push(words.next("a camera's parameter")?);
        }
        lenses.insert(id, lens(path, id, &model, size, &parameters)?);
    }
    Ok(lenses)
}

fn text_images(path: &Path, text: &str) -> Result<Vec<Registered>> {
    let mut images = Vec::new();
    let mut lines = lines(path, text).peekable();
    while let Some((line, mut words)) = lines.next() {
        if line.trim().is_empty() {
            continue;
        }
        words.next::<u32>("an image's id")?;
        let (mut q, mut t) = ([0.0; 4], [0.0; 3]);
        for value in q.iter_mut().chain(&mut t) {
            *value = words.next("a number of the pose")?;
        }
        let camera = words.next("a camera's id")?;
        // The name is the rest of the line, because it may contain spaces.
        let name = words.words.by_ref().collect::<Vec<_>>().join(" ");
        if name.is_empty() {
            return Err(Error::format(path, format!("line {}: a name expected", words.number)));
        }
        let view_from_world = pose(path, &name, q, t)?;
        images.push(Registered { name, camera, view_from_world });
        // The image's observations follow on a separate line, which is empty where there are none. Some
        // writers omit the empty line, so that the next image follows directly.
        lines.next_if(|(line, _)| is_observations(line));
    }
    Ok(images)
}

/// Whether a line consists of any number of `x y id` triples. An image's line does not: it has a name, and
/// at least ten words.
fn is_observations(line: &str) -> bool {
    let words = || line.split_ascii_whitespace();
    words().count().is_multiple_of(3) && words().all(|word| word.parse::<f64>().is_ok())
}

fn text_points(path: &Path, text: &str) -> Result<Vec<Option<Point>>> {
    let mut points = Vec::new();
    for (line, mut words) in lines(path, text) {
        if line.trim().is_empty() {
            continue;
        }
        words.next::<u64>("a point's id")?;
        let (mut position, mut colour) = ([0.0; 3], [0; 3]);
        for value in &mut position {
            *value = words.next("a coordinate")?;
        }
        for value in &mut colour {
            *value = words.next("a colour from 0 to 255")?;
        }
        points.push(point(position, colour));
    }
    Ok(points)
}
