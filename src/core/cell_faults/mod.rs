//! Finds failing cells and sensors by comparing each cell with the others of its pack.
//!
//! In: samples of the cells of one series pack, and the estimated values of the mean cell. Out: findings
//! ([`CellFault`]). All cells carry the same current, so errors of the model, the SOC and the current sensor cancel
//! in the differences between cells. A difference of a few millivolts is therefore enough to recognise a failing
//! cell. With fewer than three cells, the detector is inactive.
//!
//! Terms: a *row* contains the sums of each cell's samples over a few minutes. The *mean cell* is an imaginary cell
//! with the typical values of the pack. The *middle cell* is the real cell closest to the pack's median; its
//! estimates stand for the mean cell. A cell is *bled* while a balancing resistor discharges it.
//!
//! | file | purpose |
//! | --- | --- |
//! | [`detector`] | all cells: rows in, findings out |
//! | [`difference`] | filter for one cell's differences in charge, capacity, resistance, contact, voltage channel and leak |
//! | `pack_slope` | slope of the pack's own open-circuit curve |
//! | [`bleed_timer`] | how long a cell was bled, from the balancing bits of its BMS |
//! | `row` | sums of a few minutes of samples, per cell |
//! | [`gain`] | gain of the current sensor, from changes that all cells share |
//! | `channels` | voltage channels that are frozen or show the same cell |
//! | `temperature` | temperature sensors that do not follow the load |
//! | [`imbalance`] | charge that the pack loses because its cells differ, and the cells that limit the pack |
//! | [`thermal_event`] | voltages that collapse and temperatures that rise faster than the current explains |
//! | [`fault`] | kinds of findings and the limits for reporting them |

pub mod bleed_timer;
pub mod detector;
pub mod difference;
pub mod fault;
pub mod gain;
pub mod imbalance;
pub mod thermal_event;

mod channels;
mod pack_slope;
mod row;
mod temperature;

pub use bleed_timer::BalancingConfig;
pub use detector::{CellFaultDetector, MeanCell};
pub use difference::Difference;
pub use fault::{CellFault, CellFaultKind};
pub use imbalance::{Imbalance, UnknownImbalance};
