//! Defines the errors of rows, settings and saved models.

/// Reason why a model or a prediction failed.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum RegressionError {
    /// The text is not a valid kernel.
    #[error("kernel {text:?}, column {column}: found {found}, allowed: {allowed}")]
    Kernel {
        /// The complete text.
        text: String,
        /// Column of the error, from 1.
        column: usize,
        /// Text found in this column.
        found: String,
        /// Allowed text.
        allowed: String,
    },
    /// A number in the rows is not finite.
    #[error("line {line}: {what} = {found}, must be a finite number")]
    NotFinite {
        /// Line of the row in its file. If the row is not from a file, the number of the row from 1.
        line: u64,
        /// `input 2` or `target`.
        what: String,
        /// The value that is not finite.
        found: f64,
    },
    /// A setting or a length is out of range.
    #[error("{what} = {found}, must be {allowed}")]
    OutOfRange {
        /// Name of the quantity.
        what: String,
        /// Value of the quantity.
        found: String,
        /// Allowed range.
        allowed: String,
    },
    /// A covariance matrix has no Cholesky factor, even with the largest jitter.
    #[error("covariance matrix is not positive definite, even with {jitter:e} of the signal variance on its diagonal")]
    NotPositiveDefinite {
        /// Largest jitter tried, as a fraction of the signal variance.
        jitter: f64,
    },
    /// The progress callback cancelled the fit.
    #[error("cancelled")]
    Cancelled,
    /// A saved model cannot be used.
    #[error("saved model: {0}")]
    Saved(String),
    /// The threads could not be started.
    #[error("threads cannot be started: {0}")]
    Threads(String),
}

impl RegressionError {
    pub(super) fn range(what: &str, found: impl ToString, allowed: impl ToString) -> Self {
        Self::OutOfRange { what: what.to_owned(), found: found.to_string(), allowed: allowed.to_string() }
    }
}
