//! Defines a table of results: an Arrow table that other libraries read without a copy. The columns can also be read as
//! NumPy arrays.

use std::sync::Arc;

use arrow_array::cast::AsArray;
use arrow_array::types::{Float64Type, UInt16Type, UInt32Type};
use arrow_array::{Array, ArrayRef, RecordBatch, StructArray};
use arrow_buffer::{Buffer, NullBuffer};
use arrow_schema::{DataType, Field, Schema};
use pyo3::exceptions::PyKeyError;
use pyo3::prelude::*;
use pyo3::types::{PyCapsule, PyDict, PyList};
use pyo3_arrow::buffer::PyArrowBuffer;
use pyo3_arrow::ffi::{ArrayIterator, to_schema_pycapsule, to_stream_pycapsule};

use crate::error::data;

/// Columns of equal length by name.
#[pyclass(frozen, module = "packwatch")]
#[derive(Debug)]
pub(crate) struct Table(RecordBatch);

/// Makes a column of reals; NaN becomes null.
pub(crate) fn reals(values: Vec<f64>) -> ArrayRef {
    let nulls = values.iter().any(|value| value.is_nan());
    let nulls = nulls.then(|| values.iter().map(|value| !value.is_nan()).collect::<NullBuffer>());
    Arc::new(arrow_array::Float64Array::new(values.into(), nulls))
}

impl Table {
    /// Makes a table of columns of equal length.
    pub(crate) fn new(columns: Vec<(&str, ArrayRef)>) -> PyResult<Self> {
        let field = |(name, array): &(&str, ArrayRef)| Field::new(*name, array.data_type().clone(), true);
        let schema = Schema::new(columns.iter().map(field).collect::<Vec<_>>());
        let arrays = columns.into_iter().map(|(_, array)| array).collect();
        RecordBatch::try_new(Arc::new(schema), arrays).map(Self).map_err(data)
    }

    /// Converts the table to a Python object.
    pub(crate) fn into_py(self, py: Python<'_>) -> PyResult<Py<Self>> {
        Py::new(py, self)
    }

    pub(crate) fn rows(&self) -> usize {
        self.0.num_rows()
    }

    fn field(&self) -> Field {
        Field::new("", DataType::Struct(self.0.schema().fields().clone()), false)
    }
}

#[pymethods]
impl Table {
    /// Names of the columns.
    #[getter]
    fn column_names(&self) -> Vec<String> {
        self.0.schema().fields().iter().map(|field| field.name().clone()).collect()
    }

    fn __len__(&self) -> usize {
        self.0.num_rows()
    }

    fn __repr__(&self) -> String {
        format!("<packwatch.Table of {} rows: {}>", self.0.num_rows(), self.column_names().join(", "))
    }

    fn __contains__(&self, name: &str) -> bool {
        self.0.column_by_name(name).is_some()
    }

    /// Returns a column as a NumPy array. A column of numbers is not copied if it has no nulls; otherwise, its nulls
    /// become NaN. Other columns are copied.
    fn __getitem__<'py>(&self, py: Python<'py>, name: &str) -> PyResult<Bound<'py, PyAny>> {
        let missing = || PyKeyError::new_err(format!("no column {name}, found {}", self.column_names().join(",")));
        let array = self.0.column_by_name(name).ok_or_else(missing)?;
        match array.data_type() {
            DataType::Float64 if array.null_count() == 0 => {
                numpy(py, array.as_primitive::<Float64Type>().values().inner().clone(), "float64")
            }
            DataType::Float64 => floats(py, array.as_primitive::<Float64Type>().iter()),
            DataType::UInt16 if array.null_count() == 0 => {
                numpy(py, array.as_primitive::<UInt16Type>().values().inner().clone(), "uint16")
            }
            DataType::UInt16 => floats(py, array.as_primitive::<UInt16Type>().iter().map(|value| value.map(f64::from))),
            DataType::UInt32 => numpy(py, array.as_primitive::<UInt32Type>().values().inner().clone(), "uint32"),
            DataType::Boolean => {
                let flags: Vec<u8> = array.as_boolean().iter().map(|flag| u8::from(flag == Some(true))).collect();
                numpy(py, Buffer::from_vec(flags), "bool")
            }
            DataType::Utf8 => objects(py, &PyList::new(py, array.as_string::<i32>().iter())?),
            _ => objects(py, &PyList::new(py, array.as_binary::<i32>().iter())?),
        }
    }

    /// Returns a `pyarrow.Table` without a copy.
    fn to_pyarrow<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        slf.py().import("pyarrow")?.call_method1("table", (slf,))
    }

    /// Returns a `pandas.DataFrame`. In columns of numbers, null becomes NaN.
    fn to_pandas<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        let (py, columns) = (slf.py(), PyDict::new(slf.py()));
        for name in slf.get().column_names() {
            columns.set_item(&name, slf.get().__getitem__(py, &name)?)?;
        }
        py.import("pandas")?.call_method1("DataFrame", (columns,))
    }

    /// Arrow PyCapsule interface.
    fn __arrow_c_schema__<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyCapsule>> {
        Ok(to_schema_pycapsule(py, self.0.schema().as_ref())?)
    }

    /// Arrow PyCapsule interface.
    #[pyo3(signature = (requested_schema=None))]
    fn __arrow_c_stream__<'py>(
        &self,
        py: Python<'py>,
        requested_schema: Option<Bound<'py, PyCapsule>>,
    ) -> PyResult<Bound<'py, PyCapsule>> {
        let whole: ArrayRef = Arc::new(StructArray::from(self.0.clone()));
        let reader = ArrayIterator::new([Ok(whole)], Arc::new(self.field()));
        Ok(to_stream_pycapsule(py, Box::new(reader), requested_schema)?)
    }
}

/// Wraps memory in a NumPy array. The array keeps the memory alive.
fn numpy<'py>(py: Python<'py>, memory: Buffer, dtype: &str) -> PyResult<Bound<'py, PyAny>> {
    py.import("numpy")?.call_method1("frombuffer", (PyArrowBuffer::new(memory), dtype))
}

fn floats<'py>(py: Python<'py>, values: impl Iterator<Item = Option<f64>>) -> PyResult<Bound<'py, PyAny>> {
    let values: Vec<f64> = values.map(|value| value.unwrap_or(f64::NAN)).collect();
    numpy(py, Buffer::from_vec(values), "float64")
}

fn objects<'py>(py: Python<'py>, values: &Bound<'py, PyList>) -> PyResult<Bound<'py, PyAny>> {
    py.import("numpy")?.call_method1("array", (values, "object"))
}
