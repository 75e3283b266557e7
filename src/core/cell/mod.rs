//! Models one cell: equivalent circuit, thermal model, and the filter that estimates the cell's state.
//!
//! In: a checked cell model, settings, and one [`CellStep`] per voltage reading (V, A, s, degrees C). A positive
//! current is a discharge. Out: SOC, resistance ratio and capacity (Ah) with standard deviations, and branch voltages
//! (V). The filter does not correct its estimates with outliers (voltages beyond its gate).

pub mod aged_ocv;
pub mod chemistry;
pub mod circuit;
pub mod config;
pub mod coverage;
pub mod electrodes;
pub mod estimator;
pub mod fleet_prior;
pub mod loss_modes;
pub mod model;
pub mod model_bands;
pub mod model_check;
pub mod model_comparison;
pub mod notebook;
pub mod own_model;

pub use aged_ocv::{AgedOcv, AgeingLaw};
pub use chemistry::{Chemistry, Label, LabelPrior, USUAL_LOAD_PER_H};
pub use config::{
    CapacityState, ConsistencySettings, Discretisation, EstimatorConfig, GapSettings, GateSettings, InitialState,
    ProcessNoise, SensorErrors, SigmaPointSettings, VoltageError,
};
pub use coverage::Coverage;
pub use electrodes::{Electrodes, NegativeMaterial, PositiveMaterial};
pub use estimator::{
    AdoptedState, CellEstimator, CellModule, CellState, CellStep, EstimatorBank, PackBank, StepResult, Update,
    reach_of_error,
};
pub use fleet_prior::FleetPrior;
pub use loss_modes::LossModes;
pub use model::{
    Branch, CellModel, ERROR_WINDOW_S, GridPosition, MAX_BRANCHES, ModelSpread, Table, TemperaturePosition, Thermal,
    arrhenius,
};
pub use model_bands::{Advice, Measurement, ModelBands, advise};
pub use model_check::{ModelCheck, ModelEvidence};
pub use model_comparison::{Difference, ModelComparison};
pub use notebook::{Notebook, NotebookConfig};
pub use own_model::OwnModel;
