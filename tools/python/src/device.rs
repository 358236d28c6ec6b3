//! Vulkan devices.

use crate::error::raised;
use pyo3::prelude::*;
use splat4d::gpu;
use splat4d::vk::DeviceKind;

/// A description of a Vulkan device.
#[pyclass(frozen, get_all, module = "splat4d")]
pub struct DeviceInfo {
    /// Index in `Device.list()`; `str(index)` selects the device.
    index: usize,
    /// Name that the driver reports.
    name: String,
    /// `"discrete"`, `"integrated"`, `"virtual"`, `"software"` or `"other"`.
    kind: &'static str,
    /// Name and version of the driver.
    driver: String,
    /// Size of the largest device-local memory heap, bytes.
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
/// `"virtual"`, `"software"` (or `"cpu"`), an index in `Device.list()` as a string, or a part of a name.
///
/// Raises `splat4d.Error` if there is no Vulkan loader or driver (the message names the package to
/// install), or if no device matches.
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
    /// Raises `splat4d.Error` if there is no Vulkan loader or driver.
    #[staticmethod]
    fn list(py: Python<'_>) -> PyResult<Vec<DeviceInfo>> {
        let found = py.detach(splat4d::vk::enumerate).map_err(raised)?;
        Ok(found.iter().map(DeviceInfo::of).collect())
    }

    /// The description of the device.
    #[getter]
    fn info(&self) -> DeviceInfo {
        DeviceInfo::of(self.device.info())
    }

    /// Name that the driver reports.
    #[getter]
    fn name(&self) -> &str {
        &self.device.info().name
    }

    /// Bytes that the engine's buffers take on the device: current and peak.
    #[getter]
    fn memory(&self) -> (u64, u64) {
        self.device.memory()
    }

    fn __repr__(&self) -> String {
        format!("Device({:?})", self.name())
    }
}
