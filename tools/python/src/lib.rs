//! The Python package `splat4d`: the crate's public interface as Python classes that take and return NumPy
//! arrays. `python/splat4d/__init__.py` exports them, `python/splat4d/_splat4d.pyi` has their types.
//!
//! Long calls release the GIL. Classes with device state lock it after the GIL is released, so that
//! threads can share them.

mod arrays;
mod camera;
mod deferred;
mod device;
mod error;
mod ops;
mod renderer;
mod scene;
mod settings;
mod trainer;

use pyo3::prelude::*;

/// The native part of the package `splat4d`.
#[pymodule]
mod _splat4d {
    #[pymodule_export]
    use crate::camera::Camera;
    #[pymodule_export]
    use crate::device::{Device, DeviceInfo};
    #[pymodule_export]
    use crate::error::Error;
    #[pymodule_export]
    use crate::ops::{adam, deform, deform_backward, loss, sort};
    #[pymodule_export]
    use crate::renderer::{Rendered, Renderer};
    #[pymodule_export]
    use crate::scene::Scene;
    #[pymodule_export]
    use crate::trainer::{Progress, Trainer, View};
}
