//! Fits heat capacity C and thermal resistance R of a cell: C dT/dt = I (OCV - V) - (T - Ta)/R, integrated and solved
//! by linear least squares.
//!
//! The surroundings are assumed to have the temperature at which a record starts. Some cells start warmer or colder, so
//! each discharge is fitted alone, and the medians of the credible results are used. Reversible heat is left out, so
//! the values are effective values, which hold for duty cycles like those of the data.

use super::parameters::ParameterTables;
use super::record::Record;
use crate::cell::Thermal;
use crate::filter::{ends, median};

/// Ranges of credible values: heat capacity (J/K) and thermal resistance (K/W).
const CREDIBLE: [(f64, f64); 2] = [(5.0, 1e5), (0.05, 200.0)];

/// Credible heat capacity divided by stored energy (J/K per Wh): from 300 Wh/kg with 0.8 kJ/(kg K) to 80 Wh/kg with 1
/// kJ/(kg K). A sensor between cell and moving air measures only a share of the warming. The fitted capacity is then
/// too large, and the resistance too small. Such a fit has small residuals, but its heat capacity is outside this
/// range.
const CELL_J_PER_K_WH: (f64, f64) = (2.5, 12.5);

/// Fits heat capacity and thermal resistance. `energy_wh` is the energy that the cell stores.
///
/// # Errors
/// No discharge warms the cell enough, or the result is not plausible for a cell.
pub fn fit(records: &[Record], tables: &ParameterTables, energy_wh: f64) -> Result<Thermal, String> {
    let thermal = medians(records, tables).ok_or("no thermal parameters: no file warms enough to determine them")?;
    let found_j_per_k = thermal.heat_capacity_j_per_k;
    let (least, most) = CELL_J_PER_K_WH;
    let is_cell = (least..=most).contains(&(found_j_per_k / energy_wh));
    is_cell.then_some(thermal).ok_or_else(|| {
        format!(
            "no thermal parameters: {found_j_per_k:.0} J/K fits, a cell of {energy_wh:.1} Wh has {least} to {most} J/K per Wh; \
             the sensor does not see the cell's warming alone"
        )
    })
}

fn medians(records: &[Record], tables: &ParameterTables) -> Option<Thermal> {
    let fitted = records.iter().filter(|record| warms(record)).filter_map(|record| of_record(record, tables));
    let (capacities, resistances): (Vec<f64>, Vec<f64>) =
        fitted.map(|thermal| (thermal.heat_capacity_j_per_k, thermal.resistance_k_per_w)).unzip();
    Some(Thermal {
        heat_capacity_j_per_k: median(capacities.into_iter())?,
        resistance_k_per_w: median(resistances.into_iter())?,
    })
}

/// Solves the normal equations of T - T0 = heat / C + (-above) / (R C) for 1 / C and 1 / (R C). `heat` is the heat
/// produced (J), and `above` is the integral of T - T0 (K s).
fn of_record(record: &Record, tables: &ParameterTables) -> Option<Thermal> {
    let (mut hh, mut ha, mut aa, mut ht, mut at) = (0.0, 0.0, 0.0, 0.0, 0.0);
    let start_c = record.rows[0].temperature_c;
    let (mut heat, mut above) = (0.0, 0.0);
    // Stop at a gap that hides charge, because the heat of this charge is unknown.
    for row in record.rows.iter().skip(1).take_while(|row| !row.relaxed) {
        let rise = row.temperature_c - start_c;
        heat += row.mean_current_a * (row.ocv.at(&tables.ocv_v) - row.voltage_v) * row.dt_s;
        above += rise * row.dt_s;
        let w = row.weight_s;
        hh += w * heat * heat;
        ha -= w * heat * above;
        aa += w * above * above;
        ht += w * heat * rise;
        at -= w * above * rise;
    }
    let determinant = hh * aa - ha * ha;
    let g = (ht * aa - at * ha) / determinant;
    let f = (at * hh - ht * ha) / determinant;
    let (capacity, resistance) = (1.0 / g, g / f);
    let credible = |x: f64, (low, high): (f64, f64)| (low..=high).contains(&x);
    (credible(capacity, CREDIBLE[0]) && credible(resistance, CREDIBLE[1]))
        .then_some(Thermal { heat_capacity_j_per_k: capacity, resistance_k_per_w: resistance })
}

fn warms(record: &Record) -> bool {
    let (Some(first), Some(last)) = (record.rows.first(), record.rows.last()) else { return false };
    let (low, high) = ends(record.rows.iter().map(|row| row.temperature_c));
    let discharge = last.soc < first.soc;
    // Cooling by more than 1 K means that the cell started warmer than its surroundings.
    discharge && high - first.temperature_c >= 2.0 && first.temperature_c - low <= 1.0
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ident::MeasuredPart;
    use crate::ident::grid::Grid;
    use crate::ident::record::Limits;

    #[test]
    fn known_parameters_are_recovered_despite_a_cold_start() {
        let grid = Grid { soc: vec![0.0, 1.0], temperature_c: vec![25.0] };
        let tables = ParameterTables { ocv_v: vec![3.6, 3.6], r0_ohm: vec![0.1; 2], r_ohm: vec![], tau_s: vec![] };
        let limits = Limits { voltage_low_v: 2.0, voltage_high_v: 5.0, capacity_ah: 2.0 };
        let record = |start_c: f64| {
            let time_s: Vec<f64> = (0..3000).map(f64::from).collect();
            let soc: Vec<f64> = time_s.iter().map(|t| 1.0 - t / 3600.0).collect();
            let warm = |t: f64| 25.0 + 4.0 + (start_c - 29.0) * libm::exp(-t / 400.0);
            let temperature_c: Vec<f64> = time_s.iter().map(|&t| warm(t)).collect();
            // The cell produces 0.4 W. Its thermal resistance is 10 K/W, and its heat capacity is 40 J/K.
            let (current_a, voltage_v) = (vec![2.0; 3000], vec![3.4; 3000]);
            let raw = MeasuredPart { time_s, current_a, voltage_v, temperature_c, soc, ..MeasuredPart::default() };
            Record::prepare(&raw, &[], &grid, &limits)
        };
        let records = [record(25.0), record(25.0), record(15.0)];
        let found = fit(&records, &tables, 7.2).expect("warms");
        assert!((found.heat_capacity_j_per_k - 40.0).abs() < 0.4, "{found:?}");
        assert!((found.resistance_k_per_w - 10.0).abs() < 0.1, "{found:?}");
        let refused = fit(&records, &tables, 2.9).expect_err("13.8 J/K per Wh");
        assert!(refused.contains("40 J/K fits, a cell of 2.9 Wh has 2.5 to 12.5 J/K per Wh"), "{refused}");
    }
}
