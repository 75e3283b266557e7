//! One cell: its circuit, its thermal model and the filter that estimates its state.

pub mod circuit;
pub mod config;
pub mod estimator;
pub mod model;

pub use config::{CapacityState, Discretisation, EstimatorConfig};
pub use estimator::{CellEstimator, CellState, CellStep, EstimatorBank, StepResult};
pub use model::{Branch, CellModel, ERROR_WINDOW_S, MAX_BRANCHES, Place, Row, Table, Thermal, arrhenius};
