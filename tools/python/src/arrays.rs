//! Conversion from and to NumPy arrays. Outputs are moved into arrays, not copied.

use numpy::{
    Element, PyArray1, PyArray2, PyArray3, PyArrayDyn, PyArrayMethods, PyUntypedArrayMethods,
};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use splat4d::types::Image;

/// A side of an expected shape.
#[derive(Clone, Copy)]
pub enum Side {
    /// Any length; the name appears in error messages.
    Any(&'static str),
    /// This length.
    Exactly(usize),
}

use Side::{Any, Exactly};

/// `value` as a NumPy array: `python/splat4d/_arrays.py` says of what.
fn numpy<'py>(value: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyAny>> {
    value.py().import("splat4d._arrays")?.call_method1("as_numpy", (value,))
}

/// The shape of what is or becomes an array.
pub fn shape(value: &Bound<'_, PyAny>) -> PyResult<Vec<usize>> {
    numpy(value)?.getattr("shape")?.extract()
}

/// `value` as a C-contiguous array of `T` with the expected shape. Accepts what `numpy` accepts; other number types
/// are converted.
pub fn of<'py, T: Element>(
    name: &str,
    value: &Bound<'py, PyAny>,
    expected: &[Side],
) -> PyResult<Bound<'py, PyArrayDyn<T>>> {
    let py = value.py();
    let array = numpy(value)?;
    let shape: Vec<usize> = array.getattr("shape")?.extract()?;
    let fits = |(side, given): (&Side, &usize)| match side {
        Any(_) => true,
        Exactly(length) => length == given,
    };
    if shape.len() != expected.len() || !expected.iter().zip(&shape).all(fits) {
        let (expected, given) = (expected_text(expected), given_text(&shape));
        let what = format!("{name}: expected an array of shape {expected}, got {given}");
        return Err(PyValueError::new_err(what));
    }
    let array = py.import("numpy")?.call_method1("ascontiguousarray", (array, T::get_dtype(py)))?;
    Ok(array.cast_into::<PyArrayDyn<T>>()?)
}

fn expected_text(sides: &[Side]) -> String {
    let sides: Vec<String> = sides
        .iter()
        .map(|side| match side {
            Any(name) => (*name).to_owned(),
            Exactly(length) => length.to_string(),
        })
        .collect();
    in_brackets(&sides)
}

fn given_text(shape: &[usize]) -> String {
    let sides: Vec<String> = shape.iter().map(usize::to_string).collect();
    in_brackets(&sides)
}

fn in_brackets(sides: &[String]) -> String {
    match sides {
        [only] => format!("({only},)"),
        _ => format!("({})", sides.join(", ")),
    }
}

/// The values of an array of the expected shape, in row-major order, and its shape.
pub fn floats(
    name: &str,
    value: &Bound<'_, PyAny>,
    expected: &[Side],
) -> PyResult<(Vec<f32>, Vec<usize>)> {
    let array = of::<f32>(name, value, expected)?;
    Ok((array.to_vec()?, array.shape().to_vec()))
}

/// The rows of an array of shape (N, `WIDTH`).
pub fn rows<const WIDTH: usize>(
    name: &str,
    value: &Bound<'_, PyAny>,
) -> PyResult<Vec<[f32; WIDTH]>> {
    Ok(in_rows(&floats(name, value, &[Any("N"), Exactly(WIDTH)])?.0))
}

/// The integers of an array of shape (N,), which must be in [0, 2³²).
pub fn words(name: &str, value: &Bound<'_, PyAny>, side: Side) -> PyResult<Vec<u32>> {
    let array = numpy(value)?;
    let kind: String = array.getattr("dtype")?.getattr("kind")?.extract()?;
    if !matches!(&kind[..], "i" | "u") {
        let given = array.getattr("dtype")?.str()?;
        return Err(PyValueError::new_err(format!("{name}: expected integers, got {given}")));
    }
    let word = |number: i64| {
        u32::try_from(number)
            .map_err(|_| PyValueError::new_err(format!("{name}: {number} is not in [0, 2³²)")))
    };
    of::<i64>(name, &array, &[side])?.to_vec()?.into_iter().map(word).collect()
}

/// Splits values into rows of `WIDTH`.
pub fn in_rows<const WIDTH: usize>(numbers: &[f32]) -> Vec<[f32; WIDTH]> {
    numbers.as_chunks().0.to_vec()
}

/// An image of a known size from an array of floats, or of unsigned bytes, which are divided by 255.
pub fn picture(
    name: &str,
    value: &Bound<'_, PyAny>,
    (width, height): (u32, u32),
    channels: u32,
) -> PyResult<Image> {
    let mut sides = vec![Exactly(height as usize), Exactly(width as usize)];
    if channels > 1 {
        sides.push(Exactly(channels as usize));
    }
    let array = numpy(value)?;
    let pixels = match array.cast::<PyArrayDyn<u8>>().is_ok() {
        true => {
            let bytes = of::<u8>(name, &array, &sides)?.to_vec()?;
            bytes.into_iter().map(|byte| f32::from(byte) / 255.0).collect()
        }
        false => floats(name, &array, &sides)?.0,
    };
    Ok(Image { width, height, channels, pixels })
}

/// An array of shape (N,).
pub fn line<T: Element>(py: Python<'_>, numbers: Vec<T>) -> Bound<'_, PyArray1<T>> {
    PyArray1::from_vec(py, numbers)
}

/// An array of shape (N, `WIDTH`).
pub fn table<const WIDTH: usize>(
    py: Python<'_>,
    rows: Vec<[f32; WIDTH]>,
) -> PyResult<Bound<'_, PyArray2<f32>>> {
    let count = rows.len();
    PyArray1::from_vec(py, rows.into_flattened()).reshape([count, WIDTH])
}

/// An array of a three-dimensional shape.
pub fn block(
    py: Python<'_>,
    numbers: Vec<f32>,
    shape: [usize; 3],
) -> PyResult<Bound<'_, PyArray3<f32>>> {
    PyArray1::from_vec(py, numbers).reshape(shape)
}

/// An image of several channels as an array of shape (height, width, channels).
pub fn of_image(py: Python<'_>, image: Image) -> PyResult<Bound<'_, PyArray3<f32>>> {
    let shape = [image.height as usize, image.width as usize, image.channels as usize];
    block(py, image.pixels, shape)
}

/// An image of one channel as an array of shape (height, width).
pub fn of_map(py: Python<'_>, image: Image) -> PyResult<Bound<'_, PyArray2<f32>>> {
    let shape = [image.height as usize, image.width as usize];
    PyArray1::from_vec(py, image.pixels).reshape(shape)
}
