//! Equivalent-circuit model of one cell type: OCV, R0 and 1 to 3 RC branches over SOC and temperature.
//!
//! All values are interpolated linearly over SOC. OCV and time constants are also interpolated linearly over
//! temperature. Resistances follow an Arrhenius law with [`ACTIVATION_ENERGY_J_PER_MOL`] that passes through the values
//! at both breakpoints. Linear interpolation would be up to 15 % too high in the middle of a 20 K interval.
//!
//! Outside the grid, the value at the edge is used, except for the OCV below SOC 0 and above SOC 1. There, the OCV
//! continues with the slope of its last interval, so that the filter still corrects a wrong SOC.
//!
//! Deviation: the paper ("Battery Predictions for Electronic Prognostics") interpolates R1 and C1 separately. This
//! model interpolates their product, the time constant. Reason: between nodes with different resistances, the product
//! of the two interpolated values is up to twice the product at either node. Effect: none where R1 and C1 are constant.

use serde::{Deserialize, Serialize};

use super::aged_ocv::{AgedOcv, AgeingLaw, MIXES, OffsetLine};
use super::loss_modes::LossModes;
use crate::filter::{ScalarGaussian, crossing, interpolation, locate};

/// Maximum number of RC branches.
pub const MAX_BRANCHES: usize = 3;

/// Activation energy of the resistances between two temperature breakpoints (J/mol). Measured cells have 15 to 35
/// kJ/mol.
pub const ACTIVATION_ENERGY_J_PER_MOL: f64 = 25_000.0;

/// Resistance at a temperature, relative to the resistance at 25 degrees C.
pub fn arrhenius(temperature_c: f64) -> f64 {
    let per_kelvin = 1.0 / (temperature_c + 273.15) - 1.0 / (25.0 + 273.15);
    // The gas constant is in J/(mol K) (CODATA 2018).
    libm::exp(ACTIVATION_ENERGY_J_PER_MOL / 8.314_462_618 * per_kelvin)
}

/// One table over SOC (columns) x temperature (rows).
#[derive(Debug, Clone, PartialEq)]
pub struct Table {
    /// `values[t][s]`: one row per temperature breakpoint, one column per SOC breakpoint.
    pub values: Vec<Vec<f64>>,
}

/// One RC branch.
#[derive(Debug, Clone, PartialEq)]
pub struct Branch {
    /// Resistance (ohm).
    pub r_ohm: Table,
    /// Capacitance (F).
    pub c_farad: Table,
}

/// Thermal model of one cell: C dT/dt = losses - (T - ambient) / R.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Thermal {
    /// Heat capacity (J/K).
    pub heat_capacity_j_per_k: f64,
    /// Thermal resistance to the surroundings (K/W).
    pub resistance_k_per_w: f64,
}

/// A checked cell model. Breakpoints and OCV rise strictly, all resistances and capacitances are positive and finite,
/// and the tables are complete. `config::cell_model` creates it from a file, `cell::chemistry` from a label.
#[derive(Debug, Clone, PartialEq)]
pub struct CellModel {
    /// Display name.
    pub name: String,
    /// Capacity on the label (Ah), to which the SOH is relative.
    pub rated_capacity_ah: f64,
    /// Capacity of a new cell between full and empty open-circuit voltage at the reference temperature (Ah).
    pub capacity_ah: f64,
    /// Lowest voltage under load (V).
    pub voltage_min_v: f64,
    /// Highest voltage under charge (V).
    pub voltage_max_v: f64,
    /// SOC breakpoints (fraction) from 0 to 1.
    pub soc: Vec<f64>,
    /// Temperature breakpoints (degrees C).
    pub temperature_c: Vec<f64>,
    /// Open-circuit voltage (V).
    pub ocv_v: Table,
    /// Change of the open-circuit curve with lost capacity.
    pub aged_ocv: AgedOcv,
    /// Series resistance (ohm).
    pub r0_ohm: Table,
    /// One to [`MAX_BRANCHES`] RC branches.
    pub branches: Vec<Branch>,
    /// Standard deviation of the model's voltage error, averaged over [`ERROR_WINDOW_S`] (V); `None` = unknown.
    pub voltage_error_v: Option<Table>,
    /// Thermal parameters; `None` = a missing temperature is not estimated.
    pub thermal: Option<Thermal>,
    /// Differences between the cells and the model; `None` = the usual differences within one cell type.
    pub spread: Option<ModelSpread>,
}

/// Standard deviations of the differences between cells and their model. The shapes (modes) of the open-circuit curve's
/// error are stored separately ([`AgedOcv::add_spread`]).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ModelSpread {
    /// Constant error of the open-circuit curve in addition to its modes (V).
    pub curve_v: f64,
    /// ln(resistance relative to the model).
    pub log_resistance: f64,
    /// Resistance of the slowest branch relative to the others (fraction).
    pub slow_branch: f64,
    /// Capacity (fraction).
    pub capacity: f64,
    /// Relative error of the voltage drop in the cell, averaged over one second. It applies to the drop caused by the
    /// present load, and to the drop caused by the load of the last minutes.
    pub drop_sqrt_s: f64,
}

impl ModelSpread {
    /// Usual differences within one cell type. `curve_v`: standard deviation of the open-circuit curve's error (V).
    pub fn usual(branches: usize, curve_v: f64) -> Self {
        let slow_branch = if branches > 1 { 0.2 } else { 0.1 };
        Self { curve_v, log_resistance: 0.2, slow_branch, capacity: 0.1, drop_sqrt_s: 0.0 }
    }
}

/// Time over which [`CellModel::voltage_error_v`] is averaged (s).
pub const ERROR_WINDOW_S: f64 = 100.0;

/// Position of a temperature in the grid.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TemperaturePosition {
    pub(super) t: usize,
    /// Weight of the upper temperature row, in [0, 1].
    pub(super) along_t: f64,
    /// Weight of the upper row for resistances, in [0, 1].
    pub(super) along_arrhenius: f64,
}

/// The four grid corners around one SOC and temperature, with their weights.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GridPosition {
    s: usize,
    along_s: f64,
    /// Like `along_s`, but without limits, because the OCV continues below SOC 0 and above SOC 1.
    beyond_s: f64,
    temperature: TemperaturePosition,
}

impl TemperaturePosition {
    /// Interpolates `value` between the lower and the upper row with weight `along`. With weight 0, does not read the
    /// upper row.
    fn between(&self, along: f64, value: impl Fn(usize) -> f64) -> f64 {
        let low = value(self.t);
        if along == 0.0 { low } else { low + along * (value(self.t + 1) - low) }
    }
}

impl Table {
    fn at(&self, position: &GridPosition, along_s: f64, along_t: f64) -> f64 {
        position.temperature.between(along_t, |t| interpolation::between(&self.values[t], position.s, along_s))
    }
}

/// Mean slope of the open-circuit curve (V per unit of SOC) below which an electrode counts as a mixture of two phases.
const TWO_PHASE_SLOPE_V: f64 = 0.15;

/// Hysteresis of a two-phase electrode: standard deviation of the voltage (V) around the middle between charge curve
/// and discharge curve. For LFP, the two curves are 10 to 25 mV apart.
const TWO_PHASE_HYSTERESIS_V: f64 = 0.01;

impl CellModel {
    /// Differences between the cells and the model. If the model states no differences, returns the usual ones of one
    /// cell type. For a flat curve, these include the hysteresis of a two-phase electrode.
    pub fn spread(&self) -> ModelSpread {
        self.spread.unwrap_or_else(|| {
            let curve_v = if self.is_two_phase() { TWO_PHASE_HYSTERESIS_V } else { 0.0 };
            ModelSpread::usual(self.branches.len(), curve_v)
        })
    }

    /// Whether the curve between 20 and 80 % SOC is flat. An unchecked model with incomplete tables counts as steep.
    fn is_two_phase(&self) -> bool {
        let curve = self.ocv_v.values.first();
        let node = |at: f64| {
            let index = self.soc.iter().position(|&soc| soc >= at)?;
            Some((self.soc[index], *curve?.get(index)?))
        };
        node(0.2).zip(node(0.8)).is_some_and(|((low, low_v), (high, high_v))| {
            high > low && high_v - low_v < TWO_PHASE_SLOPE_V * (high - low)
        })
    }

    /// Grid position of a SOC and a temperature (degrees C).
    pub fn grid_position(&self, soc: f64, temperature_c: f64) -> GridPosition {
        self.grid_position_at(&self.temperature_position(temperature_c), soc)
    }

    /// Grid position of a temperature (degrees C).
    pub fn temperature_position(&self, temperature_c: f64) -> TemperaturePosition {
        let (t, along_t) = match self.temperature_c.len() {
            1 => (0, 0.0),
            _ => locate(&self.temperature_c, temperature_c),
        };
        let along_t = along_t.clamp(0.0, 1.0);
        let along_arrhenius = if along_t == 0.0 || along_t == 1.0 {
            along_t
        } else {
            let [low, high] = [self.temperature_c[t], self.temperature_c[t + 1]].map(arrhenius);
            (arrhenius(temperature_c) - low) / (high - low)
        };
        TemperaturePosition { t, along_t, along_arrhenius }
    }

    /// Grid position of a SOC at a temperature with a known position.
    pub fn grid_position_at(&self, temperature: &TemperaturePosition, soc: f64) -> GridPosition {
        let (s, beyond_s) = locate(&self.soc, soc);
        GridPosition { s, along_s: beyond_s.clamp(0.0, 1.0), beyond_s, temperature: *temperature }
    }

    /// Open-circuit voltage (V).
    pub fn ocv_v(&self, position: &GridPosition) -> f64 {
        self.ocv_v.at(position, position.beyond_s, position.temperature.along_t)
    }

    /// Open-circuit voltage (V) of a cell with this capacity (Ah).
    pub fn aged_ocv_v(&self, position: &GridPosition, capacity_ah: f64) -> f64 {
        self.ocv_v(position) + self.offset(position, capacity_ah).offset_v.at(self.soc_at(position))
    }

    /// Changes of the aged open-circuit voltage: per Ah of capacity (V/Ah), and by each mix of losses
    /// ([`super::aged_ocv`], V).
    pub fn aged_ocv_changes_v(&self, position: &GridPosition, capacity_ah: f64) -> (f64, [f64; MIXES]) {
        let (line, soc) = (self.offset(position, capacity_ah), self.soc_at(position));
        (line.per_ah_v.at(soc), line.mixes_v.map(|mix_v| mix_v.at(soc)))
    }

    fn soc_at(&self, position: &GridPosition) -> f64 {
        let [from, to] = [self.soc[position.s], self.soc[position.s + 1]];
        from + position.beyond_s * (to - from)
    }

    /// Slope of the open-circuit voltage of an aged cell (V per unit of SOC).
    pub fn ocv_slope_v(&self, position: &GridPosition, capacity_ah: f64) -> f64 {
        let rise = |t: usize| self.ocv_v.values[t][position.s + 1] - self.ocv_v.values[t][position.s];
        position.temperature.between(position.temperature.along_t, rise)
            / (self.soc[position.s + 1] - self.soc[position.s])
            + self.offset(position, capacity_ah).offset_v.0[1]
    }

    /// Returns a model in which a cell with this capacity (Ah) counts as new. Further ageing follows the same law.
    pub fn rebased(&self, capacity_ah: f64) -> Self {
        let last = self.soc.len() - 2;
        let offset_v = |s: usize| self.aged_ocv.line(&self.soc, s.min(last), capacity_ah).offset_v.at(self.soc[s]);
        let row = |row: &Vec<f64>| row.iter().enumerate().map(|(s, v)| v + offset_v(s)).collect::<Vec<f64>>();
        let rows: Vec<Vec<f64>> = self.ocv_v.values.iter().map(row).collect();
        let of_shift = |shift| AgedOcv::of_shift(shift, &self.soc, capacity_ah, &rows);
        let mut aged_ocv = match self.aged_ocv.law() {
            AgeingLaw::Shift(shift) => of_shift(shift),
            AgeingLaw::Electrodes(electrodes) => {
                AgedOcv::of_electrodes(&electrodes, &self.soc, capacity_ah, &rows).unwrap_or_else(|| of_shift(0.0))
            }
        };
        if self.spread.is_some() {
            aged_ocv.add_spread(self.aged_ocv.spread_v());
        }
        Self { capacity_ah, ocv_v: Table { values: rows }, aged_ocv, ..self.clone() }
    }

    fn offset(&self, position: &GridPosition, capacity_ah: f64) -> OffsetLine {
        self.aged_ocv.line(&self.soc, position.s, capacity_ah)
    }

    /// Losses of a cell with this capacity (Ah); `None` if unknown for this cell type.
    pub fn loss_modes(&self, capacity: ScalarGaussian) -> Option<LossModes> {
        LossModes::of_capacity(&self.aged_ocv, self.capacity_ah, capacity)
    }

    /// Series resistance of a new cell (ohm).
    pub fn r0_ohm(&self, position: &GridPosition) -> f64 {
        self.r0_ohm.at(position, position.along_s, position.temperature.along_arrhenius)
    }

    /// Resistance of branch `i` of a new cell (ohm).
    pub fn branch_r_ohm(&self, i: usize, position: &GridPosition) -> f64 {
        self.branches[i].r_ohm.at(position, position.along_s, position.temperature.along_arrhenius)
    }

    /// Time constant of branch `i` (s). Ageing scales the resistance and not the time constant.
    pub fn branch_tau_s(&self, i: usize, position: &GridPosition) -> f64 {
        let Branch { r_ohm, c_farad } = &self.branches[i];
        let tau_s = |t: usize, s: usize| r_ohm.values[t][s] * c_farad.values[t][s];
        let row_tau_s = |t: usize| {
            let low = tau_s(t, position.s);
            low + position.along_s * (tau_s(t, position.s + 1) - low)
        };
        position.temperature.between(position.temperature.along_t, row_tau_s)
    }

    /// Standard deviation of the model's voltage error, averaged over [`ERROR_WINDOW_S`] (V); `None` = unknown.
    pub fn voltage_error_v(&self, position: &GridPosition) -> Option<f64> {
        Some(self.voltage_error_v.as_ref()?.at(position, position.along_s, position.temperature.along_t))
    }

    /// Resistance of a new cell after all branches have settled (ohm).
    pub fn settled_ohm(&self, position: &GridPosition) -> f64 {
        (0..self.branches.len()).fold(self.r0_ohm(position), |sum, i| sum + self.branch_r_ohm(i, position))
    }

    /// SOC of a new cell at an open-circuit voltage, limited to -0.5 to 1.5.
    pub fn soc_of_ocv(&self, voltage_v: f64, temperature_c: f64) -> f64 {
        self.soc_of_aged_ocv(&self.temperature_position(temperature_c), self.capacity_ah, voltage_v)
    }

    /// SOC of a cell with this capacity (Ah) at an open-circuit voltage, limited to -0.5 to 1.5.
    pub fn soc_of_aged_ocv(&self, temperature: &TemperaturePosition, capacity_ah: f64, voltage_v: f64) -> f64 {
        let is_below = |soc| voltage_v > self.aged_ocv_v(&self.grid_position_at(temperature, soc), capacity_ah);
        crossing((-0.5, 1.5), is_below)
    }
}

#[cfg(test)]
pub(crate) mod tests;
