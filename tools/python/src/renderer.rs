//! Scenes on a device.

use crate::arrays;
use crate::camera::Camera;
use crate::device::Device;
use crate::error::raised;
use crate::scene::Scene;
use numpy::{PyArray2, PyArray3, PyArrayMethods, PyUntypedArrayMethods};
use pyo3::prelude::*;
use splat4d::renderer;
use splat4d::types::Image;
use std::sync::{Mutex, MutexGuard};

/// A picture as the device blended it.
#[pyclass(frozen, module = "splat4d")]
pub struct Rendered {
    /// Premultiplied colour without background, and alpha; float32 of shape (height, width, 4).
    #[pyo3(get)]
    rgba: Py<PyArray3<f32>>,
    /// The sum of depths (z in the camera, in units of the world) by their share of alpha: divided by alpha
    /// it is the mean depth; float32 of shape (height, width).
    #[pyo3(get)]
    depth: Py<PyArray2<f32>>,
}

impl Rendered {
    /// The library's images, moved into arrays.
    pub fn of(py: Python<'_>, rendered: renderer::Rendered) -> PyResult<Rendered> {
        Ok(Rendered {
            rgba: arrays::of_image(py, rendered.rgba)?.unbind(),
            depth: arrays::of_map(py, rendered.depth)?.unbind(),
        })
    }

    /// The arrays, copied into the library's images.
    fn images(&self, py: Python<'_>) -> PyResult<renderer::Rendered> {
        let (rgba, depth) = (self.rgba.bind(py), self.depth.bind(py));
        let (height, width) = (rgba.shape()[0] as u32, rgba.shape()[1] as u32);
        Ok(renderer::Rendered {
            rgba: Image { width, height, channels: 4, pixels: rgba.to_vec()? },
            depth: Image { width, height, channels: 1, pixels: depth.to_vec()? },
        })
    }
}

#[pymethods]
impl Rendered {
    /// Colour over a background of red, green and blue; float32 of shape (height, width, 3).
    #[pyo3(signature = (background = [0.0; 3]))]
    fn over<'py>(
        &self,
        py: Python<'py>,
        background: [f32; 3],
    ) -> PyResult<Bound<'py, PyArray3<f32>>> {
        let images = self.images(py)?;
        let image = py.detach(|| images.over(background));
        arrays::of_image(py, image)
    }

    /// Mean depth (z in the camera, in units of the world) where something is there, 0 elsewhere; float32
    /// of shape (height, width).
    fn mean_depth<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f32>>> {
        let images = self.images(py)?;
        let image = py.detach(|| images.mean_depth());
        arrays::of_map(py, image)
    }
}

/// A scene on a device, rendered from any camera at any time. The scene is copied: later changes of it
/// are not seen.
///
/// Raises `splat4d.Error` where the device's memory does not suffice.
#[pyclass(frozen, module = "splat4d")]
pub struct Renderer {
    renderer: Mutex<renderer::Renderer>,
}

impl Renderer {
    /// To be called without the GIL: another thread may hold the lock and wait for the GIL.
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

    /// Renders the scene as `camera` sees it at `time` in [0, 1], and waits for it. The same scene, camera,
    /// time, device and driver give the same bits.
    ///
    /// Raises `splat4d.Error` for a time out of range, or where the device's memory does not suffice.
    #[pyo3(signature = (camera, time = 0.0))]
    fn render(&self, py: Python<'_>, camera: &Camera, time: f64) -> PyResult<Rendered> {
        let camera = camera.camera;
        let rendered = py.detach(|| self.lock().render(&camera, time)).map_err(raised)?;
        Rendered::of(py, rendered)
    }

    /// How much of each pixel comes from Gaussians that move, 0 to its alpha; float32 of shape (height, width).
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

    /// Normals as unit vectors in the camera's axes, that point toward it; 0 where nothing is; float32 of
    /// shape (height, width, 3).
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
