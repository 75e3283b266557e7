//! Defines the errors of offline commands. An error text states the place, what was found and what is allowed.

use std::path::Path;

use packwatch_host::failure::Failure;

use crate::chart::PlotError;
use crate::config::ConfigFaults;
use crate::io::table::TableError;

/// Reason why an offline command failed; one line per fault.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum LabError {
    /// Data or arguments that cannot be used.
    #[error("{0}")]
    Data(String),
    /// A file that the operating system cannot read or write.
    #[error("{0}")]
    File(String),
}

/// Reason why a request was rejected.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum RequestError {
    /// The configuration is faulty; one line per fault.
    #[error(transparent)]
    Config(#[from] ConfigFaults),
    /// A file or an argument is wrong.
    #[error(transparent)]
    Lab(#[from] LabError),
}

/// Converts errors whose text already names the place.
macro_rules! convert {
    ($variant:ident: $($error:ty),+ $(,)?) => {
        $(impl From<$error> for LabError {
            fn from(error: $error) -> Self {
                Self::$variant(error.to_string())
            }
        })+
    };
}

convert!(
    Data: String,
    &str,
    csv::Error,
    serde_json::Error,
    parquet::errors::ParquetError,
    crate::regress::RegressionError,
);
convert!(File: PlotError);

impl LabError {
    /// Creates the error of a failed read or write. [`TableError::of_io`] decides the kind.
    pub fn of_io(text: String, error: &std::io::Error) -> Self {
        TableError::of_io(text, error).into()
    }
}

pub(crate) fn create_folder(folder: &Path) -> Result<(), LabError> {
    std::fs::create_dir_all(folder)
        .map_err(|error| LabError::File(format!("{}: cannot be created: {error}", folder.display())))
}

pub(crate) fn check_values(
    name: &str,
    values: impl IntoIterator<Item = f64>,
    is_allowed: impl Fn(f64) -> bool,
    allowed: &str,
) -> Result<(), LabError> {
    let found = values.into_iter().find(|value| !is_allowed(*value));
    found.map_or(Ok(()), |value| Err(LabError::Data(format!("{name} = {value}, must be {allowed}"))))
}

impl From<std::io::Error> for LabError {
    fn from(error: std::io::Error) -> Self {
        Self::of_io(error.to_string(), &error)
    }
}

impl From<TableError> for LabError {
    fn from(error: TableError) -> Self {
        match error {
            TableError::Data(text) => Self::Data(text),
            TableError::File(text) => Self::File(text),
        }
    }
}

impl From<RequestError> for Failure {
    fn from(error: RequestError) -> Self {
        match error {
            RequestError::Config(faults) => faults.into(),
            RequestError::Lab(error) => Self::new(error.to_string()),
        }
    }
}
