//! Which cell is failing, and how: each cell against the others of its pack.
//!
//! In: samples of the cells of one pack in series, and what the estimators know of the mean cell. Out: [`CellFault`]s. All cells
//! carry the same current, so what is common to them (model, SOC, sensor of the current) cancels in the differences, and a
//! cell stands out by a few millivolts. A single cell has no others: nothing is found.
//!
//! | file | purpose |
//! | --- | --- |
//! | [`detector`] | all cells: rows in, findings out |
//! | [`difference`] | the filter of one cell's difference: charge, capacity, resistance, contact, channel, leak |
//! | [`bleed_timer`] | for how long a cell was bled, by the bits of its BMS |
//! | `row` | samples of some minutes, summed per cell |
//! | [`gain`] | the current sensor's gain, by what all cells have in common |
//! | `channels` | channels that are frozen or doubled |
//! | `temperature` | temperature sensors that do not follow the load |
//! | [`imbalance`] | what the differences cost the pack, and its limiting cells |
//! | [`fault`] | kinds of findings, and from when on one is reported |
pub mod bleed_timer;
pub mod detector;
pub mod difference;
pub mod fault;
pub mod gain;
pub mod imbalance;

mod channels;
mod row;
mod temperature;

pub use bleed_timer::BalancingConfig;
pub use detector::{CellFaultDetector, MeanCell};
pub use difference::Difference;
pub use fault::{CellFault, CellFaultKind};
pub use imbalance::{Imbalance, UnknownImbalance};
