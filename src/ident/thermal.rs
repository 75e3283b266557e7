//! Heat capacity and thermal resistance: C dT/dt = I (OCV - V) - (T - Ta)/R, integrated, by linear least squares.
//!
//! The surroundings are taken to be at the temperature a record begins with, so only records count that begin at rest with them
//! (their coldest decile is near the beginning) and that warm up enough to tell. Reversible heat is left out: the values
//! are effective ones of the duty in the data.

use super::parameters::Tables;
use super::record::Record;
use crate::cell::Thermal;

/// Least warming of a record that tells anything, K.
const MIN_RISE_K: f64 = 2.0;
/// Most a record may cool below its beginning, K: else it began warmer than its surroundings.
const MAX_FALL_K: f64 = 1.0;

/// Fits both; `None` when no record warms enough or the answer is not physical.
pub fn fit(records: &[Record], tables: &Tables) -> Option<Thermal> {
    // T - T0 = g heat - f above: normal equations of two unknowns.
    let (mut hh, mut ha, mut aa, mut ht, mut at) = (0.0, 0.0, 0.0, 0.0, 0.0);
    for record in records.iter().filter(|record| warms(record)) {
        let start_c = record.rows[0].temperature_c;
        let (mut heat, mut above) = (0.0, 0.0);
        for row in &record.rows {
            if row.relaxed && row.dt_s > 0.0 {
                break;
            }
            let rise = row.temperature_c - start_c;
            if row.weight_s > 0.0 {
                heat += row.mean_current_a * (row.ocv.at(&tables.ocv_v) - row.voltage_v) * row.dt_s;
            }
            above += rise * row.dt_s;
            let w = row.dt_s;
            hh += w * heat * heat;
            ha -= w * heat * above;
            aa += w * above * above;
            ht += w * heat * rise;
            at -= w * above * rise;
        }
    }
    let determinant = hh * aa - ha * ha;
    let g = (ht * aa - at * ha) / determinant;
    let f = (at * hh - ht * ha) / determinant;
    let thermal = Thermal { heat_capacity_j_per_k: 1.0 / g, resistance_k_per_w: g / f };
    let physical = |x: f64| x.is_finite() && x > 0.0;
    (physical(thermal.heat_capacity_j_per_k) && physical(thermal.resistance_k_per_w)).then_some(thermal)
}

fn warms(record: &Record) -> bool {
    let Some(first) = record.rows.first() else { return false };
    let range = record.rows.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), row| {
        (low.min(row.temperature_c), high.max(row.temperature_c))
    });
    range.1 - first.temperature_c >= MIN_RISE_K && first.temperature_c - range.0 <= MAX_FALL_K
}
