//! Exceptions: faults of a configuration, of data and arguments, of files. Each has the text of the command line.

use std::fmt::Display;

use packwatch_host::config::ConfigFaults;
use packwatch_lab::error::{LabError, RequestError};
use pyo3::PyErr;

// Their bases are ValueError and OSError, besides the class they share: so they are defined in Python.
pyo3::import_exception!(packwatch._errors, ConfigError);
pyo3::import_exception!(packwatch._errors, DataError);
pyo3::import_exception!(packwatch._errors, FileError);

/// A fault of data or arguments.
pub(crate) fn data(error: impl Display) -> PyErr {
    DataError::new_err(error.to_string())
}

/// A file that cannot be read or written.
pub(crate) fn file(error: impl Display) -> PyErr {
    FileError::new_err(error.to_string())
}

/// Faults of a configuration.
pub(crate) fn config(faults: ConfigFaults) -> PyErr {
    let text = faults.to_string();
    ConfigError::new_err((text, faults.0))
}

/// An error of the library.
pub(crate) fn of_library(error: impl Into<LabError>) -> PyErr {
    match error.into() {
        LabError::Data(text) => data(text),
        LabError::File(text) => file(text),
    }
}

/// An error of a request.
pub(crate) fn of_request(error: RequestError) -> PyErr {
    match error {
        RequestError::Config(faults) => config(faults),
        RequestError::Lab(error) => of_library(error),
    }
}
