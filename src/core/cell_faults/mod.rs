//! Finds failing cells by comparing each cell with the others of its pack.
//!
//! In: samples of the cells of one series pack, and the estimators' values of the mean cell. Out: [`CellFault`]s. All
//! cells carry the same current, so common errors (model, SOC, current sensor) cancel in the differences, and a cell
//! stands out by a few millivolts. With fewer than three cells nothing is found.
//!
//! | file | purpose |
//! | --- | --- |
//! | [`detector`] | all cells: rows in, findings out |
//! | [`difference`] | filter of one cell's difference: charge, capacity, resistance, contact, channel, leak |
//! | [`bleed_timer`] | how long a cell was bled, from the balancing bits of its BMS |
//! | `row` | samples of a few minutes, summed per cell |
//! | [`gain`] | gain of the current sensor, from changes that all cells share |
//! | `channels` | frozen and doubled voltage channels |
//! | `temperature` | temperature sensors that do not follow the load |
//! | [`imbalance`] | capacity lost by the differences, and the limiting cells |
//! | [`fault`] | kinds of findings and the limits for reporting them |
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
