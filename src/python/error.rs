//! Creates Python exceptions for errors of configurations, of data and arguments, and of files. The exceptions have the
//! same texts as the errors of the command line, but name Python arguments instead of options.

use std::fmt::Display;

use packwatch_host::config::ConfigFaults;
use packwatch_host::io::text_table::printable;
use packwatch_lab::error::{LabError, RequestError};
use pyo3::prelude::*;

// These exceptions are defined in Python because each has two base classes: the common class, and ValueError or
// OSError.
pyo3::import_exception!(packwatch._errors, ConfigError);
pyo3::import_exception!(packwatch._errors, DataError);

/// An error of data or arguments.
pub(crate) fn data(error: impl Display) -> PyErr {
    DataError::new_err(printable(&with_arguments(&error.to_string())))
}

/// Options of the command line whose Python argument has another name. For all other options, only `-` becomes `_`.
const ARGUMENTS: [(&str, &str); 8] = [
    ("--capacity", "capacity_ah"),
    ("--column", "columns"),
    ("--rated", "rated_ah"),
    ("--settle", "settle_s"),
    ("--tau", "tau_s"),
    ("--temperatures", "temperatures_c"),
    ("--voltage-max", "voltage_max_v"),
    ("--voltage-min", "voltage_min_v"),
];

/// The text with the Python argument in place of each option of the command line.
fn with_arguments(text: &str) -> String {
    let argument = |word: &str| {
        let end = word.find(|c: char| !c.is_ascii_lowercase() && c != '-').unwrap_or(word.len());
        let (option, rest) = word.split_at(end);
        let known = ARGUMENTS.iter().find(|(known, _)| *known == option).map(|(_, argument)| (*argument).to_owned());
        match option.strip_prefix("--").filter(|name| name.starts_with(|c: char| c.is_ascii_lowercase())) {
            Some(name) => known.unwrap_or_else(|| name.replace('-', "_")) + rest,
            None => word.to_owned(),
        }
    };
    text.split(' ').map(argument).collect::<Vec<_>>().join(" ")
}

/// An error of reading or writing a file. The text ends with the error number of the operating system, which determines
/// the exception's class and its `errno`.
pub(crate) fn file(error: impl Display) -> PyErr {
    let text = printable(&error.to_string());
    Python::attach(|py| {
        let made = py.import("packwatch._errors").and_then(|module| module.call_method1("file_error", (text,)));
        made.map_or_else(|error| error, PyErr::from_value)
    })
}

pub(crate) fn config(faults: ConfigFaults) -> PyErr {
    let faults: Vec<String> = faults.0.iter().map(|fault| printable(fault)).collect();
    ConfigError::new_err((faults.join("\n"), faults))
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
