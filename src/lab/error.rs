//! The one error of offline work: a text with the place, what was found and what is allowed.

use packwatch_host::failure::Failure;

use crate::chart::PlotError;
use crate::config::ConfigFaults;
use crate::io::table::TableError;

/// Why offline work failed: one line per fault.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct LabError(pub String);

/// Why a request for offline work cannot be worked on.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum RequestError {
    /// Its configuration is faulty: one line per fault.
    #[error(transparent)]
    Config(#[from] ConfigFaults),
    /// Something else: a file or an argument.
    #[error(transparent)]
    Lab(#[from] LabError),
}

/// Errors that already name their place.
macro_rules! convert {
    ($($error:ty),+ $(,)?) => {
        $(impl From<$error> for LabError {
            fn from(error: $error) -> Self {
                Self(error.to_string())
            }
        })+
    };
}

convert!(
    String,
    &str,
    std::io::Error,
    csv::Error,
    serde_json::Error,
    parquet::errors::ParquetError,
    crate::regress::RegressionError,
    PlotError,
    TableError,
);

impl From<RequestError> for Failure {
    fn from(error: RequestError) -> Self {
        match error {
            RequestError::Config(faults) => faults.into(),
            RequestError::Lab(error) => Self::new(error.0),
        }
    }
}
