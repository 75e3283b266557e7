//! Arrays from Python: anything that NumPy can see as numbers, without a copy where it is contiguous and of the type already.

use arrow_array::cast::AsArray;
use arrow_array::types::{ArrowPrimitiveType, Float64Type, UInt8Type, UInt32Type};
use arrow_buffer::ScalarBuffer;
use pyo3::prelude::*;
use pyo3_arrow::PyArray;

use crate::error::data;

/// Numbers, row after row.
#[derive(Debug)]
pub(crate) struct Matrix<T: ArrowPrimitiveType> {
    /// Values; they may be memory of Python's, which is kept until this is dropped.
    pub(crate) values: ScalarBuffer<T::Native>,
    /// Rows.
    pub(crate) rows: usize,
    /// Values of a row.
    pub(crate) columns: usize,
}

/// Numbers.
pub(crate) type Reals = Matrix<Float64Type>;
/// Whole numbers.
pub(crate) type Words = Matrix<UInt32Type>;
/// Bytes.
pub(crate) type Bytes = Matrix<UInt8Type>;

impl<T: ArrowPrimitiveType> Matrix<T> {
    /// One row.
    pub(crate) fn row(&self, row: usize) -> &[T::Native] {
        &self.values[row * self.columns..][..self.columns]
    }
}

/// Reals of one or two dimensions; `name` is the argument's.
pub(crate) fn reals(name: &str, values: &Bound<'_, PyAny>) -> PyResult<Reals> {
    matrix(name, "float64", values)
}

/// Whole numbers of one dimension.
pub(crate) fn words(name: &str, values: &Bound<'_, PyAny>) -> PyResult<Words> {
    matrix(name, "uint32", values)
}

/// Bytes of two dimensions.
pub(crate) fn bytes(name: &str, values: &Bound<'_, PyAny>) -> PyResult<Bytes> {
    matrix(name, "uint8", values)
}

/// Checks that an array has as many rows as another.
pub(crate) fn check_rows(name: &str, rows: usize, of: &str, expected: usize) -> PyResult<()> {
    if rows == expected {
        Ok(())
    } else {
        Err(data(format!("{name} has {rows} rows, {of} has {expected}: must agree")))
    }
}

fn matrix<T: ArrowPrimitiveType>(name: &str, dtype: &str, values: &Bound<'_, PyAny>) -> PyResult<Matrix<T>> {
    let py = values.py();
    let made = py.import("numpy")?.call_method1("ascontiguousarray", (values, dtype));
    let array = made.map_err(|error| data(format!("{name}: no array of numbers: {error}")))?;
    let shape: Vec<usize> = array.getattr("shape")?.extract()?;
    let (rows, columns) = match shape[..] {
        [rows] => (rows, 1),
        [rows, columns] => (rows, columns),
        _ => return Err(data(format!("{name} has {} dimensions, must have 1 or 2", shape.len()))),
    };
    if rows * columns == 0 {
        return Ok(Matrix { values: ScalarBuffer::from(Vec::new()), rows, columns });
    }
    let array: PyArray = array.call_method1("reshape", (-1,))?.extract()?;
    let values = array.array().as_primitive::<T>().values().clone();
    Ok(Matrix { values, rows, columns })
}
