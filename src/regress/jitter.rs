//! What is added to the diagonal of a covariance matrix that has no Cholesky factor.

use serde::{Deserialize, Serialize};

use super::Fault;

/// Tried one after the other, as part of the signal variance.
const TRIES: [f64; 5] = [0.0, 1e-10, 1e-8, 1e-6, LAST];
pub(super) const LAST: f64 = 1e-4;

/// What had to be added to the diagonal of matrices that were not positive definite.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Jitter {
    /// Matrices that needed it in the final model's likelihood; a prediction's own are mended the same way, uncounted.
    pub matrices: usize,
    /// The most that was added, as part of the signal variance.
    pub largest: f64,
}

impl Jitter {
    pub(super) fn note(&mut self, added: f64) {
        self.matrices += usize::from(added > 0.0);
        self.largest = self.largest.max(added);
    }
}

/// Calls `factorise` with more and more jitter, 0 first, until it says that it worked; gives the jitter of that call.
pub(super) fn until_positive(mut factorise: impl FnMut(f64) -> bool) -> Result<f64, Fault> {
    TRIES.into_iter().find(|added| factorise(*added)).ok_or(Fault::NotPositiveDefinite { jitter: LAST })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn jitter_grows_to_its_end() {
        let mut tries = Vec::new();
        let fault = until_positive(|added| {
            tries.push(added);
            false
        });
        assert_eq!(tries, TRIES);
        assert_eq!(fault, Err(Fault::NotPositiveDefinite { jitter: LAST }));
        assert_eq!(until_positive(|added| added > 1e-9), Ok(1e-8));
    }
}
