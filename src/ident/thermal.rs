//! Heat capacity and thermal resistance: C dT/dt = I (OCV - V) - (T - Ta)/R, integrated, by linear least squares.
//!
//! The temperature of the surroundings is unknown and fitted per record, which costs a term that grows with time; records
//! must warm up enough to tell. Reversible heat is left out: the values are effective ones of the duty in the data.

use super::parameters::Tables;
use super::record::Record;
use crate::cell::Thermal;

/// Least span of temperature in a record that tells anything, K.
const MIN_SPAN_K: f64 = 2.0;
/// Values outside are no cell's: J/K, K/W.
const CREDIBLE: [(f64, f64); 2] = [(1.0, 1e5), (0.01, 1e3)];

/// Sums of products of heat, -(integral of warming), warming, time: symmetric 4 x 4.
#[derive(Default)]
struct Products([[f64; 4]; 4]);

impl Products {
    fn add(&mut self, weight: f64, x: [f64; 4]) {
        for a in 0..4 {
            for b in 0..4 {
                self.0[a][b] += weight * x[a] * x[b];
            }
        }
    }

    /// Adds those of a record with the part that goes with its time taken out.
    fn add_without_time(&mut self, record: &Self) {
        let p = &record.0;
        if p[3][3] > 0.0 {
            for a in 0..3 {
                for b in 0..3 {
                    self.0[a][b] += p[a][b] - p[a][3] * p[3][b] / p[3][3];
                }
            }
        }
    }
}

/// Fits both; `None` when no record warms enough or the answer is no cell's.
pub fn fit(records: &[Record], tables: &Tables) -> Option<Thermal> {
    let mut sum = Products::default();
    for record in records.iter().filter(|record| warms(record)) {
        sum.add_without_time(&products(record, tables));
    }
    // T - T0 = g heat + f (-above): normal equations of two unknowns.
    let [[hh, ha, ht, _], [_, aa, at, _], ..] = sum.0;
    let determinant = hh * aa - ha * ha;
    let g = (ht * aa - at * ha) / determinant;
    let f = (at * hh - ht * ha) / determinant;
    let thermal = Thermal { heat_capacity_j_per_k: 1.0 / g, resistance_k_per_w: g / f };
    if std::env::var("DBGFIT").is_ok() { eprintln!("thermal {thermal:?}"); }
    let found = [thermal.heat_capacity_j_per_k, thermal.resistance_k_per_w];
    found.iter().zip(CREDIBLE).all(|(x, (low, high))| (low..=high).contains(x)).then_some(thermal)
}

fn products(record: &Record, tables: &Tables) -> Products {
    let mut products = Products::default();
    let start_c = record.rows[0].temperature_c;
    let (mut heat, mut above, mut time) = (0.0, 0.0, 0.0);
    for row in record.rows.iter().skip(1) {
        if row.relaxed {
            // Charge moved unseen: what it heated is unknown.
            break;
        }
        let rise = row.temperature_c - start_c;
        if row.weight_s > 0.0 {
            heat += row.mean_current_a * (row.ocv.at(&tables.ocv_v) - row.voltage_v) * row.dt_s;
        }
        above += rise * row.dt_s;
        time += row.dt_s;
        products.add(row.weight_s, [heat, -above, rise, time]);
    }
    products
}

fn warms(record: &Record) -> bool {
    let temperatures = record.rows.iter().map(|row| row.temperature_c);
    let range = temperatures.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), t| (low.min(t), high.max(t)));
    range.1 - range.0 >= MIN_SPAN_K
}
