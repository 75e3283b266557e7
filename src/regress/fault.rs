//! What can be wrong with rows, settings and saved models.

/// Why there is no model or no prediction.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Fault {
    /// Text that is no kernel.
    #[error("kernel {text:?}, column {column}: found {found}, allowed: {allowed}")]
    Kernel {
        /// The whole text.
        text: String,
        /// Where, from 1.
        column: usize,
        /// What stands there.
        found: String,
        /// What may stand there.
        allowed: String,
    },
    /// A number that is not finite among the rows.
    #[error("line {line}: {what} = {found}, must be a finite number")]
    NotFinite {
        /// Line of the file, or the row from 1.
        line: u64,
        /// `input 2` or `target`.
        what: String,
        /// The value.
        found: f64,
    },
    /// Lengths that do not fit together, too few or too many of something.
    #[error("{what} = {found}, must be {allowed}")]
    OutOfRange {
        /// What.
        what: String,
        /// Its value.
        found: String,
        /// What it may be.
        allowed: String,
    },
    /// A covariance matrix without a Cholesky factor, whatever is added to its diagonal.
    #[error("covariance matrix is not positive definite, even with {jitter:e} of the signal variance on its diagonal")]
    NotPositiveDefinite {
        /// Most that was added, as part of the signal variance.
        jitter: f64,
    },
    /// The watcher said so.
    #[error("cancelled")]
    Cancelled,
    /// A saved model that cannot be used.
    #[error("saved model: {0}")]
    Saved(String),
    /// No threads to work with.
    #[error("threads cannot be started: {0}")]
    Threads(String),
}

impl Fault {
    pub(super) fn range(what: &str, found: impl ToString, allowed: impl ToString) -> Self {
        Self::OutOfRange { what: what.to_owned(), found: found.to_string(), allowed: allowed.to_string() }
    }
}
