//! The classes of rendering: `Renderer` and `Rendered`.

use crate::arrays;
use crate::camera::Camera;
use crate::deferred::{Array, Deferred};
use crate::device::Device;
use crate::error::raised;
use crate::scene::Scene;
use numpy::{PyArray2, PyArray3, PyArrayMethods, PyUntypedArrayMethods};
use pyo3::prelude::*;
use splat4d::renderer;
use splat4d::types::Image;
use std::sync::{Mutex, MutexGuard};

/// A rendered image: colour, alpha and depth.
#[pyclass(frozen, module = "splat4d")]
pub struct Rendered {
    /// Premultiplied colour without background, and alpha; float32 of shape (height, width, 4).
    #[pyo3(get)]
    rgba: Py<PyArray3<f32>>,
    depth: Depth,
}

enum Depth {
    Here(Py<PyArray2<f32>>),
    /// On a trainer's device until it is read.
    Deferred(Deferred),
}

impl Rendered {
    /// Moves the crate's images into NumPy arrays.
    pub fn of(py: Python<'_>, rendered: renderer::Rendered) -> PyResult<Rendered> {
        let depth = Depth::Here(arrays::of_map(py, rendered.depth)?.unbind());
        Ok(Rendered { rgba: arrays::of_image(py, rendered.rgba)?.unbind(), depth })
    }

    /// An image whose depth stays on the device until it is read.
    pub fn with_depth(py: Python<'_>, rgba: Image, depth: Deferred) -> PyResult<Rendered> {
        let rgba = arrays::of_image(py, rgba)?.unbind();
        Ok(Rendered { rgba, depth: Depth::Deferred(depth) })
    }

    /// The colour as the crate's image. The depth stays empty: compositing does not read it.
    fn colour(&self, py: Python<'_>) -> PyResult<renderer::Rendered> {
        let rgba = self.rgba.bind(py);
        let (height, width) = (rgba.shape()[0] as u32, rgba.shape()[1] as u32);
        Ok(renderer::Rendered {
            rgba: Image { width, height, channels: 4, pixels: rgba.to_vec()? },
            depth: Image { width, height, channels: 1, pixels: Vec::new() },
        })
    }
}

#[pymethods]
impl Rendered {
    /// Depths (camera z, in world units) summed with their blending weights: divided by alpha, this is the
    /// mean depth; float32 of shape (height, width). That of `Trainer.forward` is copied from the device when
    /// it is read.
    #[getter]
    fn depth<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f32>>> {
        match &self.depth {
            Depth::Here(depth) => Ok(depth.bind(py).clone()),
            Depth::Deferred(depth) => Ok(depth.get(py, Array::Depth)?.cast_into()?),
        }
    }

    /// The colour composited over a background (red, green, blue); float32 of shape (height, width, 3).
    #[pyo3(signature = (background = [0.0; 3]))]
    fn over<'py>(
        &self,
        py: Python<'py>,
        background: [f32; 3],
    ) -> PyResult<Bound<'py, PyArray3<f32>>> {
        let images = self.colour(py)?;
        let image = py.detach(|| images.over(background));
        arrays::of_image(py, image)
    }

    /// Mean depth (camera z, in world units), 0 where alpha is 1e-3 or less; float32 of shape (height,
    /// width).
    fn mean_depth<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f32>>> {
        let mut images = self.colour(py)?;
        images.depth.pixels = self.depth(py)?.to_vec()?;
        let image = py.detach(|| images.mean_depth());
        arrays::of_map(py, image)
    }
}

/// Renders a scene on a device from any camera at any time. The scene is copied: later changes to it have no
/// effect on the renderer.
///
/// Raises `splat4d.Error` if the device runs out of memory.
#[pyclass(frozen, module = "splat4d")]
pub struct Renderer {
    renderer: Mutex<renderer::Renderer>,
}

impl Renderer {
    /// Locks the renderer. Must be called without the GIL: another thread may hold the lock and wait for the
    /// GIL.
    fn lock(&self) -> MutexGuard<'_, renderer::Renderer> {
        self.renderer.lock().expect("no holder panics")
    }
}

#[pymethods]
impl Renderer {
    #[new]
    fn new(py: Python<'_>, device: &Device, scene: &Scene) -> PyResult<Renderer> {
        let (device, scene) = (&device.device, &scene.scene);
        let made = py.detach(|| renderer::Renderer::new(device, scene)).map_err(raised)?;
        Ok(Renderer { renderer: Mutex::new(made) })
    }

    /// Renders the scene from `camera` at `time` in [0, 1], and waits for the device. The same scene, camera,
    /// time, device and driver give the same bits.
    ///
    /// Raises `splat4d.Error` for a time out of range, or if the device runs out of memory.
    #[pyo3(signature = (camera, time = 0.0))]
    fn render(&self, py: Python<'_>, camera: &Camera, time: f64) -> PyResult<Rendered> {
        let camera = camera.camera;
        let rendered = py.detach(|| self.lock().render(&camera, time)).map_err(raised)?;
        Rendered::of(py, rendered)
    }

    /// The part of each pixel's alpha that comes from moving Gaussians, between 0 and alpha; float32 of shape
    /// (height, width).
    ///
    /// Raises as `render` does.
    #[pyo3(signature = (camera, time = 0.0))]
    fn moving<'py>(
        &self,
        py: Python<'py>,
        camera: &Camera,
        time: f64,
    ) -> PyResult<Bound<'py, PyArray2<f32>>> {
        let camera = camera.camera;
        let moving = || {
            let mut renderer = self.lock();
            renderer.render(&camera, time)?;
            renderer.moving()
        };
        arrays::of_map(py, py.detach(moving).map_err(raised)?)
    }

    /// Normals: unit vectors in the camera's frame that point toward the camera, 0 in empty pixels; float32
    /// of shape (height, width, 3).
    ///
    /// Raises as `render` does.
    #[pyo3(signature = (camera, time = 0.0))]
    fn normals<'py>(
        &self,
        py: Python<'py>,
        camera: &Camera,
        time: f64,
    ) -> PyResult<Bound<'py, PyArray3<f32>>> {
        let camera = camera.camera;
        let normals = || {
            let mut renderer = self.lock();
            renderer.render(&camera, time)?;
            renderer.normals(&camera, time)
        };
        arrays::of_image(py, py.detach(normals).map_err(raised)?)
    }

    /// Number of Gaussians.
    fn __len__(&self, py: Python<'_>) -> usize {
        py.detach(|| self.lock().len())
    }
}
