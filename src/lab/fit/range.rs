//! Determines the measured range of a model, and extends the model's tables beyond the measured temperatures.
//!
//! Ranges are given for temperature (degrees Celsius), current (A) and SOC. A table has one row per temperature. A row
//! is added [`REACH_K`] beyond each end of the measured temperatures. If the fitted rows do not reach an end of the
//! measured temperatures, a row is also added at this end. Added rows repeat the open-circuit curve and the time
//! constants of the nearest fitted row. Their resistances follow Arrhenius' law. The law is only approximate, so the
//! voltage error grows with the distance.

use crate::cell::arrhenius;
use crate::filter::ends;
use crate::ident::fit::FittedTables;
use crate::ident::grid::Grid;
use crate::ident::parameters::ParameterTables;
use crate::ident::pass::COLD_POWER;
use crate::ident::record::Record;

/// Distance of an additional row from the measured temperatures (K).
const REACH_K: f64 = 40.0;
/// Standard deviation of the activation energy of a cell's resistances (J/mol). The energy is assumed to be uniformly
/// distributed from 15 to 35 kJ/mol.
const ENERGY_STD_J_PER_MOL: f64 = 6_000.0;
const ZERO_CELSIUS_K: f64 = 273.15;
/// Share of the time that is ignored at each end of the temperature range, because sensors have outliers.
const STRAY: f64 = 0.005;

/// Ranges of a fit's data.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MeasuredRange {
    /// Temperatures (degrees C).
    pub temperature_c: (f64, f64),
    /// Currents (A).
    pub current_a: (f64, f64),
    /// States of charge.
    pub soc: (f64, f64),
    /// Root mean square of the current (A).
    pub rms_a: f64,
}

impl MeasuredRange {
    pub(super) fn of(records: &[Record]) -> Self {
        let rows = || records.iter().flat_map(|record| &record.rows).filter(|row| row.weight_s > 0.0);
        let mut by_temperature: Vec<(f64, f64)> = rows().map(|row| (row.temperature_c, row.weight_s)).collect();
        by_temperature.sort_by(|a, b| a.0.total_cmp(&b.0));
        let seconds: f64 = by_temperature.iter().map(|(_, weight_s)| weight_s).sum();
        let mut passed_s = 0.0;
        let inner = by_temperature.iter().filter(|(_, weight_s)| {
            passed_s += weight_s;
            (STRAY * seconds..=(1.0 - STRAY) * seconds).contains(&(passed_s - 0.5 * weight_s))
        });
        let square: f64 = rows().map(|row| row.weight_s * row.current_a * row.current_a).sum();
        Self {
            temperature_c: ends(inner.map(|(temperature_c, _)| *temperature_c)),
            current_a: ends(rows().map(|row| row.current_a)),
            soc: ends(rows().map(|row| row.soc.clamp(0.0, 1.0))),
            rms_a: (square / seconds).sqrt(),
        }
    }
}

#[derive(Debug, Clone, PartialEq)]
pub(super) struct ModelTables {
    pub(super) grid: Grid,
    pub(super) tables: ParameterTables,
    /// Standard deviation of the model's voltage error, averaged over 100 s (V).
    pub(super) voltage_error_v: Vec<f64>,
}

impl ModelTables {
    pub(super) fn fitted(fitted: &FittedTables, voltage_error_v: &[f64]) -> Self {
        let (grid, tables) = (fitted.grid.clone(), fitted.tables.clone());
        Self { grid, tables, voltage_error_v: voltage_error_v.to_vec() }
    }

    /// Adds rows outside the measured temperatures. If `is_scaled` is set, the resistances of the first and last node
    /// apply at the temperature of the node. Otherwise, they apply at the end of the measured temperatures.
    pub(super) fn beyond(
        fitted: &FittedTables,
        voltage_error_v: &[f64],
        range: &MeasuredRange,
        is_scaled: bool,
    ) -> Self {
        let grid = Grid { soc: fitted.grid.soc.clone(), temperature_c: vec![] };
        let tables = ParameterTables {
            ocv_v: vec![],
            r0_ohm: vec![],
            r_ohm: vec![vec![]; fitted.tables.r_ohm.len()],
            tau_s: vec![vec![]; fitted.tables.tau_s.len()],
        };
        let mut all = Self { grid, tables, voltage_error_v: vec![] };
        let nodes = &fitted.grid.temperature_c;
        let last = nodes.len() - 1;
        let low_c = range.temperature_c.0.min(nodes[0]).floor();
        let high_c = range.temperature_c.1.max(nodes[last]).ceil();
        let mut add = |row: usize, from_c: f64, to_c: f64| {
            all.add_row((fitted, voltage_error_v), (row, from_c, to_c), range.rms_a);
        };
        let (from_low_c, from_high_c) = if is_scaled { (nodes[0], nodes[last]) } else { (low_c, high_c) };
        add(0, from_low_c, low_c - REACH_K);
        if low_c < nodes[0] {
            add(0, from_low_c, low_c);
        }
        (0..=last).for_each(|row| add(row, nodes[row], nodes[row]));
        if high_c > nodes[last] {
            add(last, from_high_c, high_c);
        }
        add(last, from_high_c, high_c + REACH_K);
        all
    }

    /// Adds the row for `to_c`: the fitted row `row` with its resistances scaled by Arrhenius' law from `from_c` to
    /// `to_c`.
    fn add_row(
        &mut self,
        (fitted, voltage_error_v): (&FittedTables, &[f64]),
        (row, from_c, to_c): (usize, f64, f64),
        rms_a: f64,
    ) {
        let columns = self.grid.soc.len();
        let nodes = row * columns..(row + 1) * columns;
        let factor = arrhenius(to_c) / arrhenius(from_c);
        let per_kelvin = 1.0 / (to_c + ZERO_CELSIUS_K) - 1.0 / (from_c + ZERO_CELSIUS_K);
        // 8.314 J/(mol K) is the gas constant.
        let log_std = (ENERGY_STD_J_PER_MOL / 8.314_462_618 * per_kelvin).abs();
        self.grid.temperature_c.push(to_c);
        let ParameterTables { ocv_v, r0_ohm, r_ohm, tau_s } = &fitted.tables;
        self.tables.ocv_v.extend(&ocv_v[nodes.clone()]);
        self.tables.r0_ohm.extend(r0_ohm[nodes.clone()].iter().map(|ohm| ohm * factor));
        for ((to_r, to_tau), (r, tau)) in
            self.tables.r_ohm.iter_mut().zip(&mut self.tables.tau_s).zip(r_ohm.iter().zip(tau_s))
        {
            to_r.extend(r[nodes.clone()].iter().map(|ohm| ohm * factor));
            to_tau.extend(&tau[nodes.clone()]);
        }
        // The error of a warmer cell is not reduced.
        let colder = factor.max(1.0);
        self.voltage_error_v.extend(nodes.map(|node| {
            let settled_ohm = r_ohm.iter().fold(r0_ohm[node], |sum, r| sum + r[node]);
            let arrhenius_v = log_std * rms_a * settled_ohm * colder;
            // The error is limited to 0.5 V. With this error, a voltage already hardly affects an estimate.
            libm::hypot(voltage_error_v[node] * libm::pow(colder, COLD_POWER), arrhenius_v).min(0.5)
        }));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ident::fit::Residual;

    fn fitted(temperature_c: Vec<f64>) -> FittedTables {
        let nodes = 2 * temperature_c.len();
        let tables = ParameterTables {
            ocv_v: [3.0, 4.2].repeat(temperature_c.len()),
            r0_ohm: vec![0.03; nodes],
            r_ohm: vec![vec![0.02; nodes]],
            tau_s: vec![vec![50.0; nodes]],
        };
        let grid = Grid { soc: vec![0.0, 1.0], temperature_c };
        FittedTables { grid, tables, total: Residual::default(), visits_s: vec![], passes: 1, converged: true }
    }

    #[test]
    fn resistance_and_error_grow_outside_the_measured_range() {
        let range = MeasuredRange { temperature_c: (22.4, 36.1), current_a: (-5.0, 15.0), soc: (0.0, 1.0), rms_a: 2.0 };
        let all = ModelTables::beyond(&fitted(vec![25.0]), &[0.005; 2], &range, false);
        assert_eq!(all.grid.temperature_c, [-18.0, 22.0, 25.0, 37.0, 77.0]);
        let cold = arrhenius(-18.0) / arrhenius(22.0);
        assert!((all.tables.r0_ohm[0] - 0.03 * cold).abs() < 1e-12);
        assert!((all.tables.r_ohm[0][9] - 0.02 * arrhenius(77.0) / arrhenius(37.0)).abs() < 1e-12);
        assert_eq!(all.tables.r0_ohm[2..8], [0.03; 6], "measured: as fitted");
        assert_eq!(all.voltage_error_v[2..8], [0.005; 6]);
        assert!(all.voltage_error_v[0] > 0.03 && all.voltage_error_v[9] > 0.02, "{:?}", all.voltage_error_v);
        assert_eq!((all.tables.ocv_v.len(), all.tables.tau_s[0].len()), (10, 10));
    }
}
