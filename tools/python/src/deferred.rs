//! Arrays that stay on the device until Python reads them: the depth and the gradients of a step with the caller's
//! loss. What nothing reads is never copied.

use crate::error::raised;
use crate::trainer::State;
use numpy::{PyArray1, PyArrayDyn, PyArrayMethods};
use pyo3::exceptions::PyKeyError;
use pyo3::prelude::*;
use pyo3::sync::MutexExt;
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, Weak};

/// An array of a step with the caller's loss.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Array {
    /// The depth of the rendered image; the others are gradients.
    Depth,
    Positions,
    LogScales,
    Rotations,
    OpacityLogits,
    Sh,
    Pose,
    ControlLogRadii,
    ControlPaths,
    Network,
}

impl Array {
    /// The array's name in Python.
    pub fn name(self) -> &'static str {
        match self {
            Array::Depth => "depth",
            Array::Positions => "positions",
            Array::LogScales => "log_scales",
            Array::Rotations => "rotations",
            Array::OpacityLogits => "opacity_logits",
            Array::Sh => "sh",
            Array::Pose => "pose",
            Array::ControlLogRadii => "control_log_radii",
            Array::ControlPaths => "control_paths",
            Array::Network => "network",
        }
    }
}

/// The arrays that have not been read: `None` on the device, `Some` where the step has ended since. The trainer
/// fills them before their memory on the device changes.
pub type Unread = Mutex<BTreeMap<Array, Option<Vec<f32>>>>;

/// Arrays and their shapes.
pub type Shapes = Vec<(Array, Vec<usize>)>;

/// Arrays of a step, each read at most once.
pub struct Deferred {
    /// Weak, so that a result that outlives the trainer holds none of the device's memory.
    state: Weak<Mutex<State>>,
    shapes: Shapes,
    unread: Arc<Unread>,
    arrays: Mutex<BTreeMap<Array, Py<PyArrayDyn<f32>>>>,
}

impl Deferred {
    /// Arrays that the trainer has on its device; `unread` is what it knows of them.
    pub fn new(state: &Arc<Mutex<State>>, shapes: Shapes, unread: Arc<Unread>) -> Deferred {
        let state = Arc::downgrade(state);
        Deferred { state, shapes, unread, arrays: Mutex::default() }
    }

    /// An array, copied from the device when it is asked for first.
    pub fn get<'py>(&self, py: Python<'py>, array: Array) -> PyResult<Bound<'py, PyArrayDyn<f32>>> {
        // Held while another thread may take the GIL: whoever waits for it must not hold the GIL.
        let mut arrays = self.arrays.lock_py_attached(py).expect("no holder panics");
        if let Some(known) = arrays.get(&array) {
            return Ok(known.bind(py).clone());
        }
        let read = || {
            let state = self.state.upgrade();
            let mut state = state.as_ref().map(|state| state.lock().expect("no holder panics"));
            let unread = self.unread.lock().expect("no holder panics").remove(&array);
            match (unread, &mut state) {
                (Some(Some(kept)), _) => Ok(kept),
                (Some(None), Some(state)) => state.download(array),
                _ => Err(gone(array)),
            }
        };
        let values = py.detach(read).map_err(raised)?;
        let shape = self.shapes.iter().find(|(of, _)| *of == array).map(|(_, shape)| shape.clone());
        let made = PyArray1::from_vec(py, values).reshape(shape.unwrap_or_default())?;
        arrays.insert(array, made.clone().unbind());
        Ok(made)
    }
}

/// The error for an array that the device no longer has: the step failed before the array was read.
pub fn gone(array: Array) -> splat4d::Error {
    let what = format!("{}: the step has failed, and its arrays are gone", array.name());
    splat4d::Error::Input(what)
}

/// The gradients of a step, for `python/splat4d/_gradients.py`.
#[pyclass(frozen, module = "splat4d")]
pub struct GradientSource {
    pub deferred: Deferred,
}

#[pymethods]
impl GradientSource {
    /// The names of the arrays.
    fn names(&self) -> Vec<&'static str> {
        self.deferred.shapes.iter().map(|(array, _)| array.name()).collect()
    }

    /// The array of this name.
    fn read<'py>(&self, py: Python<'py>, name: &str) -> PyResult<Bound<'py, PyArrayDyn<f32>>> {
        let mut arrays = self.deferred.shapes.iter().map(|(array, _)| *array);
        match arrays.find(|array| array.name() == name) {
            Some(array) => self.deferred.get(py, array),
            None => Err(PyKeyError::new_err(name.to_owned())),
        }
    }
}
