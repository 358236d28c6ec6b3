//! Vulkan devices.

use crate::error::raised;
use pyo3::prelude::*;
use splat4d::gpu;
use splat4d::vk::DeviceKind;

/// What a Vulkan device is.
#[pyclass(frozen, get_all, module = "splat4d")]
pub struct DeviceInfo {
    /// Its place in `Device.list()`; `str(index)` selects it.
    index: usize,
    /// Name, as the driver gives it.
    name: String,
    /// `"discrete"`, `"integrated"`, `"virtual"`, `"software"` or `"other"`.
    kind: &'static str,
    /// Name and version of the driver.
    driver: String,
    /// Bytes of its largest heap of own memory.
    memory_bytes: u64,
}

impl DeviceInfo {
    fn of(info: &gpu::DeviceInfo) -> DeviceInfo {
        let kind = match info.kind {
            DeviceKind::Discrete => "discrete",
            DeviceKind::Integrated => "integrated",
            DeviceKind::Virtual => "virtual",
            DeviceKind::Software => "software",
            DeviceKind::Other => "other",
        };
        DeviceInfo {
            index: info.index,
            name: info.name.clone(),
            kind,
            driver: info.driver.clone(),
            memory_bytes: info.memory_bytes,
        }
    }
}

#[pymethods]
impl DeviceInfo {
    fn __repr__(&self) -> String {
        let DeviceInfo { index, name, kind, driver, .. } = self;
        format!("DeviceInfo(index={index}, name={name:?}, kind={kind:?}, driver={driver:?})")
    }
}

/// An open Vulkan device.
///
/// `selector` is `"best"` (the best GPU, else a software driver), `"gpu"`, `"discrete"`, `"integrated"`,
/// `"virtual"`, `"software"` (or `"cpu"`), a number of `Device.list()`, or a part of a name.
///
/// Raises `splat4d.Error` where there is no Vulkan loader or driver (the text names the package to
/// install), or where no device fits.
#[pyclass(frozen, module = "splat4d")]
pub struct Device {
    pub device: gpu::Device,
}

#[pymethods]
impl Device {
    #[new]
    #[pyo3(signature = (selector = "best"))]
    fn new(py: Python<'_>, selector: &str) -> PyResult<Device> {
        let request = gpu::Request { selector: selector.into(), ..Default::default() };
        let device = py.detach(|| gpu::Device::open(&request)).map_err(raised)?;
        Ok(Device { device })
    }

    /// All devices that can be opened.
    ///
    /// Raises `splat4d.Error` where there is no Vulkan loader or driver.
    #[staticmethod]
    fn list(py: Python<'_>) -> PyResult<Vec<DeviceInfo>> {
        let found = py.detach(splat4d::vk::enumerate).map_err(raised)?;
        Ok(found.iter().map(DeviceInfo::of).collect())
    }

    /// What the device is.
    #[getter]
    fn info(&self) -> DeviceInfo {
        DeviceInfo::of(self.device.info())
    }

    /// Name, as the driver gives it.
    #[getter]
    fn name(&self) -> &str {
        &self.device.info().name
    }

    /// Bytes of the library's buffers on the device: now, and the most there ever were.
    #[getter]
    fn memory(&self) -> (u64, u64) {
        self.device.memory()
    }

    fn __repr__(&self) -> String {
        format!("Device({:?})", self.name())
    }
}
