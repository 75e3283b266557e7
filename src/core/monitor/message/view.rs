//! The present values of cells and pack, for readers: status, tables, reports. `None` = not known (any more).

use super::outputs::Validity;
use crate::cell::LossModes;
use crate::filter::ScalarGaussian;
use crate::health::{InsufficientData, RemainingLife};
use crate::quantity::{CellIndex, Mode};

/// One cell.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CellView {
    /// Its number.
    pub cell: CellIndex,
    /// Voltage, V, while its last good reading is fresh.
    pub voltage_v: Option<f64>,
    /// Current, A, positive = discharge, while fresh.
    pub current_a: Option<f64>,
    /// Temperature of its sensor, degrees C, while fresh.
    pub temperature_c: Option<f64>,
    /// State of charge, fraction, while its voltage is fresh.
    pub soc: Option<ScalarGaussian>,
    /// Capacity, Ah, once a half-cycle taught something about it.
    pub capacity: Option<ScalarGaussian>,
    /// Usable capacity, Ah, likewise.
    pub usable_capacity: Option<ScalarGaussian>,
    /// Lithium and active material lost, likewise; `None` also without electrodes in the cell model.
    pub losses: Option<LossModes>,
    /// Resistance relative to new, while its voltage is fresh.
    pub resistance_ratio: Option<ScalarGaussian>,
    /// Remaining life, or why it is not known.
    pub remaining_life: Result<RemainingLife, InsufficientData>,
    /// Whether its innovations agree with their covariance; `None` while there is no SOC.
    pub trusted: Option<bool>,
}

/// The pack.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PackView {
    /// Validity of the estimates.
    pub validity: Validity,
    /// Charge, rest or discharge.
    pub mode: Mode,
    /// State of charge, fraction.
    pub soc: Option<ScalarGaussian>,
    /// The cell that ends a discharge.
    pub limiting_cell: Option<CellIndex>,
    /// Sum of the cells' voltages, V, while all are fresh.
    pub voltage_v: Option<f64>,
    /// Current, A, positive = discharge.
    pub current_a: Option<f64>,
    /// Highest temperature, degrees C, while all sensors are fresh.
    pub temperature_max_c: Option<f64>,
    /// The cell with the least capacity, and that, Ah, once every cell was learned.
    pub weakest: Option<(CellIndex, ScalarGaussian)>,
    /// Least usable capacity, Ah, likewise.
    pub usable_capacity: Option<ScalarGaussian>,
    /// Capacity relative to rated, likewise.
    pub soh: Option<f64>,
    /// The cell whose life ends first, and when, once every cell's is known.
    pub remaining_life: Option<(CellIndex, RemainingLife)>,
    /// Last recorded recharge period, s.
    pub recharge_period_s: Option<f64>,
    /// Time the reference charger needs for the window, s.
    pub normalised_recharge_period: Option<ScalarGaussian>,
    /// The pack's own estimates.
    pub reported: ReportedState,
}

/// State of charge and health as the pack itself reports them.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ReportedState {
    /// SOC, fraction.
    pub soc: Option<f64>,
    /// SOH, fraction.
    pub soh: Option<f64>,
}
