//! Arrays of numpy. They are copied through bytes: this needs no crate and takes what `numpy.asarray` takes.

use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict};

use crate::error;

/// A number of an array.
pub(crate) trait Number: Copy {
    /// Numpy's name of the type.
    const TYPE: &'static str;
    /// Whether it is a whole number.
    const IS_WHOLE: bool;

    fn from_bytes(bytes: [u8; 8]) -> Self;
    fn into_bytes(self) -> [u8; 8];
}

impl Number for f64 {
    const TYPE: &'static str = "<f8";
    const IS_WHOLE: bool = false;

    fn from_bytes(bytes: [u8; 8]) -> Self {
        Self::from_le_bytes(bytes)
    }

    fn into_bytes(self) -> [u8; 8] {
        self.to_le_bytes()
    }
}

impl Number for i64 {
    const TYPE: &'static str = "<i8";
    const IS_WHOLE: bool = true;

    fn from_bytes(bytes: [u8; 8]) -> Self {
        Self::from_le_bytes(bytes)
    }

    fn into_bytes(self) -> [u8; 8] {
        self.to_le_bytes()
    }
}

/// An array from Python, row by row.
pub(crate) struct Array<T> {
    pub(crate) shape: Vec<usize>,
    pub(crate) numbers: Vec<T>,
}

impl<T> Array<T> {
    /// Fails if the shape is another one.
    pub(crate) fn of_shape(self, name: &str, shape: &[usize]) -> PyResult<Vec<T>> {
        if self.shape == shape {
            return Ok(self.numbers);
        }
        let sizes: Vec<String> = shape.iter().map(ToString::to_string).collect();
        let sizes = sizes.join(" x ");
        Err(error(format!("{name}: give an array of {sizes} numbers, not {:?}", self.shape)))
    }
}

impl<'a, 'py, T: Number> FromPyObject<'a, 'py> for Array<T> {
    type Error = PyErr;

    fn extract(object: Borrowed<'a, 'py, PyAny>) -> PyResult<Self> {
        let array = object.py().import("numpy")?.call_method1("asarray", (object,))?;
        // Nothing is rounded.
        let casting = PyDict::new(object.py());
        casting.set_item("casting", if T::IS_WHOLE { "safe" } else { "same_kind" })?;
        let array = array.call_method("astype", (T::TYPE,), Some(&casting)).map_err(|wrong| {
            let what = if T::IS_WHOLE { "whole numbers" } else { "numbers" };
            error(format!("give an array of {what} ({wrong})"))
        })?;
        let bytes = array.call_method0("tobytes")?.cast_into::<PyBytes>()?;
        let numbers = bytes.as_bytes().as_chunks().0.iter().map(|bytes| T::from_bytes(*bytes));
        Ok(Self { shape: array.getattr("shape")?.extract()?, numbers: numbers.collect() })
    }
}

/// An array for Python, row by row.
pub(crate) fn array<T: Number, const N: usize>(
    py: Python<'_>,
    numbers: impl IntoIterator<Item = T>,
    shape: [usize; N],
) -> PyResult<Bound<'_, PyAny>> {
    let bytes: Vec<u8> = numbers.into_iter().flat_map(T::into_bytes).collect();
    let array =
        py.import("numpy")?.call_method1("frombuffer", (PyBytes::new(py, &bytes), T::TYPE))?;
    // The bytes cannot be changed; a copy can.
    array.call_method1("reshape", (shape,))?.call_method0("copy")
}
