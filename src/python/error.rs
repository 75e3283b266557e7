//! Creates Python exceptions for errors of configurations, of data and arguments, and of files. The exceptions have the
//! same texts as the errors of the command line.

use std::fmt::Display;

use packwatch_host::config::ConfigFaults;
use packwatch_lab::error::{LabError, RequestError};
use pyo3::PyErr;

// These exceptions are defined in Python because each has two base classes: the common class, and ValueError or
// OSError.
pyo3::import_exception!(packwatch._errors, ConfigError);
pyo3::import_exception!(packwatch._errors, DataError);
pyo3::import_exception!(packwatch._errors, FileError);

/// An error of data or arguments.
pub(crate) fn data(error: impl Display) -> PyErr {
    DataError::new_err(error.to_string())
}

/// An error of reading or writing a file.
pub(crate) fn file(error: impl Display) -> PyErr {
    FileError::new_err(error.to_string())
}

/// The faults of a configuration.
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
