//! Converts arrays from Python. Everything that NumPy reads as real or whole numbers is accepted. An array is not
//! copied if it is contiguous, aligned and of the right type.
//!
//! Masked and missing reals become NaN. Whole numbers are never rounded and never wrap around. If whole numbers are
//! expected, a value that is missing, has a fraction or is out of range gives an error with its index. An array that
//! does not contain numbers gives an error with its dtype.

use arrow_array::cast::AsArray;
use arrow_array::types::{ArrowPrimitiveType, Float64Type, UInt8Type, UInt32Type};
use arrow_buffer::ScalarBuffer;
use pyo3::prelude::*;
use pyo3::types::PyList;
use pyo3_arrow::PyArray;

use crate::error::data;

/// Numbers in row-major order.
#[derive(Debug)]
pub(crate) struct Matrix<T: ArrowPrimitiveType> {
    /// The values. The memory may belong to Python and is kept until this buffer is dropped.
    pub(crate) values: ScalarBuffer<T::Native>,
    pub(crate) rows: usize,
    pub(crate) columns: usize,
    /// Whether the array has two dimensions.
    has_columns: bool,
}

pub(crate) type Reals = Matrix<Float64Type>;
pub(crate) type Words = Matrix<UInt32Type>;
/// A matrix of bytes.
pub(crate) type Bytes = Matrix<UInt8Type>;

impl<T: ArrowPrimitiveType> Matrix<T> {
    /// Returns one row.
    pub(crate) fn row(&self, row: usize) -> &[T::Native] {
        &self.values[row * self.columns..][..self.columns]
    }

    /// Returns an error if there is more than one column.
    fn one_column(self, name: &str) -> PyResult<Self> {
        if self.columns == 1 {
            Ok(self)
        } else {
            Err(data(format!("{name} has {} columns, must have 1", self.columns)))
        }
    }

    /// Index of a value in NumPy notation.
    pub(crate) fn index(&self, at: usize) -> String {
        let (row, column) = (at / self.columns.max(1), at % self.columns.max(1));
        if self.has_columns { format!("[{row}, {column}]") } else { format!("[{row}]") }
    }
}

/// Converts to reals of one or two dimensions. `name` is the name of the argument, for errors.
pub(crate) fn reals(name: &str, values: &Bound<'_, PyAny>) -> PyResult<Reals> {
    matrix(name, &float64(name, values)?)
}

/// Converts to reals of one column.
pub(crate) fn column(name: &str, values: &Bound<'_, PyAny>) -> PyResult<Reals> {
    reals(name, values)?.one_column(name)
}

/// Converts to seconds in one column: numbers, or `datetime64` as Unix time. A missing `datetime64` becomes NaN.
pub(crate) fn seconds(name: &str, values: &Bound<'_, PyAny>) -> PyResult<Reals> {
    let numpy = values.py().import("numpy")?;
    let none = |error: PyErr| data(format!("{name}: not an array of numbers: {error}"));
    let array = numpy.call_method1("asanyarray", (values,)).map_err(none)?;
    if array.getattr("dtype")?.getattr("kind")?.extract::<String>()? != "M" {
        return column(name, values);
    }
    // In microseconds since 1970, a float64 is exact until the year 2255. The difference keeps NaT ("not a time"), and
    // the division converts it to NaN.
    let since = array.sub(numpy.call_method1("datetime64", (0, "us"))?)?;
    column(name, &since.div(numpy.call_method1("timedelta64", (1, "s"))?)?)
}

/// Converts to whole numbers of one column.
pub(crate) fn words(name: &str, values: &Bound<'_, PyAny>) -> PyResult<Words> {
    whole(name, "uint32", values, u32::MAX)?.one_column(name)
}

/// Converts to bytes of one or two dimensions.
pub(crate) fn bytes(name: &str, values: &Bound<'_, PyAny>) -> PyResult<Bytes> {
    whole(name, "uint8", values, u8::MAX)
}

/// Checks that an array has as many rows as another.
pub(crate) fn check_rows(name: &str, rows: usize, of: &str, expected: usize) -> PyResult<()> {
    if rows == expected {
        Ok(())
    } else {
        Err(data(format!("{name} has {rows} rows, must have {expected}, like {of}")))
    }
}

/// Converts to a contiguous float64 array; masked values become NaN. `name` is used in errors.
#[pyfunction]
pub(crate) fn float64<'py>(name: &str, values: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyAny>> {
    let numpy = values.py().import("numpy")?;
    let none = |error: PyErr| data(format!("{name}: not an array of numbers: {error}"));
    let array = numpy.call_method1("asanyarray", (values,)).map_err(none)?;
    check_numbers(name, &array)?;
    if !is_masked(&array)? {
        // Convert `values`, not `array`: a column of another library, such as pandas, still knows which values are
        // missing.
        return laid_out(values, "float64").map_err(none);
    }
    let filled = array.call_method1("astype", ("float64",)).and_then(|array| array.call_method1("filled", (f64::NAN,)));
    laid_out(&filled.map_err(none)?, "float64")
}

/// Converts to whole numbers from 0 to `most`, the largest value of `T`. An array with the dtype `dtype` is used
/// unchanged; the numbers of any other array are checked one by one.
fn whole<T>(name: &str, dtype: &str, values: &Bound<'_, PyAny>, most: T::Native) -> PyResult<Matrix<T>>
where
    T: ArrowPrimitiveType,
    T::Native: TryFrom<u64> + std::fmt::Display,
{
    if let Ok(found) = values.getattr("dtype")
        && found.eq(dtype)?
        && !is_masked(values)?
    {
        return matrix(name, &laid_out(values, dtype)?);
    }
    let found = reals(name, values)?;
    let converted = |(at, value): (usize, &f64)| {
        // The conversion is exact: the cast preserves every whole number in range, and the comparison rejects all other
        // numbers, including NaN.
        let whole = Some(*value as u64).filter(|whole| *whole as f64 == *value);
        whole.and_then(|whole| T::Native::try_from(whole).ok()).ok_or_else(|| {
            data(format!("{name}{} = {value}, must be a whole number from 0 to {most}", found.index(at)))
        })
    };
    let whole = found.values.iter().enumerate().map(converted).collect::<PyResult<Vec<T::Native>>>()?;
    let Reals { rows, columns, has_columns, .. } = found;
    Ok(Matrix { values: ScalarBuffer::from(whole), rows, columns, has_columns })
}

fn is_masked(array: &Bound<'_, PyAny>) -> PyResult<bool> {
    array.py().import("numpy.ma")?.call_method1("isMaskedArray", (array,))?.extract()
}

/// Rejects arrays of strings, times, complex numbers or records, because NumPy and pandas silently convert some of them
/// to reals.
fn check_numbers(name: &str, array: &Bound<'_, PyAny>) -> PyResult<()> {
    let dtype = array.getattr("dtype")?;
    let kind: String = dtype.getattr("kind")?.extract()?;
    let refused = |what: String| Err(data(format!("{name} is an array of {what}, must be an array of numbers")));
    // The accepted kinds are bool, signed, unsigned, real, and objects that can be converted to a real.
    if !["b", "i", "u", "f", "O"].contains(&kind.as_str()) {
        return refused(dtype.str()?.to_string());
    }
    if kind == "O" {
        let objects = array.call_method0("ravel")?.call_method0("tolist")?;
        for object in objects.cast::<PyList>()? {
            let kind = object.get_type().name()?;
            let is_number = object.hasattr("__float__")? || object.hasattr("__index__")?;
            if !is_number && !object.is_none() && kind != "NAType" {
                return refused(kind.to_string());
            }
        }
    }
    Ok(())
}

fn laid_out<'py>(values: &Bound<'py, PyAny>, dtype: &str) -> PyResult<Bound<'py, PyAny>> {
    // "CAE" requires C order, alignment, and a plain array instead of a subclass.
    let array = values.py().import("numpy")?.call_method1("require", (values, dtype, "CAE"))?;
    // A single number becomes an array of one.
    if array.getattr("ndim")?.eq(0)? { array.call_method1("reshape", (-1,)) } else { Ok(array) }
}

/// Makes a matrix of an array that already has the dtype and layout.
fn matrix<T: ArrowPrimitiveType>(name: &str, array: &Bound<'_, PyAny>) -> PyResult<Matrix<T>> {
    let shape: Vec<usize> = array.getattr("shape")?.extract()?;
    let (rows, columns) = match shape[..] {
        [rows] => (rows, 1),
        [rows, columns] => (rows, columns),
        _ => return Err(data(format!("{name} has {} dimensions, must have 1 or 2", shape.len()))),
    };
    let has_columns = shape.len() == 2;
    if rows * columns == 0 {
        return Ok(Matrix { values: ScalarBuffer::from(Vec::new()), rows, columns, has_columns });
    }
    let array: PyArray = array.call_method1("reshape", (-1,))?.extract()?;
    let values = array.array().as_primitive::<T>().values().clone();
    Ok(Matrix { values, rows, columns, has_columns })
}
