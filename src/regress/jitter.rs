//! Finds the jitter: a small number that is added to the diagonal of a covariance matrix, so that the matrix has a
//! Cholesky factor.
//!
//! Input: a function that tries to factorise with a given jitter. Output: the smallest sufficient jitter of those
//! tried, as a fraction of the signal variance, or an error.

use serde::{Deserialize, Serialize};

use super::error::RegressionError;

/// The jitters that are tried one after another, as fractions of the signal variance.
const TRIES: [f64; 5] = [0.0, 1e-10, 1e-8, 1e-6, LAST];
pub(super) const LAST: f64 = 1e-4;

/// Jitter that a model needed because covariance matrices were not positive definite.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Jitter {
    /// Number of matrices that needed jitter when the final likelihood was computed. Jitter in predictions is not
    /// counted.
    pub matrices: usize,
    /// Largest jitter that was needed, as a fraction of the signal variance.
    pub largest: f64,
}

impl Jitter {
    pub(super) fn note(&mut self, added: f64) {
        self.matrices += usize::from(added > 0.0);
        self.largest = self.largest.max(added);
    }
}

/// Calls `factorise` with increasing jitter, starting with 0, until it returns true. Returns the jitter of the last
/// call.
pub(super) fn until_positive(mut factorise: impl FnMut(f64) -> bool) -> Result<f64, RegressionError> {
    TRIES.into_iter().find(|added| factorise(*added)).ok_or(RegressionError::NotPositiveDefinite { jitter: LAST })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn jitter_grows_until_last_try() {
        let mut tries = Vec::new();
        let fault = until_positive(|added| {
            tries.push(added);
            false
        });
        assert_eq!(tries, TRIES);
        assert_eq!(fault, Err(RegressionError::NotPositiveDefinite { jitter: LAST }));
        assert_eq!(until_positive(|added| added > 1e-9), Ok(1e-8));
    }
}
