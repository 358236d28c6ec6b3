//! `poses_bounds.npy`: the cameras of LLFF, of DyNeRF (Neural 3D Video) and of NVIDIA's dynamic scenes as
//! NSFF and DynamicNeRF store them.
//!
//! An array of cameras × 17: for each camera a row-major 3×5 matrix, and the nearest and the farthest
//! depth. The matrix consists of `world_from_view` with the axes down, right, backwards, its translation,
//! and a column of height, width and focal length in pixels. Pixels are square, the principal point is the
//! image centre, and there is no distortion.
//!
//! The folder determines which images the rows describe:
//!
//! | beside the file | a row describes | trained on | test |
//! |---|---|---|---|
//! | `cam00.mp4`, … or `cam00/images/`, … | a static camera | the other cameras | the first camera |
//! | `images/`, `mv_images/TTTTT/camCC.jpg` | frame t | `images/` | `mv_images`: time t, other cameras |
//! | `images/` | an image | `images/` | every eighth, held out by the commands |
//!
//! Source: the readme of Fyusion/LLFF; facebookresearch/Neural_3D_Video; `load_llff.py` and
//! `evaluation.py` of zhengqili/Neural-Scene-Flow-Fields.

use std::path::{Path, PathBuf};

use glam::{DMat3, DVec3};

use super::{Dataset, Frame, fit_to_image, fit_to_size, images, npy, video};
use crate::types::{Camera, Intrinsics, Pose, range};
use crate::{Error, Result};

/// The file's name.
const NAME: &str = "poses_bounds.npy";
/// Numbers per row.
const ROW: usize = 17;

/// Sibling folders that only a video's frames have: masks and flow of the movers.
const OF_VIDEO: [&str; 5] = ["mv_images", "motion_masks", "background_mask", "flow", "flow_i1"];

/// A camera of the file.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Row {
    /// The camera at its calibrated size.
    pub camera: Camera,
    /// Depth of the nearest and the farthest visible point, in world units.
    pub bounds: [f64; 2],
}

/// Whether a folder contains the file.
pub(super) fn is_root(folder: &Path) -> bool {
    folder.join(NAME).is_file()
}

/// Whether a folder's file describes several cameras with several images each.
pub(super) fn of_several_cameras(folder: &Path) -> bool {
    let any = || cameras(folder).is_ok_and(|found| !found.is_empty());
    is_root(folder) && (folder.join("mv_images").is_dir() || any())
}

/// The dataset that an image folder (`images_4`) belongs to.
pub(super) fn root_of(pictures: &Path) -> Option<PathBuf> {
    let root = pictures.parent().filter(|root| is_root(root))?;
    let named = pictures.file_name()?.to_str()?.starts_with("images");
    named.then(|| root.to_path_buf())
}

/// Reads the file.
///
/// # Errors
/// [`Error::Io`]; [`Error::Format`] with the row: the array has another shape, or a matrix is not that of a
/// camera.
pub fn read_rows(path: &Path) -> Result<Vec<Row>> {
    let array = npy::read(path)?;
    let [_, ROW] = array.shape[..] else {
        let what = format!("holds an array of shape {:?}, and not of cameras × {ROW}", array.shape);
        return Err(Error::format(path, what));
    };
    let row = |(i, m): (usize, &[f64])| {
        let bad = |what: String| Error::format(path, format!("row {i}: {what}"));
        let column = |c: usize| DVec3::new(m[c], m[5 + c], m[10 + c]);
        let (down, right, backwards, centre) = (column(0), column(1), column(2), column(3));
        let (rotation, scale) =
            range::rotation_and_scale(DMat3::from_cols(right, down, -backwards)).map_err(bad)?;
        if (scale - 1.0).abs() > range::ROTATION_TOLERANCE {
            return Err(bad(format!("its matrix scales by {scale:?}, and 1 was expected")));
        }
        range::place(centre).map_err(|what| bad(format!("a camera whose place {what}")))?;
        let [height, width, focal] = column(4).to_array();
        let whole = [height, width].iter().all(|side| side.fract() == 0.0);
        let Some((width, height)) =
            images::sides(width as usize, height as usize).filter(|_| whole)
        else {
            return Err(bad(format!("an image of {width:?}×{height:?} makes no sense")));
        };
        let intrinsics = Intrinsics::centred(focal, width, height);
        intrinsics.check().map_err(bad)?;
        let bounds = [m[15], m[16]];
        if !bounds.iter().all(|bound| bound.is_finite()) {
            return Err(bad(format!("bounds {bounds:?} are no numbers")));
        }
        let view_from_world = Pose::new(rotation, centre).inverse();
        Ok(Row { camera: Camera { intrinsics, view_from_world }, bounds })
    };
    let rows: Vec<Row> =
        array.values.chunks_exact(ROW).enumerate().map(row).collect::<Result<_>>()?;
    if rows.is_empty() {
        return Err(Error::format(path, "holds no cameras"));
    }
    Ok(rows)
}

/// Reads a dataset, with `pictures` in place of `images/` where it is given.
///
/// # Errors
/// [`Error::Io`]; [`Error::Format`]: the number of images or videos differs from the number of rows, or the
/// proportions of one differ from its camera's.
pub fn read(root: &Path, pictures: Option<&Path>) -> Result<Dataset> {
    let file = root.join(NAME);
    let rows = read_rows(&file)?;
    let cameras = cameras(root)?;
    let mut set = match pictures {
        None if !cameras.is_empty() => standing(&file, &rows, &cameras)?,
        _ => moving(root, &rows, pictures)?,
    };
    set.sources.push(file);
    Ok(set)
}

/// Names of the static cameras beside a file, `cam00`, …, in order; empty where the file describes a single
/// moving camera, or where there is no such file.
///
/// # Errors
/// [`Error::Io`]: the folder cannot be read.
pub fn camera_names(root: &Path) -> Result<Vec<String>> {
    match is_root(root) {
        true => Ok(cameras(root)?.into_iter().map(|taken| taken.name).collect()),
        false => Ok(Vec::new()),
    }
}

/// Recording of a static camera: a video, or a folder of its frames.
#[derive(Clone, Debug)]
struct Taken {
    /// Name of the camera, such as `cam00`.
    name: String,
    path: PathBuf,
    is_video: bool,
}

/// Files `camNN.mp4` and folders `camNN` of a folder, in the natural order of their names; a folder takes
/// precedence over a video of the same name.
fn cameras(root: &Path) -> Result<Vec<Taken>> {
    let mut found: Vec<Taken> = Vec::new();
    for entry in std::fs::read_dir(root).map_err(Error::io(root))? {
        let path = entry.map_err(Error::io(root))?.path();
        let stem = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let number = stem.strip_prefix("cam").unwrap_or_default();
        if number.is_empty() || !number.bytes().all(|b| b.is_ascii_digit()) {
            continue;
        }
        let is_video = path.extension().is_some_and(|e| e.eq_ignore_ascii_case("mp4"));
        if is_video && path.is_file() {
            found.push(Taken { name: stem, path, is_video });
        } else if path.is_dir() {
            let inner = path.join("images");
            let path = if inner.is_dir() { inner } else { path };
            found.push(Taken { name: stem, path, is_video: false });
        }
    }
    found.sort_by(|a, b| images::natural(&a.name, &b.name).then(a.is_video.cmp(&b.is_video)));
    found.dedup_by(|b, a| a.name == b.name);
    Ok(found)
}

/// Static cameras, each with its frames. The first is the test camera.
fn standing(file: &Path, rows: &[Row], cameras: &[Taken]) -> Result<Dataset> {
    if cameras.len() != rows.len() {
        let what = format!(
            "holds {} cameras, and there are {} videos or folders beside it ({} …); one for each is expected",
            rows.len(),
            cameras.len(),
            cameras[0].name
        );
        return Err(Error::format(file, what));
    }
    let mut of_cameras = Vec::new();
    for (row, taken) in rows.iter().zip(cameras) {
        of_cameras.push(frames_of(row, taken)?);
    }
    // All cameras begin together; one may have stopped earlier.
    let last = of_cameras.iter().map(Vec::len).max().unwrap_or(0).saturating_sub(1).max(1);
    for frames in &mut of_cameras {
        for (i, frame) in frames.iter_mut().enumerate() {
            frame.time = i as f64 / last as f64;
        }
    }
    let mut set = Dataset { timed: true, ..Dataset::default() };
    let held = if of_cameras.len() > 1 { of_cameras.remove(0) } else { Vec::new() };
    set.frames = of_cameras.into_iter().flatten().collect();
    if !held.is_empty() {
        set.test = Some((set.frames.len()..set.frames.len() + held.len()).collect());
        set.frames.extend(held);
    }
    Ok(set)
}

/// The frames of a static camera.
fn frames_of(row: &Row, taken: &Taken) -> Result<Vec<Frame>> {
    let Taken { name, path, is_video } = taken;
    if *is_video {
        let extent = video::extent(path)?;
        let mut camera = row.camera;
        fit_to_size(&mut camera, path, extent.size)?;
        let frame = |number: usize| Frame {
            number: Some(number),
            ..Frame::of_image(format!("{name}/{number:04}"), path.clone(), 0.0, camera)
        };
        return Ok((0..extent.frames).map(frame).collect());
    }
    let files = images::list(path)?;
    let Some(first) = files.first() else {
        return Err(Error::format(path, "holds no images of its camera"));
    };
    // All images of a camera have one size, so only the first is read here; a deviating size is reported
    // when the image is loaded.
    let mut camera = row.camera;
    fit_to_image(&mut camera, first)?;
    let frame = |file: &PathBuf| {
        let stem = file.file_stem().unwrap_or_default().to_string_lossy();
        Frame::of_image(format!("{name}/{stem}"), file.clone(), 0.0, camera)
    };
    Ok(files.iter().map(frame).collect())
}

/// One image per row, and views of the same cameras at other times where they exist.
fn moving(root: &Path, rows: &[Row], pictures: Option<&Path>) -> Result<Dataset> {
    let folder = pictures.map_or_else(|| root.join("images"), Path::to_path_buf);
    let files = images::list(&folder)?;
    if files.len() != rows.len() {
        let what = format!(
            "holds {} images, and {NAME} {} cameras; one for each is expected",
            files.len(),
            rows.len()
        );
        return Err(Error::format(folder, what));
    }
    let of_video = OF_VIDEO.iter().find(|name| root.join(name).is_dir());
    let mut set = Dataset { timed: of_video.is_some(), ..Dataset::default() };
    if let Some(name) = of_video {
        set.notes.push(format!("{name}/ tells that the images are a video's: they have times"));
    }
    let last = files.len().saturating_sub(1).max(1) as f64;
    for (i, (file, row)) in files.iter().zip(rows).enumerate() {
        let mut camera = row.camera;
        fit_to_image(&mut camera, file)?;
        let name = file.file_name().unwrap_or_default().to_string_lossy().into_owned();
        set.frames.push(Frame::of_image(name, file.clone(), i as f64 / last, camera));
    }
    let views = root.join("mv_images");
    if views.is_dir() {
        let first = set.frames.len();
        for i in 0..files.len() {
            other_cameras(&views, i, rows, i as f64 / last, &mut set.frames)?;
        }
        set.test =
            Some((first..set.frames.len()).collect()).filter(|held: &Vec<usize>| !held.is_empty());
    }
    Ok(set)
}

/// Views at the time of frame `i` from the cameras of all rows except the one that recorded the frame. The
/// cameras recorded the frames in turn, so that frame c belongs to camera c, whose pose is in its row.
fn other_cameras(
    views: &Path,
    i: usize,
    rows: &[Row],
    time: f64,
    frames: &mut Vec<Frame>,
) -> Result<()> {
    let folder = views.join(format!("{i:05}"));
    let files = images::list(&folder)?;
    if files.is_empty() || files.len() > rows.len() {
        let what = format!(
            "holds {} images; one of each camera is expected, at most one for each of the {} rows of {NAME}",
            files.len(),
            rows.len()
        );
        return Err(Error::format(folder, what));
    }
    for (c, file) in files.iter().enumerate().filter(|(c, _)| *c != i % files.len()) {
        let mut camera = rows[c].camera;
        fit_to_image(&mut camera, file)?;
        let stem = file.file_stem().unwrap_or_default().to_string_lossy();
        frames.push(Frame::of_image(format!("{i:05}/{stem}"), file.clone(), time, camera));
    }
    Ok(())
}
