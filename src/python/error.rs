//! Exceptions: faults of a configuration, of data and arguments, of files. Each has the text of the command line.

use std::fmt::Display;
use std::fs::File;
use std::path::{Path, PathBuf};

use packwatch_host::config::ConfigFaults;
use packwatch_lab::error::RequestError;
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

/// An error of work on these files: a file error where one of them cannot be opened, else one of data.
pub(crate) fn of_files(error: impl Display, files: &[PathBuf]) -> PyErr {
    if files.iter().any(|path| is_missing(path)) { file(error) } else { data(error) }
}

/// An error of a request on these files.
pub(crate) fn of_request(error: RequestError, files: &[PathBuf]) -> PyErr {
    match error {
        RequestError::Config(faults) => config(faults),
        RequestError::Lab(error) => of_files(error, files),
    }
}

fn is_missing(path: &Path) -> bool {
    path != Path::new("-") && File::open(path).is_err()
}
