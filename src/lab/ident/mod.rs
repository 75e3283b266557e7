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

/// Rows of one stretch of one file as measured, time rising or equal, no holes. Slices of equal length.
#[derive(Debug, Clone, Copy)]
pub struct RawRows<'a> {
    /// Seconds since its beginning.
    pub time_s: &'a [f64],
    /// Current, A, positive = discharge.
    pub current_a: &'a [f64],
    /// Terminal voltage, V.
    pub voltage_v: &'a [f64],
    /// Cell temperature, degrees C.
    pub temperature_c: &'a [f64],
    /// State of charge, fraction.
    pub soc: &'a [f64],
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
