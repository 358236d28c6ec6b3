//! The crate's errors as Python exceptions.

use pyo3::create_exception;
use pyo3::exceptions::{PyException, PyValueError};
use pyo3::prelude::*;

create_exception!(
    splat4d,
    Error,
    PyException,
    "What the library reports: a missing driver, a file that cannot be read, a number out of range. \
     The text says what is wrong, where, and what to do."
);

/// The exception for an error of the crate: `ValueError` for wrong shapes, `splat4d.Error` for the rest.
pub fn raised(error: splat4d::Error) -> PyErr {
    let text = error.to_string();
    match error {
        splat4d::Error::Shape { .. } => PyValueError::new_err(text),
        _ => Error::new_err(text),
    }
}

/// The exception for a number out of its range.
pub fn out_of_range(what: String) -> PyErr {
    Error::new_err(what)
}
