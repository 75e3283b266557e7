//! The estimator's state as a document, to be stored and taken up again.

use nalgebra::{SMatrix, SVector};
use serde::{Deserialize, Serialize};

use super::{CellEstimator, Filter, Memory};
use crate::filter::Gaussian;

/// The estimator's state as a document.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CellState {
    /// Mean of the filter's state; empty before the first voltage.
    mean: Vec<f64>,
    /// Its covariance, row by row.
    covariance: Vec<f64>,
    memory: Memory,
}

impl CellEstimator {
    /// The state, to be stored.
    pub fn snapshot(&self) -> CellState {
        let (mean, covariance) = self.filter.as_ref().map_or_else(
            Default::default,
            |filter| each!(filter, x => (x.mean.as_slice().to_vec(), x.covariance.as_slice().to_vec())),
        );
        CellState { mean, covariance, memory: self.memory }
    }

    /// A stored state taken up again; `None` when it is for another number of branches.
    pub fn restore(state: &CellState, branches: usize) -> Option<Self> {
        let filter = match (state.mean.len(), branches) {
            (0, _) => None,
            (4, 1) => Some(Filter::One(gaussian(state)?)),
            (5, 2) => Some(Filter::Two(gaussian(state)?)),
            (6, 3) => Some(Filter::Three(gaussian(state)?)),
            _ => return None,
        };
        Some(Self { filter, memory: state.memory })
    }
}

fn gaussian<const N: usize>(state: &CellState) -> Option<Gaussian<N>> {
    (state.mean.len() == N && state.covariance.len() == N * N).then(|| Gaussian {
        mean: SVector::from_column_slice(&state.mean),
        covariance: SMatrix::from_column_slice(&state.covariance),
    })
}
