//! Pinhole cameras.

use crate::arrays::{self, Side::Exactly};
use crate::error::{out_of_range, raised};
use glam::{DMat3, DQuat, DVec3};
use numpy::{PyArray1, PyArray2, PyArrayMethods};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use splat4d::data::transforms::read_cameras;
use splat4d::types::{self, Intrinsics, Pose, range};
use std::path::PathBuf;

/// A pinhole camera in the world.
///
/// Axes are OpenCV's: x right, y down, z forward. `width`, `height`, `fx`, `fy`, `cx` and `cy` are in
/// pixels; the first pixel's centre lies at (0.5, 0.5). `fy` defaults to `fx`, `cx` and `cy` to the image
/// centre.
///
/// The pose is either `view_from_world`, a matrix of shape (4, 4) that maps a point from world coordinates to
/// the camera's frame, or `rotation` (a unit quaternion w, x, y, z, or a matrix of shape (3, 3)) and
/// `translation` (3) of the same transform: `x_view = rotation · x_world + translation`. Without a pose, the
/// camera is at the origin and looks along z.
///
/// Raises `ValueError` for wrong shapes, `splat4d.Error` for numbers that are not a valid camera.
#[pyclass(frozen, eq, module = "splat4d", from_py_object)]
#[derive(Clone, PartialEq)]
pub struct Camera {
    pub camera: types::Camera,
}

#[pymethods]
impl Camera {
    #[new]
    #[pyo3(signature = (width, height, *, fx, fy = None, cx = None, cy = None, view_from_world = None,
        rotation = None, translation = None))]
    fn new(
        width: u32,
        height: u32,
        fx: f64,
        fy: Option<f64>,
        cx: Option<f64>,
        cy: Option<f64>,
        view_from_world: Option<&Bound<'_, PyAny>>,
        rotation: Option<&Bound<'_, PyAny>>,
        translation: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<Camera> {
        let pose = match view_from_world {
            Some(_) if rotation.is_some() || translation.is_some() => {
                let what = "give either view_from_world, or rotation and translation";
                return Err(PyValueError::new_err(what));
            }
            Some(matrix) => pose_of_matrix(matrix)?,
            None => Pose {
                rotation: rotation.map_or(Ok(DQuat::IDENTITY), rotation_of)?,
                translation: translation.map_or(Ok(DVec3::ZERO), translation_of)?,
            },
        };
        let intrinsics = Intrinsics {
            fx,
            fy: fy.unwrap_or(fx),
            cx: cx.unwrap_or(f64::from(width) / 2.0),
            cy: cy.unwrap_or(f64::from(height) / 2.0),
            width,
            height,
        };
        let camera = types::Camera { intrinsics, view_from_world: pose };
        camera.check().map_err(|what| out_of_range(format!("camera: {what}")))?;
        Ok(Camera { camera })
    }

    /// Reads the cameras of a nerfstudio `transforms.json`, as the command `render --path FILE` does: each needs its
    /// size (`w`, `h`), and lens distortion is left out. Returns the cameras, and their times in [0, 1], float64 of
    /// shape (C,); times that the file does not have run from 0 to 1.
    ///
    /// Raises `splat4d.Error` for a missing or malformed file; the message names the file.
    #[staticmethod]
    fn read<'py>(
        py: Python<'py>,
        path: PathBuf,
    ) -> PyResult<(Vec<Camera>, Bound<'py, PyArray1<f64>>)> {
        let found = py.detach(|| read_cameras(&path)).map_err(raised)?;
        let times = arrays::line(py, found.iter().map(|timed| timed.time).collect());
        let cameras = found.into_iter().map(|timed| Camera { camera: timed.camera });
        Ok((cameras.collect(), times))
    }

    /// Image width, pixels.
    #[getter]
    fn width(&self) -> u32 {
        self.camera.intrinsics.width
    }

    /// Image height, pixels.
    #[getter]
    fn height(&self) -> u32 {
        self.camera.intrinsics.height
    }

    /// Focal length along x, pixels.
    #[getter]
    fn fx(&self) -> f64 {
        self.camera.intrinsics.fx
    }

    /// Focal length along y, pixels.
    #[getter]
    fn fy(&self) -> f64 {
        self.camera.intrinsics.fy
    }

    /// Principal point, x, from the left edge, pixels.
    #[getter]
    fn cx(&self) -> f64 {
        self.camera.intrinsics.cx
    }

    /// Principal point, y, from the upper edge, pixels.
    #[getter]
    fn cy(&self) -> f64 {
        self.camera.intrinsics.cy
    }

    /// The rotation of `view_from_world`: a quaternion w, x, y, z; shape (4,).
    #[getter]
    fn rotation<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        let r = self.camera.view_from_world.rotation;
        arrays::line(py, vec![r.w, r.x, r.y, r.z])
    }

    /// The translation of `view_from_world`; shape (3,).
    #[getter]
    fn translation<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        arrays::line(py, self.camera.view_from_world.translation.to_array().to_vec())
    }

    /// The matrix that maps a point from world coordinates to the camera's frame; shape (4, 4).
    #[getter]
    fn view_from_world<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let pose = self.camera.view_from_world;
        let (r, t) = (pose.rotation_matrix().transpose(), pose.translation);
        let rows = [r.x_axis.extend(t.x), r.y_axis.extend(t.y), r.z_axis.extend(t.z)];
        let mut matrix: Vec<f64> = rows.iter().flat_map(|row| row.to_array()).collect();
        matrix.extend([0.0, 0.0, 0.0, 1.0]);
        arrays::line(py, matrix).reshape([4, 4])
    }

    /// The camera's centre in world coordinates; shape (3,).
    #[getter]
    fn centre<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        arrays::line(py, self.camera.centre().to_array().to_vec())
    }

    /// The same camera with another image size, in pixels. The intrinsics are scaled.
    ///
    /// Raises `splat4d.Error` for a size out of range.
    fn resized(&self, width: u32, height: u32) -> PyResult<Camera> {
        let intrinsics = self.camera.intrinsics.resized(width, height);
        let camera = types::Camera { intrinsics, ..self.camera };
        camera.check().map_err(|what| out_of_range(format!("camera: {what}")))?;
        Ok(Camera { camera })
    }

    fn __repr__(&self) -> String {
        let Intrinsics { fx, fy, cx, cy, width, height } = self.camera.intrinsics;
        let Pose { rotation: r, translation: t } = self.camera.view_from_world;
        let [x, y, z] = t.to_array();
        format!(
            "Camera({width}, {height}, fx={fx:?}, fy={fy:?}, cx={cx:?}, cy={cy:?}, \
             rotation=({:?}, {:?}, {:?}, {:?}), translation=({x:?}, {y:?}, {z:?}))",
            r.w, r.x, r.y, r.z
        )
    }
}

fn numbers(name: &str, value: &Bound<'_, PyAny>, shape: &[usize]) -> PyResult<Vec<f64>> {
    let sides: Vec<_> = shape.iter().copied().map(Exactly).collect();
    Ok(arrays::of::<f64>(name, value, &sides)?.to_vec()?)
}

fn pose_of_matrix(value: &Bound<'_, PyAny>) -> PyResult<Pose> {
    let m = numbers("view_from_world", value, &[4, 4])?;
    if m[12..] != [0.0, 0.0, 0.0, 1.0] {
        let what = format!("view_from_world: the last row is {:?}, 0, 0, 0, 1 expected", &m[12..]);
        return Err(out_of_range(what));
    }
    let rotation = [m[0], m[1], m[2], m[4], m[5], m[6], m[8], m[9], m[10]];
    Ok(Pose {
        rotation: rotation_of_matrix("view_from_world", &rotation)?,
        translation: DVec3::new(m[3], m[7], m[11]),
    })
}

fn rotation_of(value: &Bound<'_, PyAny>) -> PyResult<DQuat> {
    let shape: Vec<usize> =
        value.py().import("numpy")?.call_method1("shape", (value,))?.extract()?;
    match shape.len() {
        2 => rotation_of_matrix("rotation", &numbers("rotation", value, &[3, 3])?),
        _ => {
            let q = numbers("rotation", value, &[4])?;
            Ok(DQuat::from_xyzw(q[1], q[2], q[3], q[0]))
        }
    }
}

/// The rotation of a 3 × 3 matrix, given in row-major order.
fn rotation_of_matrix(name: &str, rows: &[f64]) -> PyResult<DQuat> {
    let refused = |what: String| out_of_range(format!("camera: {name} {what}"));
    let matrix = DMat3::from_cols_slice(rows).transpose();
    let (rotation, scale) = range::rotation_and_scale(matrix).map_err(refused)?;
    if (scale - 1.0).abs() > range::ROTATION_TOLERANCE {
        return Err(refused(format!("has a scale of {scale:?}, 1 expected")));
    }
    Ok(rotation)
}

fn translation_of(value: &Bound<'_, PyAny>) -> PyResult<DVec3> {
    Ok(DVec3::from_slice(&numbers("translation", value, &[3])?))
}
