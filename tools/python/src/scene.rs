//! Scenes on the host.

use crate::arrays::{self, Side::Any, Side::Exactly};
use crate::camera::Camera;
use crate::error::{out_of_range, raised};
use numpy::{PyArray1, PyArrayMethods};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use splat4d::camera_path::{CameraPath, PathShape};
use splat4d::scene::{self, Format, SceneCamera};
use splat4d::types::{RenderSettings, range, sh_coefficients};
use std::path::PathBuf;
use std::sync::Arc;

/// Most views of a camera path, as the command `render` has it.
const MOST_VIEWS: usize = 1_000_000;

/// A scene: Gaussians, and in a moving scene the control points that they follow.
///
/// A scene is built from arrays, given by name (as in `set_arrays`):
///
/// - `positions`, shape (N, 3): centres in world coordinates; in a moving scene, in the canonical frame.
/// - `log_scales`, (N, 3): natural logarithms of the standard deviations along the Gaussian's local axes.
/// - `rotations`, (N, 4): `world_from_gaussian` quaternions w, x, y, z; they need not be of unit length.
/// - `opacity_logits`, (N,): logits of the opacity.
/// - `sh`, (N, K, 3): coefficients of the spherical harmonics, lowest band first, red, green and blue;
///   K is 1, 4, 9 or 16, for degrees 0 to 3.
/// - `motion_logits`, (N,), or (0,) in a static scene: a Gaussian follows the control points if its value is
///   above 0.
/// - `control_positions`, (M, 3): control points in the canonical frame.
/// - `control_log_radii`, (M,): natural logarithms of the radii of their influence.
/// - `control_paths`, (T, M, 8): motions of the control points at T evenly spaced times, the first at 0, the
///   last at 1. Each motion holds a translation (3), an offset (1) that is added to the opacity logits of the
///   Gaussians that follow the control point, and the rotation's offset (4) from the quaternion (1, 0, 0, 0).
///
/// Arrays are copied, and converted to float32 if they have another type.
///
/// Raises `ValueError` for arrays whose shapes do not agree, `splat4d.Error` for numbers out of range.
#[pyclass(module = "splat4d")]
pub struct Scene {
    pub scene: Arc<scene::Scene>,
    dropped: usize,
}

impl Scene {
    /// Wraps a scene of the crate.
    pub fn of(scene: scene::Scene) -> Scene {
        Scene { scene: Arc::new(scene), dropped: 0 }
    }
}

#[pymethods]
impl Scene {
    #[new]
    #[pyo3(signature = (*, background = [0.0; 3], **arrays))]
    fn new(background: [f32; 3], arrays: Option<&Bound<'_, PyDict>>) -> PyResult<Scene> {
        let mut made = Scene::of(scene::Scene { background, ..Default::default() });
        made.set_arrays(arrays)?;
        Ok(made)
    }

    /// Opens a scene file, or Gaussians in another format: 3DGS PLY (plain or compressed), SPZ, SOG or
    /// `.splat`. With `drop_bad`, Gaussians with NaN, infinite or out-of-range values are left out and
    /// counted in `dropped`; otherwise they are an error.
    ///
    /// Raises `splat4d.Error` for a missing or malformed file; the message names the file.
    #[staticmethod]
    #[pyo3(signature = (path, *, drop_bad = false))]
    fn open(py: Python<'_>, path: PathBuf, drop_bad: bool) -> PyResult<Scene> {
        let opened = py.detach(|| scene::Scene::open(path, drop_bad)).map_err(raised)?;
        Ok(Scene { scene: Arc::new(opened.scene), dropped: opened.dropped })
    }

    /// Writes a scene file (safetensors), from which the arrays are read back bit for bit. The file is
    /// replaced atomically.
    ///
    /// Raises `splat4d.Error` if the file cannot be written.
    fn save(&self, py: Python<'_>, path: PathBuf) -> PyResult<()> {
        let scene = self.scene.clone();
        py.detach(|| scene.save(path)).map_err(raised)
    }

    /// Writes the Gaussians, in the canonical frame. The file name's extension selects the format: `.ply`,
    /// `.compressed.ply`, `.splat`, `.spz` or `.glb`. Motion is not written, nor are spherical harmonics that
    /// the format cannot store. Returns the number of Gaussians written.
    ///
    /// Raises `ValueError` for another extension, `splat4d.Error` if the file cannot be written.
    fn export(&self, py: Python<'_>, path: PathBuf) -> PyResult<usize> {
        let format = Format::of(&path).ok_or_else(|| {
            let path = path.display();
            let what = "expected a name that ends with .ply, .compressed.ply, .splat, .spz or .glb";
            PyValueError::new_err(format!("{path}: {what}"))
        })?;
        let scene = self.scene.clone();
        py.detach(|| format.write(path, &scene.gaussians)).map_err(raised)
    }

    /// The interactive page of the scene, as the command `export SCENE -o FILE.html` writes it. As the last
    /// expression of a notebook's cell it is shown there, `height` CSS pixels high. The page begins at the first
    /// input camera. `device` is a selector as in `Device`; it renders the comparison with the compact scene
    /// that the page holds, and finds the paths of a scene that a network moves.
    ///
    /// Raises `splat4d.Error` as the command does, for example for more Gaussians than a page plays.
    #[pyo3(signature = (*, height = 480, device = "best"))]
    fn show<'py>(slf: &Bound<'py, Self>, height: u32, device: &str) -> PyResult<Bound<'py, PyAny>> {
        slf.py().import("splat4d._page")?.call_method1("show", (slf, height, device))
    }

    /// All arrays by name, as copies.
    fn arrays<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let (g, points) = (&self.scene.gaussians, &self.scene.control_points);
        let dict = PyDict::new(py);
        dict.set_item("positions", arrays::table(py, g.positions.clone())?)?;
        dict.set_item("log_scales", arrays::table(py, g.log_scales.clone())?)?;
        dict.set_item("rotations", arrays::table(py, g.rotations.clone())?)?;
        dict.set_item("opacity_logits", arrays::line(py, g.opacity_logits.clone()))?;
        let shape = [g.len(), sh_coefficients(g.sh_degree), 3];
        dict.set_item("sh", arrays::block(py, g.sh.as_flattened().to_vec(), shape)?)?;
        dict.set_item("motion_logits", arrays::line(py, g.motion_logits.clone()))?;
        dict.set_item("control_positions", arrays::table(py, points.positions.clone())?)?;
        dict.set_item("control_log_radii", arrays::line(py, points.log_radii.clone()))?;
        let shape = [points.keys(), points.len(), 8];
        let paths = points.paths.as_flattened().to_vec();
        dict.set_item("control_paths", arrays::block(py, paths, shape)?)?;
        Ok(dict)
    }

    /// Replaces arrays by name; the others stay as they are. If an error is raised, nothing changes.
    ///
    /// Raises `TypeError` for an unknown name (the class documentation lists the names), `ValueError` for
    /// arrays whose shapes do not agree, `splat4d.Error` for numbers out of range.
    #[pyo3(signature = (**arrays))]
    fn set_arrays(&mut self, arrays: Option<&Bound<'_, PyDict>>) -> PyResult<()> {
        let mut scene = scene::Scene::clone(&self.scene);
        // Paths that are not given keep their shape, that of the previous control points.
        let before = &self.scene.control_points;
        let mut paths = (before.keys() > 0).then_some(before.len());
        for (name, value) in arrays.into_iter().flatten() {
            paths = set(&mut scene, &name.extract::<String>()?, &value)?.or(paths);
        }
        check_lengths(&scene, paths)?;
        scene.check().map_err(out_of_range)?;
        self.scene = Arc::new(scene);
        Ok(())
    }

    /// Number of Gaussians.
    fn __len__(&self) -> usize {
        self.scene.gaussians.len()
    }

    /// Degree of the spherical harmonics, 0 to 3.
    #[getter]
    fn sh_degree(&self) -> u32 {
        self.scene.gaussians.sh_degree
    }

    /// Whether the scene moves.
    #[getter]
    fn moves(&self) -> bool {
        self.scene.moves()
    }

    /// Number of Gaussians that `open` left out because of bad values.
    #[getter]
    fn dropped(&self) -> usize {
        self.dropped
    }

    /// The background colour: red, green and blue in [0, 1].
    #[getter]
    fn background(&self) -> [f32; 3] {
        self.scene.background
    }

    #[setter]
    fn set_background(&mut self, background: [f32; 3]) -> PyResult<()> {
        splat4d::types::range::colour(background)
            .map_err(|what| out_of_range(format!("background: {what}")))?;
        Arc::make_mut(&mut self.scene).background = background;
        Ok(())
    }

    /// The constants of projection and blending, by name:
    ///
    /// - `near`: splats whose centre has a smaller depth, in world units, are culled.
    /// - `dilation`: added to both variances of the projected 2D covariance, square pixels.
    /// - `alpha_cut`: a splat does not contribute to a pixel where its alpha is smaller.
    /// - `alpha_cap`: upper limit of alpha.
    /// - `transmittance_stop`: blending stops before the splat that would bring the transmittance to this
    ///   value or below.
    /// - `tangent_clamp`: the projection's Jacobian is evaluated at tangents clamped to this many half fields
    ///   of view.
    #[getter]
    fn blending<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let mut settings = self.scene.settings;
        let dict = PyDict::new(py);
        for (name, value) in constants(&mut settings) {
            dict.set_item(name, *value)?;
        }
        Ok(dict)
    }

    /// Sets constants of projection and blending by name (see `blending`); the others stay as they are.
    ///
    /// Raises `TypeError` for an unknown name, `splat4d.Error` for a number out of range.
    #[pyo3(signature = (**constants))]
    fn set_blending(&mut self, constants: Option<&Bound<'_, PyDict>>) -> PyResult<()> {
        let mut settings = self.scene.settings;
        for (name, value) in constants.into_iter().flatten() {
            let name: String = name.extract()?;
            let mut known = self::constants(&mut settings).into_iter();
            let Some((_, constant)) = known.find(|(known, _)| *known == name) else {
                return Err(PyTypeError::new_err(format!("blending has no constant {name:?}")));
            };
            *constant = value.extract()?;
        }
        settings.check().map_err(out_of_range)?;
        Arc::make_mut(&mut self.scene).settings = settings;
        Ok(())
    }

    /// The world direction that points up in the images: a unit vector.
    #[getter]
    fn up(&self) -> [f32; 3] {
        self.scene.up
    }

    /// The input cameras, in order of time.
    #[getter]
    fn cameras(&self) -> Vec<Camera> {
        self.scene.cameras.iter().map(|known| Camera { camera: known.camera }).collect()
    }

    /// The times of the input cameras, in [0, 1]; float64 of shape (C,).
    #[getter]
    fn times<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        arrays::line(py, self.scene.cameras.iter().map(|known| known.time).collect())
    }

    /// Replaces the input cameras, and sets `up` to the mean of their upward axes. `times`, shape (C,), has
    /// one time in [0, 1] per camera, in ascending order.
    ///
    /// Raises `ValueError` if the number of times differs from the number of cameras or the times are not in
    /// ascending order, `splat4d.Error` for a time out of range.
    fn set_cameras(&mut self, cameras: Vec<Camera>, times: &Bound<'_, PyAny>) -> PyResult<()> {
        let times = arrays::of::<f64>("times", times, &[Exactly(cameras.len())])?.to_vec()?;
        if !times.is_sorted() {
            return Err(PyValueError::new_err("times: expected ascending order"));
        }
        let mut scene = scene::Scene::clone(&self.scene);
        let known = |(camera, time): (&Camera, f64)| SceneCamera { time, camera: camera.camera };
        scene.cameras = cameras.iter().zip(times).map(known).collect();
        scene.check().map_err(out_of_range)?;
        scene.set_up_from_cameras();
        self.scene = Arc::new(scene);
        Ok(())
    }

    /// Cameras on a path around the scene: views that the input did not have, as the command
    /// `render --path SHAPE` renders them. `shape` is one of:
    ///
    /// - `"orbit"`: a gentle ellipse around the input's camera, or once around a scene without cameras.
    /// - `"spiral"`: twice around, each turn wider, while the camera moves forward and back.
    /// - `"dolly"`: forward along the line of sight.
    /// - `"bullet"`: the ellipse of an orbit while time stands at `time`, in [0, 1], by default 0.5.
    ///
    /// Returns `frames` cameras, 1 to 1,000,000, and their times, float64 of shape (C,): for each camera a time for
    /// `Renderer.render`. Times run from 0 to 1, but for a bullet. Poses are in the scene's world frame, with
    /// OpenCV's camera axes (`Camera.view_from_world`, shape (4, 4)). Intrinsics are the input's; without input
    /// cameras, images are of 960 × 540 pixels. `size`, (width, height) in pixels, is another image size: the whole
    /// field of view stays in the image. `focal` is another focal length, in pixels of the image.
    ///
    /// The input's own path is `cameras` and `times`.
    ///
    /// Raises `ValueError` for another shape or number of frames, and for a `time` with a shape other than
    /// `"bullet"`; `splat4d.Error` for a time out of range, and where a camera cannot be rendered from.
    #[pyo3(signature = (shape = "orbit", *, frames = 60, time = None, size = None, focal = None))]
    fn camera_path<'py>(
        &self,
        py: Python<'py>,
        shape: &str,
        frames: usize,
        time: Option<f64>,
        size: Option<(u32, u32)>,
        focal: Option<f64>,
    ) -> PyResult<(Vec<Camera>, Bound<'py, PyArray1<f64>>)> {
        let known = PathShape::named(shape).ok_or_else(|| {
            let what = "expected \"orbit\", \"spiral\", \"dolly\" or \"bullet\"";
            PyValueError::new_err(format!("shape: {what}, got {shape:?}"))
        })?;
        if !(1..=MOST_VIEWS).contains(&frames) {
            let what = format!("frames: expected 1 to {MOST_VIEWS}, got {frames}");
            return Err(PyValueError::new_err(what));
        }
        if time.is_some() && known != PathShape::Bullet {
            let what = format!("time: {shape:?} has times of its own; only \"bullet\" takes one");
            return Err(PyValueError::new_err(what));
        }
        time.map_or(Ok(()), range::time).map_err(out_of_range)?;
        let scene = self.scene.clone();
        let views = py.detach(|| {
            let path = CameraPath::new(&scene, known, frames);
            let view = |i| {
                let mut view = time.map_or_else(|| path.at(i), |time| path.at_time(i, time));
                let k = &mut view.camera.intrinsics;
                if let Some((width, height)) = size {
                    *k = k.fitted(width, height);
                }
                if let Some(focal) = focal {
                    (k.fx, k.fy) = (focal, focal);
                }
                view.camera.check().map_err(|what| {
                    format!("camera {i} of the path cannot be rendered from: {what}")
                })?;
                Ok(view)
            };
            (0..path.len()).map(view).collect::<Result<Vec<SceneCamera>, String>>()
        });
        let views = views.map_err(out_of_range)?;
        let times = arrays::line(py, views.iter().map(|view| view.time).collect());
        let cameras = views.into_iter().map(|view| Camera { camera: view.camera });
        Ok((cameras.collect(), times))
    }

    /// What a notebook shows of a scene: the page of `show()`.
    fn _repr_html_<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        slf.call_method0("show")?.call_method0("_repr_html_")
    }

    fn __repr__(&self) -> String {
        let scene = &self.scene;
        let (count, degree) = (scene.gaussians.len(), scene.gaussians.sh_degree);
        let (points, cameras) = (scene.control_points.len(), scene.cameras.len());
        format!(
            "<splat4d.Scene: {count} Gaussians of degree {degree}, {points} control points, {cameras} \
             cameras>"
        )
    }
}

fn constants(settings: &mut RenderSettings) -> [(&'static str, &mut f32); 6] {
    let RenderSettings { near, dilation, alpha_cut, alpha_cap, transmittance_stop, tangent_clamp } =
        settings;
    [
        ("near", near),
        ("dilation", dilation),
        ("alpha_cut", alpha_cut),
        ("alpha_cap", alpha_cap),
        ("transmittance_stop", transmittance_stop),
        ("tangent_clamp", tangent_clamp),
    ]
}

/// Sets one array. Returns the number of control points if the array is `control_paths`.
fn set(scene: &mut scene::Scene, name: &str, value: &Bound<'_, PyAny>) -> PyResult<Option<usize>> {
    let (g, points) = (&mut scene.gaussians, &mut scene.control_points);
    match name {
        "positions" => g.positions = arrays::rows(name, value)?,
        "log_scales" => g.log_scales = arrays::rows(name, value)?,
        "rotations" => g.rotations = arrays::rows(name, value)?,
        "opacity_logits" => g.opacity_logits = arrays::floats(name, value, &[Any("N")])?.0,
        "sh" => {
            let (numbers, shape) = arrays::floats(name, value, &[Any("N"), Any("K"), Exactly(3)])?;
            let degree = (0..=3).find(|&degree| sh_coefficients(degree) == shape[1]);
            g.sh_degree = degree.ok_or_else(|| {
                let what = format!("sh: expected K of 1, 4, 9 or 16, got {}", shape[1]);
                PyValueError::new_err(what)
            })?;
            g.sh = arrays::in_rows(&numbers);
        }
        "motion_logits" => g.motion_logits = arrays::floats(name, value, &[Any("N")])?.0,
        "control_positions" => points.positions = arrays::rows(name, value)?,
        "control_log_radii" => points.log_radii = arrays::floats(name, value, &[Any("M")])?.0,
        "control_paths" => {
            let sides = [Any("T"), Any("M"), Exactly(8)];
            let (numbers, shape) = arrays::floats(name, value, &sides)?;
            points.paths = arrays::in_rows(&numbers);
            return Ok(Some(shape[1]));
        }
        _ => return Err(PyTypeError::new_err(format!("a scene has no array {name:?}"))),
    }
    Ok(None)
}

/// Checks that the lengths of the arrays agree. `paths` is the number of control points in `control_paths`.
fn check_lengths(scene: &scene::Scene, paths: Option<usize>) -> PyResult<()> {
    let (g, points) = (&scene.gaussians, &scene.control_points);
    let (n, m) = (g.len(), points.len());
    let rows = g.sh.len() / sh_coefficients(g.sh_degree);
    // A static scene has no motion logits.
    let moving = if g.motion_logits.is_empty() { n } else { g.motion_logits.len() };
    let paths = paths.unwrap_or(m);
    for (name, given, like, expected) in [
        ("log_scales", g.log_scales.len(), "positions", n),
        ("rotations", g.rotations.len(), "positions", n),
        ("opacity_logits", g.opacity_logits.len(), "positions", n),
        ("sh", rows, "positions", n),
        ("motion_logits", moving, "positions", n),
        ("control_log_radii", points.log_radii.len(), "control_positions", m),
        ("control_paths (at each time)", paths, "control_positions", m),
    ] {
        if given != expected {
            let what = format!("{name}: expected {expected} rows as in {like}, got {given}");
            return Err(PyValueError::new_err(what));
        }
    }
    Ok(())
}
