//! Simulates the true state of the pack, which the estimator must infer from readings.
//!
//! Each cell is the circuit of [`CellModel`] with its own capacity, resistance and temperature, and with effects that
//! the estimator does not model. Current is positive for discharge. During a step of `dt` seconds, current, leak, heat
//! and table values are constant, so every equation is solved exactly:
//! * `SOC -= (I + I_leak) dt / (3600 C)`. `I_leak` contains self-discharge, an injected leak and the balancing
//!   resistor. The SOC is not limited, because SOC 0 and SOC 1 are defined by two open-circuit voltages and are not
//!   physical limits.
//! * `U_i = U_i a + R_i I (1 - a)`, `a = exp(-dt / tau_i)`.
//! * Hysteresis state h in [-1, 1] (Plett): `h = h e - (1 - e) sign(I)`, `e = exp(-|I dt| gamma / (3600 C))`.
//! * Heat: `T = T_end + (T - T_end) exp(-dt / (R_th C_th))`, `T_end = T_ambient + R_th (I^2 R0 + sum U_i^2 / R_i)`.
//!
//! The terminal voltage is `V = OCV(SOC, T, C) + M h - sum U_i - I R0`. Ageing changes capacity and resistances. The
//! time constants and the SOC (a fraction) stay the same.

use super::fault::{ContactResistance, FaultKind, Leak};
use super::noise::{Noise, Stream};
use crate::cell::{CellModel, MAX_BRANCHES};
use crate::quantity::CellIndex;

/// Hysteresis of the open-circuit voltage, which the estimator does not model.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hysteresis {
    /// Distance of the settled charge and discharge curves from the OCV (V); 0 = no hysteresis.
    pub magnitude_v: f64,
    /// Speed of the change from one curve to the other: number of e-foldings while the current moves one full capacity.
    pub rate: f64,
}

impl Default for Hysteresis {
    fn default() -> Self {
        Self { magnitude_v: 0.0, rate: 50.0 }
    }
}

/// Ageing of a cell.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Ageing {
    /// Capacity lost at the end of each cycle (Ah).
    pub capacity_loss_ah_per_cycle: f64,
    /// Capacity lost per Ah moved in either direction (Ah).
    pub capacity_loss_ah_per_ah: f64,
    /// Resistance gained at the end of each cycle, relative to a new cell.
    pub resistance_growth_per_cycle: f64,
    /// Resistance gained per Ah moved in either direction, relative to a new cell.
    pub resistance_growth_per_ah: f64,
}

/// Differences between the cells of a pack.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Spread {
    /// Relative standard deviation of the capacity.
    pub capacity: f64,
    /// Relative standard deviation of the resistance.
    pub resistance: f64,
    /// Standard deviation of the SOC at the start (fraction).
    pub soc: f64,
}

/// Settings of a pack with cells in series.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PackSettings {
    /// Number of cells in series, at least 1.
    pub cells: u16,
    /// Capacity of a new cell (Ah).
    pub capacity_ah: f64,
    /// SOC at the start (fraction).
    pub initial_soc: f64,
    /// Differences between the cells.
    pub spread: Spread,
    /// Ageing of the cells.
    pub ageing: Ageing,
    /// Hysteresis of the cells.
    pub hysteresis: Hysteresis,
    /// Self-discharge (A).
    pub leakage_a: f64,
    /// Ambient temperature, and temperature of the cells at the start (degrees C).
    pub ambient_c: f64,
}

/// Differences between cells are clipped at this many standard deviations, so that no cell is an extreme outlier.
const SPREAD_LIMIT: f64 = 3.0;

/// True state of one cell.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TruthCell {
    /// State of charge (fraction).
    pub soc: f64,
    /// Voltages of the model's RC branches (V); 0 in unused elements.
    pub branch_v: [f64; MAX_BRANCHES],
    /// Hysteresis state, from -1 (after discharge) to 1 (after charge).
    pub hysteresis: f64,
    /// Temperature (degrees C).
    pub temperature_c: f64,
    /// Capacity (Ah).
    pub capacity_ah: f64,
    /// Resistance relative to the cell model.
    pub resistance_ratio: f64,
    /// Charge moved in either direction since the start (Ah).
    pub throughput_ah: f64,
    /// Leak of an injected fault.
    pub leak: Option<Leak>,
    /// Current of the balancing resistor (A); 0 = off.
    pub bleed_a: f64,
    /// Contact resistance of an injected fault (ohm). It lies between the cell's voltage taps. `voltage_v` does not
    /// include its voltage drop.
    pub contact_ohm: f64,
    floor_ah: f64,
}

impl TruthCell {
    fn new(settings: &PackSettings, noise: &mut Noise) -> Self {
        let mut spread = |std: f64| std * noise.normal().clamp(-SPREAD_LIMIT, SPREAD_LIMIT);
        // The capacity stays above 1 % of the new capacity, because the SOC is a charge divided by the capacity.
        let floor_ah = settings.capacity_ah * 0.01;
        Self {
            capacity_ah: (settings.capacity_ah * (1.0 + spread(settings.spread.capacity))).max(floor_ah),
            resistance_ratio: (1.0 + spread(settings.spread.resistance)).max(0.1),
            soc: settings.initial_soc + spread(settings.spread.soc),
            branch_v: [0.0; MAX_BRANCHES],
            hysteresis: 0.0,
            temperature_c: settings.ambient_c,
            throughput_ah: 0.0,
            leak: None,
            bleed_a: 0.0,
            contact_ohm: 0.0,
            floor_ah,
        }
    }

    /// Terminal voltage (V), while `current_a` flows.
    pub fn voltage_v(&self, model: &CellModel, hysteresis: &Hysteresis, current_a: f64) -> f64 {
        let place = model.grid_position(self.soc, self.temperature_c);
        self.unloaded_v(model, hysteresis) - current_a * model.r0_ohm(&place) * self.resistance_ratio
    }

    /// The current (A) at which the terminal voltage would be `voltage_v`.
    pub fn current_at_a(&self, model: &CellModel, hysteresis: &Hysteresis, voltage_v: f64) -> f64 {
        let place = model.grid_position(self.soc, self.temperature_c);
        (self.unloaded_v(model, hysteresis) - voltage_v) / (model.r0_ohm(&place) * self.resistance_ratio)
    }

    /// Current of the injected leak (A); 0 once the cell is empty. The voltage drop that the leak causes is neglected.
    pub fn leak_a(&self, model: &CellModel, hysteresis: &Hysteresis) -> f64 {
        match self.leak {
            None => 0.0,
            Some(_) if self.soc <= 0.0 => 0.0,
            Some(Leak::Current(current_a)) => current_a,
            Some(Leak::Resistance(ohm)) => self.unloaded_v(model, hysteresis) / ohm,
        }
    }

    fn unloaded_v(&self, model: &CellModel, hysteresis: &Hysteresis) -> f64 {
        let place = model.grid_position(self.soc, self.temperature_c);
        let ocv_v = model.aged_ocv_v(&place, self.capacity_ah);
        ocv_v + hysteresis.magnitude_v * self.hysteresis - self.branch_v.iter().sum::<f64>()
    }

    fn step(&mut self, model: &CellModel, settings: &PackSettings, current_a: f64, dt_s: f64) {
        let place = model.grid_position(self.soc, self.temperature_c);
        let mut heat_w = current_a * current_a * model.r0_ohm(&place) * self.resistance_ratio;
        for i in 0..model.branches.len() {
            let r = model.branch_r_ohm(i, &place) * self.resistance_ratio;
            heat_w += self.branch_v[i] * self.branch_v[i] / r;
            let a = libm::exp(-dt_s / model.branch_tau_s(i, &place));
            self.branch_v[i] = self.branch_v[i] * a + r * current_a * (1.0 - a);
        }
        let charge_ah = current_a * dt_s / 3600.0;
        if settings.hysteresis.magnitude_v != 0.0 && current_a != 0.0 {
            let e = libm::exp(-charge_ah.abs() * settings.hysteresis.rate / self.capacity_ah);
            self.hysteresis = self.hysteresis * e - (1.0 - e) * current_a.signum();
        }
        let drain_a = settings.leakage_a + self.leak_a(model, &settings.hysteresis) + self.bleed_a;
        self.soc -= (charge_ah + drain_a * dt_s / 3600.0) / self.capacity_ah;
        if let Some(thermal) = &model.thermal {
            let end_c = settings.ambient_c + thermal.resistance_k_per_w * heat_w;
            let tau_s = thermal.resistance_k_per_w * thermal.heat_capacity_j_per_k;
            self.temperature_c = end_c + (self.temperature_c - end_c) * libm::exp(-dt_s / tau_s);
        }
        self.throughput_ah += charge_ah.abs();
        self.age(
            settings.ageing.capacity_loss_ah_per_ah * charge_ah.abs(),
            settings.ageing.resistance_growth_per_ah * charge_ah.abs(),
        );
    }

    fn change_capacity(&mut self, change: f64) {
        self.capacity_ah = (self.capacity_ah * (1.0 + change)).max(self.floor_ah);
    }

    fn age(&mut self, capacity_loss_ah: f64, resistance_growth: f64) {
        self.capacity_ah = (self.capacity_ah - capacity_loss_ah).max(self.floor_ah);
        self.resistance_ratio += resistance_growth;
    }
}

/// Cells in series.
#[derive(Debug, Clone)]
pub struct Pack {
    model: CellModel,
    settings: PackSettings,
    cells: Vec<TruthCell>,
    cycles: u32,
}

impl Pack {
    /// Creates a pack at rest. `seed` determines the differences between its cells.
    pub fn new(model: CellModel, settings: PackSettings, seed: u64) -> Self {
        assert!(settings.cells > 0, "a pack has at least one cell");
        let mut noise = Noise::new(seed, Stream::Spread);
        let cells = (0..settings.cells).map(|_| TruthCell::new(&settings, &mut noise)).collect();
        Self { model, settings, cells, cycles: 0 }
    }

    /// Steps all cells with `current_a` for `dt_s` seconds.
    pub fn step(&mut self, current_a: f64, dt_s: f64) {
        for cell in &mut self.cells {
            cell.step(&self.model, &self.settings, current_a, dt_s);
        }
    }

    /// Completes a cycle and applies the ageing per cycle.
    pub fn complete_cycle(&mut self) {
        self.cycles += 1;
        let ageing = self.settings.ageing;
        for cell in &mut self.cells {
            cell.age(ageing.capacity_loss_ah_per_cycle, ageing.resistance_growth_per_cycle);
        }
    }

    /// Changes the ageing from the next step on, so that the cells can fade faster or slower over their life.
    pub fn set_ageing(&mut self, ageing: Ageing) {
        self.settings.ageing = ageing;
    }

    /// Changes the ambient temperature (degrees C). The cells follow if their model has a thermal part.
    pub fn set_ambient(&mut self, ambient_c: f64) {
        self.settings.ambient_c = ambient_c;
    }

    /// Starts a fault of a cell, a contact or a module. A fault of a sensor does not change the true state.
    pub(crate) fn begin_fault(&mut self, fault: FaultKind) {
        match fault {
            FaultKind::Leak { cell, leak } => self.cells[cell.index()].leak = Some(leak),
            FaultKind::Contact { cell, resistance } => {
                // A share refers to the cell's resistance at this SOC and temperature (degrees C).
                let place = self.model.grid_position(0.5, 25.0);
                let cell = &mut self.cells[cell.index()];
                cell.contact_ohm += match resistance {
                    ContactResistance::Ohm(ohm) => ohm,
                    ContactResistance::OfCell(share) => share * self.model.r0_ohm(&place) * cell.resistance_ratio,
                };
            }
            FaultKind::Weak { cell, change } => self.cells[cell.index()].change_capacity(change),
            FaultKind::Resistance { cell, change } => self.cells[cell.index()].resistance_ratio *= 1.0 + change,
            FaultKind::Module { first, last, change } => {
                let cells = &mut self.cells[first.index()..=last.index()];
                let soc = cells.iter().map(|cell| cell.soc).sum::<f64>() / cells.len() as f64;
                for cell in cells {
                    cell.change_capacity(change);
                    (cell.resistance_ratio, cell.soc) = (1.0, soc);
                    (cell.leak, cell.throughput_ah) = (None, 0.0);
                }
            }
            FaultKind::CurrentOffset(_)
            | FaultKind::CurrentGain(_)
            | FaultKind::CurrentStuck
            | FaultKind::VoltageOffset { .. }
            | FaultKind::VoltageStuck { .. }
            | FaultKind::Swap(..)
            | FaultKind::Double { .. }
            | FaultKind::TemperatureStuck(_)
            | FaultKind::TemperatureOff(_) => {}
        }
    }

    pub(crate) fn set_bleeds(&mut self, mut bleed_a: impl FnMut(usize, &TruthCell) -> f64) {
        for (i, cell) in self.cells.iter_mut().enumerate() {
            cell.bleed_a = bleed_a(i, cell);
        }
    }

    /// Whether the balancing resistor of `cell` is on.
    pub fn bleeding(&self, cell: CellIndex) -> bool {
        self.cells[cell.index()].bleed_a > 0.0
    }

    /// Current of each cell's injected leak (A).
    pub fn leaks_a(&self) -> impl Iterator<Item = f64> + '_ {
        self.cells.iter().map(|cell| cell.leak_a(&self.model, &self.settings.hysteresis))
    }

    /// Number of completed cycles.
    pub fn cycles(&self) -> u32 {
        self.cycles
    }

    /// The cells.
    pub fn cells(&self) -> &[TruthCell] {
        &self.cells
    }

    /// The cells' model.
    pub fn model(&self) -> &CellModel {
        &self.model
    }

    /// Terminal voltage of each cell (V) while `current_a` flows.
    pub fn voltages_v(&self, current_a: f64) -> impl Iterator<Item = f64> + '_ {
        self.cells.iter().map(move |cell| cell.voltage_v(&self.model, &self.settings.hysteresis, current_a))
    }

    /// Lowest cell voltage (V) while `current_a` flows.
    pub fn lowest_v(&self, current_a: f64) -> f64 {
        self.voltages_v(current_a).fold(f64::INFINITY, f64::min)
    }

    /// Highest cell voltage (V) while `current_a` flows.
    pub fn highest_v(&self, current_a: f64) -> f64 {
        self.voltages_v(current_a).fold(f64::NEG_INFINITY, f64::max)
    }

    /// Lowest and highest cell voltage (V) while `current_a` flows.
    pub fn extremes_v(&self, current_a: f64) -> (f64, f64) {
        let widen = |(low_v, high_v): (f64, f64), voltage_v| (low_v.min(voltage_v), high_v.max(voltage_v));
        self.voltages_v(current_a).fold((f64::INFINITY, f64::NEG_INFINITY), widen)
    }

    /// The current (A) at which the highest cell voltage is `voltage_v`.
    pub fn current_at_highest_a(&self, voltage_v: f64) -> f64 {
        let at = |cell: &TruthCell| cell.current_at_a(&self.model, &self.settings.hysteresis, voltage_v);
        self.cells.iter().map(at).fold(f64::NEG_INFINITY, f64::max)
    }

    /// SOC of the emptiest cell.
    pub fn lowest_soc(&self) -> f64 {
        self.cells.iter().map(|cell| cell.soc).fold(f64::INFINITY, f64::min)
    }

    /// SOC of the fullest cell.
    pub fn highest_soc(&self) -> f64 {
        self.cells.iter().map(|cell| cell.soc).fold(f64::NEG_INFINITY, f64::max)
    }

    /// Lowest capacity of a cell (Ah).
    pub fn lowest_capacity_ah(&self) -> f64 {
        self.cells.iter().map(|cell| cell.capacity_ah).fold(f64::INFINITY, f64::min)
    }
}

#[cfg(test)]
pub(crate) mod tests;
