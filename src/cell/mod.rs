//! One cell: its circuit, its thermal model and the filter that estimates its state.
pub mod config;
pub mod model;
pub use config::{CapacityState, Discretisation, EstimatorConfig};
pub use model::{Branch, CellModel, MAX_BRANCHES, Table, Thermal};
