//! Fits cell models to measured data (paper, section 3.3.2): pure arithmetic, no files, no printing.
//!
//! Data flow: raw rows of one file -> [`anchor`] (SOC of every row) -> [`record`] (coarser rows, places in
//! the tables, weights) -> [`pass`] (residuals and the exact Jacobian by sensitivity recursion) with [`prior`]
//! (smoothness) -> [`solve`] (projected Levenberg-Marquardt) -> [`fit`] (the whole, residuals per file, nodes without data).
//! [`error_table`] estimates the model's error, [`thermal`] fits heat capacity and thermal resistance afterwards.

pub mod ageing;
pub mod anchor;
pub mod electrodes;
pub mod error_table;
pub mod fit;
pub mod grid;
pub mod parameters;
pub mod pass;
pub mod prior;
pub mod record;
pub mod solve;
pub mod thermal;

/// A stretch of rows over which time runs on.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct MeasuredPart {
    /// Its key in the part column; empty where there is none.
    pub key: String,
    /// Value of the `type` column in its first row: `charge`, `discharge`; empty where there is none.
    pub kind: String,
    /// Seconds since the part's own beginning.
    pub time_s: Vec<f64>,
    /// Current, A, positive = discharge.
    pub current_a: Vec<f64>,
    /// Terminal voltage, V.
    pub voltage_v: Vec<f64>,
    /// Cell temperature, degrees C; NaN where there is none.
    pub temperature_c: Vec<f64>,
    /// The cycler's own counter, Ah taken out; NaN where there is none.
    pub discharged_ah: Vec<f64>,
    /// State of charge, fraction; empty until it is determined.
    pub soc: Vec<f64>,
}

impl MeasuredPart {
    /// Whether it is a discharge, as far as its column `type` says so.
    pub(crate) fn is_discharge(&self) -> bool {
        self.kind == "discharge"
    }

    /// Rows.
    pub fn len(&self) -> usize {
        self.time_s.len()
    }

    /// Adds a row.
    pub(crate) fn push(&mut self, time_s: f64, current_a: f64, voltage_v: f64, temperature_c: f64, discharged_ah: f64) {
        self.time_s.push(time_s);
        self.current_a.push(current_a);
        self.voltage_v.push(voltage_v);
        self.temperature_c.push(temperature_c);
        self.discharged_ah.push(discharged_ah);
    }

    /// Whether it has no rows.
    pub fn is_empty(&self) -> bool {
        self.time_s.is_empty()
    }
}

/// Charge taken out since the first row at every row, Ah, by the trapezoidal rule; gaps count like any other step.
pub fn charge_ah(time_s: &[f64], current_a: &[f64]) -> Vec<f64> {
    let mut sum = 0.0;
    let mut charges = Vec::with_capacity(time_s.len());
    for k in 0..time_s.len() {
        if k > 0 {
            sum += 0.5 * (current_a[k] + current_a[k - 1]) * (time_s[k] - time_s[k - 1]) / 3600.0;
        }
        charges.push(sum);
    }
    charges
}
