//! One cell: its circuit, its thermal model and the filter that estimates its state.

pub mod circuit;
pub mod config;
pub mod estimator;
pub mod model;

pub use config::{CapacityState, Discretisation, EstimatorConfig};
pub use estimator::{CellEstimator, CellState, CellStep, StepResult};
pub use model::{Branch, CellModel, MAX_BRANCHES, Place, Table, Thermal};
