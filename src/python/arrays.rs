//! Arrays of numpy. They are copied through bytes: this needs no crate and takes what `numpy.asarray` takes.

use pyo3::exceptions::PyTypeError;
use pyo3::prelude::*;
use pyo3::sync::PyOnceLock;
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

    /// Masked numbers are NaN. Python adds the name of the argument to a TypeError.
    fn extract(object: Borrowed<'a, 'py, PyAny>) -> PyResult<Self> {
        let wrong = |wrong: PyErr| {
            let what = if T::IS_WHOLE { "whole numbers" } else { "numbers" };
            PyTypeError::new_err(format!("give an array of {what} ({wrong})"))
        };
        let numpy = object.py().import("numpy")?;
        let array = numpy.call_method1("asanyarray", (object,)).map_err(wrong)?;
        // Nothing is rounded.
        let casting = PyDict::new(object.py());
        casting.set_item("casting", if T::IS_WHOLE { "safe" } else { "same_kind" })?;
        let array = array.call_method("astype", (T::TYPE,), Some(&casting)).map_err(wrong)?;
        let array = match array.hasattr("filled")? {
            true if !T::IS_WHOLE => array.call_method1("filled", (f64::NAN,))?,
            true if numpy.getattr("ma")?.call_method1("is_masked", (&array,))?.is_truthy()? => {
                return Err(PyTypeError::new_err("give whole numbers, none of them masked"));
            }
            _ => array,
        };
        let bytes = array.call_method0("tobytes")?.cast_into::<PyBytes>()?;
        let numbers = bytes.as_bytes().as_chunks().0.iter().map(|bytes| T::from_bytes(*bytes));
        Ok(Self { shape: array.getattr("shape")?.extract()?, numbers: numbers.collect() })
    }
}

/// An array that is made when it is first asked for.
pub(crate) struct Kept(PyOnceLock<Py<PyAny>>);

impl Default for Kept {
    fn default() -> Self {
        Self(PyOnceLock::new())
    }
}

impl Kept {
    pub(crate) fn get<'py>(
        &self,
        py: Python<'py>,
        make: impl FnOnce() -> PyResult<Bound<'py, PyAny>>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let array = self.0.get_or_try_init(py, || make().map(Bound::unbind))?;
        Ok(array.bind(py).clone())
    }
}

/// An array for Python, row by row. It is read-only: a change would not change what we hold.
pub(crate) fn array<T: Number, const N: usize>(
    py: Python<'_>,
    numbers: impl IntoIterator<Item = T>,
    shape: [usize; N],
) -> PyResult<Bound<'_, PyAny>> {
    let bytes: Vec<u8> = numbers.into_iter().flat_map(T::into_bytes).collect();
    let array =
        py.import("numpy")?.call_method1("frombuffer", (PyBytes::new(py, &bytes), T::TYPE))?;
    array.call_method1("reshape", (shape,))
}
